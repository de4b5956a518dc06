//! Interpolated lookup in multi-resolution grids of stored features: hash grids and planes. The gradient goes to the table alone.

use super::limits::{check_binding, check_sorted};
use crate::cpu::lookup as kernel;
use crate::cpu::tensor::CpuBackend;
use crate::ops::autodiff::{differentiate, record};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::Tensor;
use cc4dgs_core::{Error, Result};
pub use cc4dgs_fields::lookup::{GridLevel, GridShape, MAX_DIMS, Outside, PRIMES};
use std::sync::Arc;

/// The derivative per device.
pub trait LookupBackward: Backend {
    /// The gradient of the flat table.
    fn lookup_backward(points: FloatTensor<Self>, shape: Arc<GridShape>, grad: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait LookupOps: Backend {
    /// Features `[M, width]` of points `[M, dims]`; differentiable in the flat table.
    fn lookup(table: FloatTensor<Self>, points: FloatTensor<Self>, shape: Arc<GridShape>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> LookupBackward for B {
    fn lookup_backward(points: FloatTensor<Self>, shape: Arc<GridShape>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let out = kernel::backward(&shape, &B::floats(&points), &B::floats(&grad));
        B::from_floats(out, [shape.parameter_count()])
    }
}

impl<B: CpuBackend> LookupOps for B {
    fn lookup(table: FloatTensor<Self>, points: FloatTensor<Self>, shape: Arc<GridShape>) -> FloatTensor<Self> {
        let out = kernel::forward(&shape, &Self::floats(&table), &Self::floats(&points));
        Self::from_floats(out, [points.shape()[0], shape.width()])
    }
}

#[derive(Debug)]
struct Lookup;

impl<B: LookupBackward> Backward<B, 1> for Lookup {
    type State = (FloatTensor<B>, Arc<GridShape>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(points, shape), upstream, [wanted]| [wanted.then(|| B::lookup_backward(points, shape, upstream))]);
    }
}

impl<B: LookupBackward + LookupOps, C: CheckpointStrategy> LookupOps for Autodiff<B, C> {
    fn lookup(table: FloatTensor<Self>, points: FloatTensor<Self>, shape: Arc<GridShape>) -> FloatTensor<Self> {
        let (table, parent) = table.into_parts();
        let points = points.into_primitive();
        record::<B, C, _, 1>(Lookup, [parent], |_| (B::lookup(table, points.clone(), shape.clone()), (points, shape)))
    }
}

/// Features `[M, width]` of `points` `[M, dims]` (in 0..1 inside the grid) from a flat `table` of [`GridShape::parameter_count`] weights.
pub fn lookup(table: Tensor<1>, points: Tensor<2>, shape: &Arc<GridShape>) -> Result<Tensor<2>> {
    let [m, dims] = points.dims();
    let bad = |problem: String, remedy: &str| Err(Error::parameter("grid lookup", problem, remedy));
    if dims != shape.dims || m == 0 || !(1..=MAX_DIMS).contains(&dims) {
        return bad(format!("points have shape [{m},{dims}], the grid has {} axes", shape.dims), "Give at least one point with a coordinate per axis");
    }
    if shape.width() == 0 {
        return bad(format!("the grid has {} levels of {} features", shape.levels.len(), shape.features), "Give at least one level and one feature");
    }
    if table.dims()[0] != shape.parameter_count() {
        return bad(format!("{} weights, the grid needs {}", table.dims()[0], shape.parameter_count()), "Load weights of the same configuration");
    }
    if shape.levels.iter().any(|l| l.rows == 0 || l.size[..dims].iter().any(|&s| s < if shape.clamps { 2 } else { 1 })) {
        return bad("a level has no cell".into(), "Give every axis at least two vertices");
    }
    // Backwards, every corner of every point has a word, and they are sorted.
    let slots = if table.device().is_autodiff() { shape.levels.len() << dims } else { 0 };
    check_binding(&points.device(), "grid lookup", "points", m, slots.max(shape.width()) * size_of::<u32>())?;
    check_sorted(&points.device(), "grid lookup", "points", m, slots)?;
    check_binding(&points.device(), "grid lookup", "weights", shape.parameter_count(), size_of::<f32>())?;
    Ok(Tensor::from_dispatch(<Dispatch as LookupOps>::lookup(table.into_dispatch(), points.into_dispatch(), shape.clone())))
}
