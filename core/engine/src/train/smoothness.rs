//! Smoothness of the field (paper Equation "L_smooth") and the measurement that decides whether a scene needs it.

use super::state::Rows;
use crate::config::TrainConfig;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DeformationField, FieldContext, Result, Seed};
use rand::Rng;

/// Flicker of the field's motion: rms of its second difference from frame to frame over the rms of its deviation from the mean.
/// A straight or slowly curving path is near 0, white noise is sqrt(6). Sampled at up to 33 consecutive frames and 2,048 Gaussians.
pub fn flicker(field: &dyn DeformationField, means_world: Tensor<2>, frame_count: usize) -> Result<f32> {
    let n = means_world.dims()[0];
    let frames = frame_count.min(33);
    if n == 0 || frames < 4 {
        return Ok(0.0);
    }
    let features = field.spatial(means_world.narrow(0, 0, n.min(2048)))?.values;
    let mut paths: Vec<Vec<f32>> = Vec::new();
    for frame in 0..frames {
        let offsets = field.deform(features.clone(), frame as f32 / frame_count as f32)?;
        let Some(means) = offsets.means else { return Ok(0.0) };
        paths.push(to_vec(means, "offsets")?);
    }
    let (mut bend, mut spread) = (0.0f64, 0.0f64);
    for i in 0..paths[0].len() {
        let mean = paths.iter().map(|p| f64::from(p[i])).sum::<f64>() / frames as f64;
        spread += paths.iter().map(|p| (f64::from(p[i]) - mean).powi(2)).sum::<f64>() / frames as f64;
        bend += paths.windows(3).map(|w| (f64::from(w[0][i]) - 2.0 * f64::from(w[1][i]) + f64::from(w[2][i])).powi(2)).sum::<f64>() / (frames - 2) as f64;
    }
    Ok(if spread > 1e-12 { (bend / spread).sqrt() as f32 } else { 0.0 })
}

/// The smoothness term on a random quarter of the moving Gaussians: mean over them of |d - d'|^2 for a perturbation of position and time by
/// up to `smooth_delta` of the box and the sequence. The weight ramps linearly to `lambda_r` at the end of the stage.
pub fn smoothness(
    field: &dyn DeformationField,
    context: &FieldContext,
    means_world: Tensor<2>,
    time_norm: f32,
    config: &TrainConfig,
    progress: f64,
    seed: Seed,
) -> Result<Option<Tensor<1>>> {
    let n = means_world.dims()[0];
    let m = n.div_ceil(4);
    if m == 0 {
        return Ok(None);
    }
    let mut rng = seed.rng();
    let picked: Vec<i64> = (0..m).map(|_| rng.random_range(0..n as i64)).collect();
    let delta = config.smooth_delta;
    let shifts: Vec<f32> = (0..3 * m).map(|i| rng.random_range(-delta..=delta) * (context.box_max[i % 3] - context.box_min[i % 3])).collect();
    let time_shift = rng.random_range(-delta..=delta);
    let device = means_world.device();
    let rows = Rows::Some(Tensor::from_data(TensorData::new(picked, [m]), &device), m);
    let here = rows.select(means_world);
    let there = here.clone() + Tensor::<2>::from_data(TensorData::new(shifts, [m, 3]), &device);
    let d = field.deform(field.spatial(here)?.values, time_norm)?.concatenated();
    let d_shifted = field.deform(field.spatial(there)?.values, (time_norm + time_shift).clamp(0.0, 1.0))?.concatenated();
    let weight = f64::from(config.lambda_r) * progress / m as f64;
    Ok(match (d, d_shifted) {
        (Some(a), Some(b)) => {
            let difference = a - b;
            Some((difference.clone() * difference).sum().mul_scalar(weight))
        }
        _ => None,
    })
}
