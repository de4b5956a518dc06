//! Interpolated lookup in multi-resolution grids of stored features: hash grids and planes. The gradient goes to the table alone.

use super::limits::check_binding;
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
use std::sync::Arc;

/// Most axes of a grid.
pub const MAX_DIMS: usize = 4;
/// Multipliers of the spatial hash (Müller et al. 2022).
pub const PRIMES: [u32; MAX_DIMS] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// What points outside 0..1 get.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outside {
    /// Zeros, and no gradient.
    Zero,
    /// What the nearest face has.
    Clamp,
}

/// One level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridLevel {
    /// Vertices per axis.
    pub size: [u32; MAX_DIMS],
    /// Position = x * scale + stagger, per axis.
    pub scale: [f32; MAX_DIMS],
    /// Rows of the table before this level.
    pub first_row: usize,
    /// Rows of this level.
    pub rows: usize,
    /// Whether vertices share rows by their hash.
    pub hashed: bool,
}

/// A whole grid.
#[derive(Clone, Debug, PartialEq)]
pub struct GridShape {
    /// Axes, 1 to [`MAX_DIMS`].
    pub dims: usize,
    /// Features per level.
    pub features: usize,
    /// Levels, in the order of the table.
    pub levels: Vec<GridLevel>,
    /// Added to positions (tiny-cuda-nn: 0.5).
    pub stagger: f32,
    /// Whether interpolation weights go through smoothstep.
    pub smooth: bool,
    /// Whether the last cell ends with the last vertex, so that x = 1 lies at it (align_corners).
    pub clamps: bool,
    /// What points outside get.
    pub outside: Outside,
}

impl GridShape {
    /// Rows of the table.
    pub fn rows(&self) -> usize {
        self.levels.iter().map(|l| l.rows).sum()
    }
    /// Weights of the table.
    pub fn parameter_count(&self) -> usize {
        self.rows() * self.features
    }
    /// Features per point.
    pub fn width(&self) -> usize {
        self.levels.len() * self.features
    }
    /// Appends a level of `size` vertices per axis in at most `most_rows` rows; dense where they suffice.
    pub fn push(&mut self, size: &[u32], scale: &[f32], most_rows: usize) {
        let vertices = size.iter().fold(1u64, |n, &s| n.saturating_mul(u64::from(s)));
        // Tables are padded to eight rows, as tiny-cuda-nn does.
        let padded = vertices.saturating_add(7) / 8 * 8;
        let rows = if self.clamps { vertices } else { padded }.min(most_rows as u64) as usize;
        let fill = |values: &[u32]| std::array::from_fn(|d| values.get(d).copied().unwrap_or(1));
        let level = GridLevel {
            size: fill(size),
            scale: std::array::from_fn(|d| scale.get(d).copied().unwrap_or(0.0)),
            first_row: self.rows(),
            rows,
            hashed: vertices > rows as u64,
        };
        self.levels.push(level);
    }
}

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
    if table.dims()[0] != shape.parameter_count() {
        return bad(format!("{} weights, the grid needs {}", table.dims()[0], shape.parameter_count()), "Load weights of the same configuration");
    }
    if shape.levels.iter().any(|l| l.rows == 0 || l.size[..dims].iter().any(|&s| s < if shape.clamps { 2 } else { 1 })) {
        return bad("a level has no cell".into(), "Give every axis at least two vertices");
    }
    // Backwards, every corner of every point has a word.
    let slots = if table.device().is_autodiff() { shape.levels.len() << dims } else { 0 };
    check_binding(&points.device(), "grid lookup", "points", m, slots.max(shape.width()) * size_of::<u32>())?;
    check_binding(&points.device(), "grid lookup", "weights", shape.parameter_count(), size_of::<f32>())?;
    Ok(Tensor::from_dispatch(<Dispatch as LookupOps>::lookup(table.into_dispatch(), points.into_dispatch(), shape.clone())))
}
