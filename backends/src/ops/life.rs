//! Lives of Gaussians: a velocity and a factor of the opacity over time, at several times in one sweep.
//!
//! A life has a centre T, a half-width r during which the Gaussian is fully there, a falloff s, a gate g and a velocity v (FreeTimeGS, with the gate of
//! FreeTimeGS++ and the flat-topped life of SharpTimeGS). At the time t the Gaussian is shifted by v (t - T) and its opacity is multiplied by
//! g + (1 - g) exp(-(max(|t - T| - r, 0) / s)^2). Where g is 1 in float32, 1 - g is 0: then T, r and s have no
//! gradient, and neither has a velocity that is multiplied by 1 - g.

use super::limits::check_binding;
use super::split::split;
use crate::cpu::life as kernel;
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

/// Floats per Gaussian: T, ln r, ln s, the gate's logit over [`GATE_STEEPNESS`](cc4dgs_core::LIFE_GATE_STEEPNESS), v.
pub const WIDTH: usize = 7;
/// Floats per Gaussian and time: the shift and the logarithm of the factor.
pub const OUTPUTS: usize = 4;
/// Least falloff, as a share of the sequence: a smaller one has no gradient.
pub const LEAST_FALLOFF: f32 = 1e-3;
/// Logarithm of the opacity factor of a hidden Gaussian.
pub const HIDDEN: f32 = -30.0;
/// Values of 1 - g up to this count as 0, because g is 1 in float32: T, r, s and a gated velocity then have no gradient. Otherwise Adam would move them at its
/// full rate, however small their gradient is.
pub(crate) const LASTING: f32 = f32::EPSILON / 4.0;
/// Upper bound on the logarithms of r and s; at this bound a life covers any sequence.
pub(crate) const MOST_LOG: f32 = 60.0;

/// Times, and how lives are applied.
#[derive(Clone, Debug, PartialEq)]
pub struct LifeRules {
    /// Normalised times.
    pub times_norm: Vec<f32>,
    /// A Gaussian whose opacity factor is below this is hidden: [`HIDDEN`], without a gradient.
    pub hidden_below: f32,
    /// Whether velocities are multiplied by 1 - g, so that a Gaussian that is visible at all times is not moved by its velocity, which then has no gradient.
    pub gated_velocity: bool,
}

/// What lives change at a time, for M Gaussians.
pub struct LifeAt {
    /// Shift of the centres, world units `[M,3]`.
    pub shift: Tensor<2>,
    /// Logarithm of the factor of the opacity, at most 0 `[M]`.
    pub log_factor: Tensor<1>,
}

/// The derivative per device.
pub trait LifeBackward: Backend {
    /// The gradient of the attributes `[M,7]`.
    fn lives_backward(attributes: FloatTensor<Self>, rules: Arc<LifeRules>, grad: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait LifeOps: Backend {
    /// Flat shifts `[M,3]` and factors `[M]`, time after time; differentiable in the attributes `[M,7]`.
    fn lives(attributes: FloatTensor<Self>, rules: Arc<LifeRules>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> LifeBackward for B {
    fn lives_backward(attributes: FloatTensor<Self>, rules: Arc<LifeRules>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let out = kernel::backward(&B::floats(&attributes), &rules, &B::floats(&grad));
        B::from_floats(out, attributes.shape())
    }
}

impl<B: CpuBackend> LifeOps for B {
    fn lives(attributes: FloatTensor<Self>, rules: Arc<LifeRules>) -> FloatTensor<Self> {
        let out = kernel::forward(&Self::floats(&attributes), &rules);
        let len = out.len();
        Self::from_floats(out, [len])
    }
}

#[derive(Debug)]
struct Lives;

impl<B: LifeBackward> Backward<B, 1> for Lives {
    type State = (FloatTensor<B>, Arc<LifeRules>);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |(attributes, rules), upstream, [wanted]| [wanted.then(|| B::lives_backward(attributes, rules, upstream))]);
    }
}

impl<B: LifeBackward + LifeOps, C: CheckpointStrategy> LifeOps for Autodiff<B, C> {
    fn lives(attributes: FloatTensor<Self>, rules: Arc<LifeRules>) -> FloatTensor<Self> {
        let (attributes, parent) = attributes.into_parts();
        record::<B, C, _, 1>(Lives, [parent], |_| (B::lives(attributes.clone(), rules.clone()), (attributes, rules)))
    }
}

/// The changes at each of `rules.times_norm`, for attributes `[M,7]` with M > 0.
///
/// # Errors
/// [`Error::Parameter`] for attributes of another shape and times that are not finite.
pub fn lives(attributes: Tensor<2>, rules: LifeRules) -> Result<Vec<LifeAt>> {
    let [m, width] = attributes.dims();
    if m == 0 || width != WIDTH {
        let problem = format!("attributes have shape [{m},{width}], [M,{WIDTH}] with M > 0 is expected");
        return Err(Error::parameter("lives", problem, "Give the attributes of lives side by side"));
    }
    if let Some(time_norm) = rules.times_norm.iter().find(|time_norm| !time_norm.is_finite()) {
        return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
    }
    let lengths = rules.times_norm.iter().flat_map(|_| [3 * m, m]).collect::<Vec<_>>();
    if lengths.is_empty() {
        return Ok(Vec::new());
    }
    let most = WIDTH.max(OUTPUTS * rules.times_norm.len());
    check_binding(&attributes.device(), "lives", "Gaussians", m, most * size_of::<f32>())?;
    let flat = Tensor::<1>::from_dispatch(<Dispatch as LifeOps>::lives(attributes.into_dispatch(), Arc::new(rules)));
    let pieces = split(flat, lengths);
    Ok(pieces.as_chunks::<2>().0.iter().map(|[shift, factor]| LifeAt { shift: shift.clone().reshape([m, 3]), log_factor: factor.clone() }).collect())
}
