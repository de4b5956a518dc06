//! A flat tensor cut into pieces, whose gradient is put together once.
//!
//! Slices would do the same, but the derivative of each is a tensor of zeros as large as the whole.

use super::autodiff::{differentiate, record};
use super::shared::{Shared, Token, share};
use crate::cpu::tensor::CpuBackend;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, backend_extension};
use burn::tensor::{Slice, Tensor};
use std::sync::Arc;

/// Lengths of the pieces, and their gradients as far as they are known.
#[derive(Debug)]
pub struct Pieces {
    lengths: Vec<usize>,
    gradients: Shared,
}

/// Putting pieces together, per device.
pub trait SplitBackward: Token {
    /// The pieces one after the other, each of its length; zeros in place of those that are `None`.
    fn join(pieces: Vec<Option<FloatTensor<Self>>>, lengths: &[usize]) -> FloatTensor<Self>;
}

/// The operations per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait SplitOps: Backend {
    /// `flat` itself; its gradient is that of its pieces, one after the other.
    fn whole(flat: FloatTensor<Self>, pieces: Arc<Pieces>) -> FloatTensor<Self>;
    /// The piece `index` of a tensor that [`SplitOps::whole`] returned.
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self>;
}

fn slice<B: Backend>(whole: FloatTensor<B>, pieces: &Pieces, index: usize) -> FloatTensor<B> {
    let start: usize = pieces.lengths[..index].iter().sum();
    B::float_slice(whole, &[Slice::from(start..start + pieces.lengths[index])])
}

impl<B: CpuBackend> SplitBackward for B {
    fn join(pieces: Vec<Option<FloatTensor<Self>>>, lengths: &[usize]) -> FloatTensor<Self> {
        let count = lengths.iter().sum();
        let mut all = Vec::with_capacity(count);
        for (piece, &length) in pieces.iter().zip(lengths) {
            match piece {
                Some(piece) => all.extend_from_slice(&B::floats(piece)),
                None => all.resize(all.len() + length, 0.0),
            }
        }
        B::from_floats(all, [count])
    }
}

impl<B: CpuBackend> SplitOps for B {
    fn whole(flat: FloatTensor<Self>, _: Arc<Pieces>) -> FloatTensor<Self> {
        flat
    }
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
        slice::<B>(whole, &pieces, index)
    }
}

#[cfg(feature = "cube")]
mod cube {
    use super::{Pieces, SplitBackward, SplitOps, slice};
    use burn::backend::TensorMetadata;
    use burn::backend::ops::FloatTensorOps;
    use burn::backend::tensor::FloatTensor;
    use burn::tensor::FloatDType;
    use burn_cubecl::CubeBackend;
    use std::sync::Arc;

    impl SplitBackward for CubeBackend {
        fn join(pieces: Vec<Option<FloatTensor<Self>>>, lengths: &[usize]) -> FloatTensor<Self> {
            let Some(device) = pieces.iter().flatten().next().map(|piece| piece.device()) else {
                return Self::float_zeros([0].into(), &Default::default(), FloatDType::F32);
            };
            let zeros = |length: usize| Self::float_zeros([length].into(), &device, FloatDType::F32);
            let all = pieces.into_iter().zip(lengths).map(|(piece, &length)| piece.unwrap_or_else(|| zeros(length))).collect();
            Self::float_cat(all, 0)
        }
    }

    impl SplitOps for CubeBackend {
        fn whole(flat: FloatTensor<Self>, _: Arc<Pieces>) -> FloatTensor<Self> {
            flat
        }
        fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
            slice::<Self>(whole, &pieces, index)
        }
    }
}

#[derive(Debug)]
struct Piece;

impl<B: Token> Backward<B, 1> for Piece {
    type State = (Arc<Pieces>, usize);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(pieces, index), upstream, [wanted]| {
            [wanted.then(|| {
                let token = B::token(&upstream);
                pieces.gradients.leave(index, upstream);
                token
            })]
        });
    }
}

impl<B: SplitBackward + SplitOps, C: CheckpointStrategy> SplitOps for Autodiff<B, C> {
    fn whole(flat: FloatTensor<Self>, pieces: Arc<Pieces>) -> FloatTensor<Self> {
        share::<B, C, _>(flat, pieces, |pieces| B::join(pieces.gradients.take(), &pieces.lengths))
    }
    fn piece(whole: FloatTensor<Self>, pieces: Arc<Pieces>, index: usize) -> FloatTensor<Self> {
        let (whole, parent) = whole.into_parts();
        record::<B, C, _, 1>(Piece, [parent], |_| (B::piece(whole, pieces.clone(), index), (pieces, index)))
    }
}

/// The pieces of `flat` of these lengths, one after the other; together they are as long as `flat`.
pub fn split(flat: Tensor<1>, lengths: Vec<usize>) -> Vec<Tensor<1>> {
    let count = lengths.len();
    let pieces = Arc::new(Pieces { gradients: Shared::new(lengths.len()), lengths });
    let whole = <Dispatch as SplitOps>::whole(flat.into_dispatch(), pieces.clone());
    (0..count).map(|index| Tensor::from_dispatch(<Dispatch as SplitOps>::piece(whole.clone(), pieces.clone(), index))).collect()
}
