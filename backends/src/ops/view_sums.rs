//! The sums over views that density control needs, for N Gaussians in one pass. burn's own operations take some thirty passes per view, each on one thread.

use crate::cpu::tensor::CpuBackend;
use crate::cpu::view_sums as kernel;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Error, Result};

/// Bound on the opacity logits that [`fade`] reads: from 17 on their sigmoid is 1 in float32, and e^89 is infinite.
pub(crate) const MOST_LOGIT: f32 = 30.0;

/// The operations per device. A Gaussian whose radius is 0 is not shown.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"))]
pub trait ViewSumOps: Backend {
    /// Adds the norm of `gradient` `[N,2]` times `scale`, and 1, to the `sums` `[N,2]` of every Gaussian that is shown. Norms that are not finite are left out.
    fn add_gradients(sums: FloatTensor<Self>, radii: IntTensor<Self>, gradient: FloatTensor<Self>, scale: [f32; 2]) -> FloatTensor<Self>;
    /// Adds `weights` `[N]`, their squares, and 1 where a Gaussian is shown, to `sums` `[N,3]`.
    fn add_weights(sums: FloatTensor<Self>, radii: IntTensor<Self>, weights: FloatTensor<Self>) -> FloatTensor<Self>;
    /// The `logits` `[N]` of opacities of which those shown are smaller by `share`.
    fn fade(logits: FloatTensor<Self>, radii: IntTensor<Self>, share: f32) -> FloatTensor<Self>;
}

impl<B: CpuBackend> ViewSumOps for B {
    fn add_gradients(sums: FloatTensor<Self>, radii: IntTensor<Self>, gradient: FloatTensor<Self>, scale: [f32; 2]) -> FloatTensor<Self> {
        let (radii, gradient) = (B::ints(&radii), B::floats(&gradient));
        B::update_floats(sums, |sums| kernel::add_gradients(sums, &radii, &gradient, scale))
    }
    fn add_weights(sums: FloatTensor<Self>, radii: IntTensor<Self>, weights: FloatTensor<Self>) -> FloatTensor<Self> {
        let (radii, weights) = (B::ints(&radii), B::floats(&weights));
        B::update_floats(sums, |sums| kernel::add_weights(sums, &radii, &weights))
    }
    fn fade(logits: FloatTensor<Self>, radii: IntTensor<Self>, share: f32) -> FloatTensor<Self> {
        let shape = logits.shape();
        B::from_floats(kernel::fade(&B::floats(&logits), &B::ints(&radii), share), shape)
    }
}

fn check(object: &str, radii: &Tensor<1, Int>, found: &[&[usize]], expected: &[&[usize]]) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    let problem = format!("arrays of shapes {found:?} for {} Gaussians, {expected:?} are expected", radii.dims()[0]);
    Err(Error::parameter(object, problem, "Give one row per Gaussian"))
}

/// `sums` `[N,2]` of screen gradients and of views, after a view with these `radii` (0 where a Gaussian is not shown): the norm of `gradient` `[N,2]`, each
/// axis times its `scale`, and 1 are added where a Gaussian is shown and the norm is finite. In place if `sums` has no other owner.
///
/// # Errors
/// [`Error::Parameter`] for other shapes.
pub fn add_gradients(sums: Tensor<2>, radii: Tensor<1, Int>, gradient: Tensor<2>, scale: [f32; 2]) -> Result<Tensor<2>> {
    let n = radii.dims()[0];
    check("sums of screen gradients", &radii, &[&sums.dims(), &gradient.dims()], &[&[n, 2], &[n, 2]])?;
    if n == 0 {
        return Ok(sums);
    }
    let [sums, gradient] = [sums, gradient].map(|t| t.inner().into_dispatch());
    Ok(Tensor::from_dispatch(<Dispatch as ViewSumOps>::add_gradients(sums, radii.inner().into_dispatch(), gradient, scale)))
}

/// `sums` `[N,3]` of largest blending weights, of their squares and of views, after a view with these `weights` `[N]` and `radii`. In place if `sums` has no
/// other owner.
///
/// # Errors
/// [`Error::Parameter`] for other shapes.
pub fn add_weights(sums: Tensor<2>, radii: Tensor<1, Int>, weights: Tensor<1>) -> Result<Tensor<2>> {
    let n = radii.dims()[0];
    check("sums of blending weights", &radii, &[&sums.dims(), &weights.dims()], &[&[n, 3], &[n]])?;
    if n == 0 {
        return Ok(sums);
    }
    let (sums, weights) = (sums.inner().into_dispatch(), weights.inner().into_dispatch());
    Ok(Tensor::from_dispatch(<Dispatch as ViewSumOps>::add_weights(sums, radii.inner().into_dispatch(), weights)))
}

/// Opacity `logits` `[N]` after views with these `radii`: the opacity of Gaussians that are shown is smaller by `share` (0..1), all others are unchanged.
///
/// # Errors
/// [`Error::Parameter`] for other shapes.
pub fn fade(logits: Tensor<1>, radii: Tensor<1, Int>, share: f32) -> Result<Tensor<1>> {
    let n = radii.dims()[0];
    check("opacities that fade", &radii, &[&logits.dims()], &[&[n]])?;
    if n == 0 {
        return Ok(logits);
    }
    Ok(Tensor::from_dispatch(<Dispatch as ViewSumOps>::fade(logits.inner().into_dispatch(), radii.inner().into_dispatch(), share)))
}
