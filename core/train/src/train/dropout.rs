//! Dropout of Gaussians: every view of training is drawn without some of them, chosen anew each time, and with the others more opaque (DropGaussian, Park et
//! al. 2025). A Gaussian that hides others from every training camera would get all the gradient; without it, those behind learn too.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::Seed;

/// Opacities stay between these, where their logits are finite.
const LEAST: f32 = 1e-6;
const MOST: f32 = 0.995;

/// The logits `[N]` a view is drawn with: a share `rate` (0..1) of the opacities is 0, the others are divided by 1 - `rate`.
pub(super) fn dropped(opacity_logits: Tensor<1>, rate: f64, seed: Seed) -> Tensor<1> {
    let [count] = opacity_logits.dims();
    if rate <= 0.0 || count == 0 {
        return opacity_logits;
    }
    let kept = factors(count, rate, seed, &opacity_logits.clone().inner().device());
    let opacities = (burn::tensor::activation::sigmoid(opacity_logits) * Tensor::from_inner(kept)).clamp(LEAST, MOST);
    opacities.clone().log() - (-opacities).add_scalar(1.0).log()
}

/// 0 for what is dropped, 1 / (1 - `rate`) for what is not `[count]`.
fn factors(count: usize, rate: f64, seed: Seed, device: &Device) -> Tensor<1> {
    let least = (rate * u64::MAX as f64) as u64;
    let kept = (1.0 / (1.0 - rate)) as f32;
    let factors: Vec<f32> = (0..count as u64).map(|i| if seed.index(i).value() < least { 0.0 } else { kept }).collect();
    Tensor::from_data(TensorData::new(factors, [count]), device)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_is_dropped_and_the_rest_keeps_the_sum() {
        let device = Device::flex();
        let seed = Seed::root(3).child("test");
        let factors: Vec<f32> = factors(10_000, 0.2, seed, &device).into_data().to_vec().unwrap();
        let dropped = factors.iter().filter(|f| **f == 0.0).count();
        assert!((1_800..2_200).contains(&dropped), "{dropped}");
        assert!((factors.iter().sum::<f32>() / 1e4 - 1.0).abs() < 0.03);
    }

    #[test]
    fn logits_stay_finite_and_without_dropout_the_same() {
        let device = Device::flex();
        let logits = Tensor::<1>::from_data(TensorData::new(vec![-40.0f32, -2.0, 0.0, 3.0, 40.0], [5]), &device);
        let same: Vec<f32> = dropped(logits.clone(), 0.0, Seed::root(0)).into_data().to_vec().unwrap();
        assert_eq!(same, [-40.0, -2.0, 0.0, 3.0, 40.0]);
        for seed in 0..8 {
            let drawn: Vec<f32> = dropped(logits.clone(), 0.5, Seed::root(seed)).into_data().to_vec().unwrap();
            assert!(drawn.iter().all(|l| l.is_finite() && *l < 6.0), "{drawn:?}");
        }
    }
}
