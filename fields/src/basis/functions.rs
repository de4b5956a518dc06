//! The functions of time that all Gaussians share: a constant, t, Fourier bands, cubic B-splines, and functions learned by a small network.

use crate::forward::network;
use crate::networks::ReluShape;
use crate::time::encode_scaled;
use std::sync::Arc;

/// Falloff of the network's input bands. It favours smooth functions, so that the network does not fit each training time separately.
const NETWORK_FALLOFF: f32 = 1.0;

/// The functions, in this order: the constant, t, a sine and a cosine per band, the splines, the learned ones.
#[derive(Clone, Debug)]
pub struct TemporalFunctions {
    /// Fourier bands of 1, 2, 4… times `cycles` cycles per sequence.
    pub bands: usize,
    /// Cycles of the lowest band. Sums of whole cycles have the same value and slope at both ends of the sequence, which real motion does not; with half a
    /// cycle they may differ.
    pub cycles: f32,
    /// The amplitude of each band is 2^-falloff times that of the next lower one.
    pub falloff: f32,
    /// Number of cubic B-splines over the sequence: 0 or at least 4.
    pub splines: usize,
    /// The network from time to the learned functions.
    pub network: Option<Arc<ReluShape>>,
}

impl TemporalFunctions {
    /// Inputs of the network: t and the bands.
    pub fn encoding(bands: usize) -> usize {
        1 + 2 * bands
    }
    fn learned(&self) -> usize {
        self.network.as_ref().and_then(|n| n.output_widths().first().copied()).unwrap_or(0)
    }
    /// The number of functions.
    pub fn count(&self) -> usize {
        1 + Self::encoding(self.bands) + self.splines + self.learned()
    }
    /// The penalty of each function in the group lasso: 1, but cycles times amplitude for the bands, because high bands move fast.
    pub fn prices(&self) -> Vec<f32> {
        let fourier = (0..self.bands).flat_map(|band| [self.cycles * (band as f32 * (1.0 - self.falloff)).exp2(); 2]);
        [1.0, 1.0].into_iter().chain(fourier).chain(std::iter::repeat_n(1.0, self.splines + self.learned())).collect()
    }
    /// All functions but the learned ones at `time_norm` (0..1).
    pub fn plain(&self, time_norm: f32) -> Vec<f32> {
        [1.0].into_iter().chain(self.encoded(time_norm, self.falloff)).chain(splines_at(time_norm, self.splines)).collect()
    }
    /// What the network of the learned functions reads.
    pub fn network_input(&self, time_norm: f32) -> Vec<f32> {
        self.encoded(time_norm, NETWORK_FALLOFF)
    }
    /// All functions at `times_norm`, `[times, functions]`. `weights` are those of the network, if there is one.
    pub fn at(&self, times_norm: &[f32], weights: &[f32]) -> Vec<Vec<f32>> {
        let learned = self.network.as_ref().map(|shape| {
            let inputs: Vec<f32> = times_norm.iter().flat_map(|&t| self.network_input(t)).collect();
            network(shape, weights, &inputs).concat()
        });
        let learned = learned.unwrap_or_default();
        let of = |k: usize| &learned[k * self.learned()..(k + 1) * self.learned()];
        times_norm.iter().enumerate().map(|(k, &t)| [self.plain(t).as_slice(), of(k)].concat()).collect()
    }
    /// t and the bands; the amplitude of each band is 2^-falloff times that of the next lower one.
    fn encoded(&self, time_norm: f32, falloff: f32) -> Vec<f32> {
        encode_scaled(time_norm, self.bands, self.cycles, falloff)
    }
}

/// `count` uniform cubic B-splines over 0..1. Each is non-zero on at most four of the `count` - 3 intervals; together they sum to 1.
fn splines_at(time_norm: f32, count: usize) -> Vec<f32> {
    let position = f64::from(time_norm.clamp(0.0, 1.0)) * count.saturating_sub(3) as f64;
    let spline = |i: usize| {
        let x = (position - (i as f64 - 1.0)).abs();
        let value = if x < 1.0 { 2.0 / 3.0 - x * x + x * x * x / 2.0 } else { (2.0 - x).max(0.0).powi(3) / 6.0 };
        value as f32
    };
    (0..count).map(spline).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn splines_add_up_to_one_and_only_four_are_at_work() {
        for step in 0..=100 {
            let values = splines_at(step as f32 / 100.0, 9);
            assert!((values.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{step}: {values:?}");
            assert!(values.iter().filter(|v| **v > 0.0).count() <= 4);
            assert!(values.iter().all(|v| *v >= 0.0));
        }
        assert!(splines_at(0.5, 0).is_empty());
    }

    #[test]
    fn bands_fall_off_by_octaves() {
        let functions = TemporalFunctions { bands: 3, cycles: 1.0, falloff: 0.5, splines: 4, network: None };
        let values = functions.at(&[0.2], &[]).remove(0);
        assert_eq!(values.len(), functions.count());
        assert_eq!(functions.prices().len(), functions.count());
        let angle = std::f32::consts::TAU * 0.2;
        let bands = [0.2, angle.sin(), angle.cos(), (2.0 * angle).sin(), (2.0 * angle).cos()];
        let smooth = functions.encoded(0.2, NETWORK_FALLOFF);
        for (k, want) in bands.into_iter().enumerate() {
            let octave = if k > 2 { 2.0f32 } else { 1.0 };
            assert!((values[k + 1] - want / octave.sqrt()).abs() < 1e-6, "{values:?}");
            assert!((smooth[k] - want / octave).abs() < 1e-6, "{smooth:?}");
        }
        // Half a cycle: the ends differ, and t is t.
        let half = TemporalFunctions { cycles: 0.5, ..functions };
        let [start, end] = [0.0, 1.0].map(|t| half.encoded(t, 0.0));
        assert!((end[0], start[0]) == (1.0, 0.0) && (start[2] - 1.0).abs() < 1e-6 && (end[2] + 1.0).abs() < 1e-6, "{start:?} {end:?}");
        assert!((half.prices()[2] - 0.5).abs() < 1e-6);
    }
}
