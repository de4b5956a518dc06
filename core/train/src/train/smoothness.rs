//! Smoothness of the deformer (paper Equation "L_smooth") and the measurement that decides whether a scene needs it.

use crate::config::TrainConfig;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::playback::frame_time;
use cc4dgs_core::{Deformer, DeformerContext, Result, Seed, SpatialInput, ordered_sum};
use rand::Rng;

/// Flicker of the field's motion: rms of its second difference from frame to frame over the rms of its deviation from the mean.
/// A straight or slowly curving path is near 0, white noise is sqrt(6). Sampled at up to 33 consecutive frames and 2,048 Gaussians.
pub fn flicker(field: &dyn Deformer, input: &SpatialInput, frame_count: usize) -> Result<f32> {
    let n = input.len();
    let frames = frame_count.min(33);
    if n == 0 || frames < 4 {
        return Ok(0.0);
    }
    let features = field.spatial(&input.first(2048))?.values;
    let mut paths: Vec<Vec<f32>> = Vec::new();
    for frame in 0..frames {
        let offsets = field.deform(features.clone(), frame_time(frame, frame_count))?;
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
    field: &dyn Deformer,
    context: &DeformerContext,
    input: &SpatialInput,
    time_norm: f32,
    config: &TrainConfig,
    progress: f64,
    seed: Seed,
) -> Result<Option<Tensor<1>>> {
    let n = input.len();
    let m = n.div_ceil(4);
    if m == 0 {
        return Ok(None);
    }
    let mut rng = seed.rng();
    let picked: Vec<i64> = (0..m).map(|_| rng.random_range(0..n as i64)).collect();
    let delta = config.smooth_delta;
    let shifts: Vec<f32> = (0..3 * m).map(|i| rng.random_range(-delta..=delta) * (context.box_max[i % 3] - context.box_min[i % 3])).collect();
    let time_shift = rng.random_range(-delta..=delta);
    let device = input.means_world.device();
    let here = input.select(&Tensor::<1, Int>::from_data(TensorData::new(picked, [m]), &device));
    let shifted = here.means_world.clone() + Tensor::<2>::from_data(TensorData::new(shifts, [m, 3]), &device);
    let there = SpatialInput { means_world: shifted, attributes: here.attributes.clone() };
    let d = field.deform(field.spatial(&here)?.values, time_norm)?.concatenated();
    let d_shifted = field.deform(field.spatial(&there)?.values, (time_norm + time_shift).clamp(0.0, 1.0))?.concatenated();
    let weight = f64::from(config.lambda_r) * progress / m as f64;
    Ok(match (d, d_shifted) {
        (Some(a), Some(b)) => {
            let difference = a - b;
            Some(ordered_sum(difference.clone() * difference).mul_scalar(weight))
        }
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::{DeformerWork, Offsets, Parameter, ParameterGroup, SpatialFeatures};

    /// Moves everything away from the origin by a function of time, scaled by the canonical centre, and changes colours likewise.
    struct Along(fn(f32) -> f32);

    impl Deformer for Along {
        fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
            Ok(SpatialFeatures { values: input.means_world.clone(), work: DeformerWork::default() })
        }
        fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
            let moved = features.mul_scalar(self.0(time_norm));
            let sh = moved.clone().reshape([-1, 1, 3]).repeat_dim(1, 16);
            Ok(Offsets { means: Some(moved), sh: Some(sh), ..Offsets::default() })
        }
        fn parameters(&self) -> Vec<&Parameter> {
            Vec::new()
        }
        fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
            Vec::new()
        }
        fn groups(&self) -> Vec<ParameterGroup> {
            Vec::new()
        }
    }

    fn means() -> SpatialInput {
        SpatialInput::new(Tensor::from_floats([[1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-1.0, 0.0, 3.0]], &Device::flex()))
    }

    #[test]
    fn flicker_tells_jitter_from_motion() {
        let threshold = TrainConfig::default().flicker_threshold;
        let of = |path: fn(f32) -> f32| flicker(&Along(path), &means(), 30).unwrap();
        // At 30 frames: a sway of one cycle, a straight line, and a sign that flips with every frame.
        let (sway, line, jitter) = (of(|t| (std::f32::consts::TAU * t).sin()), of(|t| t), of(|t| if (t * 29.0).round() as i32 % 2 == 0 { 1.0 } else { -1.0 }));
        assert!(line < 1e-3 && sway < 0.1 && sway < threshold, "line {line}, sway {sway}");
        assert!((jitter - 4.0).abs() < 0.05 && jitter > threshold, "second differences of +-1 are 4: {jitter}");
        assert_eq!(of(|_| 0.3), 0.0, "what stands still does not flicker");
        assert_eq!(flicker(&Along(|t| t), &SpatialInput::new(Tensor::zeros([0, 3], &Device::flex())), 30).unwrap(), 0.0);
    }

    #[test]
    fn the_weight_ramps_and_a_constant_field_costs_nothing() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 30, sh_degree: 0, seed: Seed::root(1) };
        let config = TrainConfig { smooth_delta: 0.1, ..TrainConfig::default() };
        let term = |path: fn(f32) -> f32, progress: f64| {
            let term = smoothness(&Along(path), &context, &means(), 0.5, &config, progress, Seed::root(3)).unwrap().unwrap();
            to_vec(term, "smoothness").unwrap()[0]
        };
        let (half, whole) = (term(|t| t, 0.5), term(|t| t, 1.0));
        assert!(half > 0.0 && (whole / half - 2.0).abs() < 1e-4, "{half} and {whole}");
        assert_eq!(term(|_| 0.0, 1.0), 0.0);
    }

    #[test]
    fn the_penalty_does_not_depend_on_threads() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 30, sh_degree: 3, seed: Seed::root(1) };
        let config = TrainConfig { smooth_delta: 0.1, ..TrainConfig::default() };
        // More than 4 Mi numbers of a quarter of the Gaussians, from where burn adds in parallel.
        let count: usize = 4 * ((4 << 20) / 51 + 1);
        let centres: Vec<f32> = (0..3 * count as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 8) as f32 * 1e-7).collect();
        let found = [1, 2, 3, 5].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let input = SpatialInput::new(Tensor::from_data(TensorData::new(centres.clone(), [count, 3]), &Device::flex()));
                let term = smoothness(&Along(|t| t), &context, &input, 0.5, &config, 1.0, Seed::root(3)).unwrap().unwrap();
                to_vec(term, "smoothness").unwrap()[0]
            })
        });
        assert!(found[0] > 0.0 && found.iter().all(|term| term.to_bits() == found[0].to_bits()), "{found:?}");
    }
}
