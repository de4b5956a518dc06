//! Canonical centres and times as inputs of deformers.

use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::{DeformerContext, Error, Result};

/// Largest absolute coordinate of a centre, world units; larger ones are clamped, NaN becomes 0.
const FAR: f32 = 1e6;

/// `means_world` `[M,3]` with every number finite.
pub fn finite(means_world: Tensor<2>) -> Tensor<2> {
    let odd = means_world.clone().is_nan();
    means_world.mask_fill(odd, 0.0).clamp(-FAR, FAR)
}

/// `means_world` `[M,3]` mapped to 0..1 inside the deformer's box. NaN stays NaN: lookups handle it.
pub fn in_box(means_world: Tensor<2>, context: &DeformerContext) -> Tensor<2> {
    let device = means_world.device();
    let row = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [1, 3]), &device);
    let inverse: Vec<f32> = context.box_max.iter().zip(&context.box_min).map(|(high, low)| if high > low { 1.0 / (high - low) } else { 0.0 }).collect();
    (means_world - row(context.box_min.to_vec())) * row(inverse)
}

/// A column `[M,1]` of `value`, on the device and with the rows of `like` `[M,…]`.
pub fn column(like: &Tensor<2>, value: f32) -> Tensor<2> {
    Tensor::full([like.dims()[0], 1], value, &like.device())
}

/// Refuses a time that is not a number.
///
/// # Errors
/// [`Error::Parameter`].
pub fn check_time(time_norm: f32) -> Result<()> {
    if time_norm.is_finite() {
        return Ok(());
    }
    Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"))
}

/// Refuses a box that is not finite.
///
/// # Errors
/// [`Error::Parameter`].
pub fn check_box(context: &DeformerContext) -> Result<()> {
    if context.box_min.iter().chain(&context.box_max).all(|v| v.is_finite()) {
        return Ok(());
    }
    Err(Error::parameter("deformer box", format!("{:?} to {:?}", context.box_min, context.box_max), "Give finite corners"))
}
