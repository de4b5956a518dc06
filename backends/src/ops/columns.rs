//! Matrices side by side. burn's concatenation of columns copies piece by piece through its dispatch, and its derivative is one slice per matrix; here both are
//! one pass over the rows.

use super::autodiff::{differentiate, record};
use crate::cpu::columns as kernel;
use crate::cpu::tensor::CpuBackend;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::Tensor;

/// Matrices that are put side by side at once.
pub const PARTS: usize = 5;

/// The derivative per device.
pub trait ColumnBackward: Backend {
    /// The matrices `[M,width]` of which `joined` `[M, sum of widths]` consists.
    fn apart(joined: FloatTensor<Self>, widths: [usize; PARTS]) -> [FloatTensor<Self>; PARTS];
}

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait ColumnOps: Backend {
    /// The matrices `[M,·]` side by side.
    fn beside(a: FloatTensor<Self>, b: FloatTensor<Self>, c: FloatTensor<Self>, d: FloatTensor<Self>, e: FloatTensor<Self>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> ColumnBackward for B {
    fn apart(joined: FloatTensor<Self>, widths: [usize; PARTS]) -> [FloatTensor<Self>; PARTS] {
        let rows = joined.shape()[0];
        let parts = kernel::apart(&B::floats(&joined), widths, rows);
        let mut widths = widths.into_iter();
        parts.map(|part| B::from_floats(part, [rows, widths.next().unwrap_or(0)]))
    }
}

impl<B: CpuBackend> ColumnOps for B {
    fn beside(a: FloatTensor<Self>, b: FloatTensor<Self>, c: FloatTensor<Self>, d: FloatTensor<Self>, e: FloatTensor<Self>) -> FloatTensor<Self> {
        let parts = [&a, &b, &c, &d, &e];
        let rows = a.shape()[0];
        let widths = parts.map(|part| part.shape()[1]);
        let values = parts.map(|part| B::floats(part));
        B::from_floats(kernel::beside(values.each_ref().map(|part| &**part), widths, rows), [rows, widths.iter().sum()])
    }
}

#[cfg(feature = "cube")]
mod cube {
    use super::{ColumnBackward, ColumnOps, PARTS};
    use burn::backend::TensorMetadata;
    use burn::backend::ops::FloatTensorOps;
    use burn::backend::tensor::FloatTensor;
    use burn::tensor::Slice;
    use burn_cubecl::CubeBackend;

    impl ColumnBackward for CubeBackend {
        fn apart(joined: FloatTensor<Self>, widths: [usize; PARTS]) -> [FloatTensor<Self>; PARTS] {
            let rows = joined.shape()[0];
            let mut start = 0;
            widths.map(|width| {
                start += width;
                Self::float_slice(joined.clone(), &[Slice::from(0..rows), Slice::from(start - width..start)])
            })
        }
    }

    impl ColumnOps for CubeBackend {
        fn beside(a: FloatTensor<Self>, b: FloatTensor<Self>, c: FloatTensor<Self>, d: FloatTensor<Self>, e: FloatTensor<Self>) -> FloatTensor<Self> {
            Self::float_cat(vec![a, b, c, d, e], 1)
        }
    }
}

#[derive(Debug)]
struct Beside;

impl<B: ColumnBackward> Backward<B, PARTS> for Beside {
    type State = [usize; PARTS];

    fn backward(self, ops: Ops<Self::State, PARTS>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, PARTS>(ops, grads, |widths, upstream, wanted| {
            let mut wanted = wanted.into_iter();
            B::apart(upstream, widths).map(|part| wanted.next().unwrap_or(false).then_some(part))
        });
    }
}

impl<B: ColumnBackward + ColumnOps, C: CheckpointStrategy> ColumnOps for Autodiff<B, C> {
    fn beside(a: FloatTensor<Self>, b: FloatTensor<Self>, c: FloatTensor<Self>, d: FloatTensor<Self>, e: FloatTensor<Self>) -> FloatTensor<Self> {
        let [a, b, c, d, e] = [a, b, c, d, e].map(FloatTensor::<Self>::into_parts);
        let widths = [&a, &b, &c, &d, &e].map(|part| part.0.shape()[1]);
        record::<B, C, _, PARTS>(Beside, [a.1, b.1, c.1, d.1, e.1], |_| (B::beside(a.0, b.0, c.0, d.0, e.0), widths))
    }
}

/// The matrices `[M,·]` side by side; differentiable in all of them. Their numbers of rows must agree.
pub fn beside(parts: [Tensor<2>; PARTS]) -> Tensor<2> {
    let rows = parts[0].dims()[0];
    let agree = parts.iter().all(|part| part.dims()[0] == rows);
    if rows == 0 || !agree {
        // Their numbers of rows differ: burn's own concatenation reports it.
        return Tensor::cat(parts.into(), 1);
    }
    let [a, b, c, d, e] = parts.map(Tensor::into_dispatch);
    Tensor::from_dispatch(<Dispatch as ColumnOps>::beside(a, b, c, d, e))
}
