//! The error of a layer half way between its samples, where players interpolate.

use super::functions::HeadFunctions;
use super::motion::Motion;
use super::rows::TrackBuilder;
use super::rows_at_once;
use super::tolerance::Tolerances;
use cc4dgs_core::Result;
use rayon::prelude::*;

/// Gaussians that are measured at most, evenly spread: enough that ten of them are over the 99th percentile.
const MEASURED: usize = 1024;

/// Errors over the tolerance, one per Gaussian: its largest half way between samples, all heads. Ascending.
pub(super) struct Between(Vec<f32>);

impl Between {
    fn of(mut errors: Vec<f32>) -> Self {
        errors.sort_by(f32::total_cmp);
        Self(errors)
    }
    /// The errors of a layer of `samples` times. `coded` and `functions` are its segments, each with all heads, and `ends` the samples between them.
    pub(super) fn measure(
        motion: &Motion,
        tolerances: &Tolerances,
        samples: usize,
        coded: &[Vec<TrackBuilder>],
        functions: &[Vec<HeadFunctions>],
        ends: &[usize],
    ) -> Result<Self> {
        let finer = 2 * samples - 1;
        let mut errors: Vec<f32> = Vec::new();
        for part in motion.rows_evenly(MEASURED).chunks(rows_at_once(motion, finer)) {
            let offsets = motion.evaluate(part, finer, tolerances)?;
            errors.par_extend(part.par_iter().enumerate().map(|(at, &row)| {
                let mut largest = 0.0f32;
                for ((tracks, functions), &first) in coded.iter().zip(functions).zip(ends) {
                    for ((track, functions), head) in tracks.iter().zip(functions).zip(&offsets.heads) {
                        largest = largest.max(track.error_between(row, functions, first, head, at));
                    }
                }
                largest
            }));
        }
        Ok(Self::of(errors))
    }
    /// The number of Gaussians that were measured.
    pub(super) fn measured(&self) -> usize {
        self.0.len()
    }
    pub(super) fn largest(&self) -> f32 {
        self.0.last().copied().unwrap_or(0.0)
    }
    /// The smallest error that 99 % of the Gaussians do not exceed.
    pub(super) fn percentile_99(&self) -> f32 {
        let rank = (99 * self.0.len()).div_ceil(100);
        self.0.get(rank.saturating_sub(1)).copied().unwrap_or(0.0)
    }
    /// The share of the Gaussians whose error is over `bound`, 0..1.
    pub(super) fn share_over(&self, bound: f32) -> f32 {
        let within = self.0.partition_point(|error| *error <= bound);
        (self.0.len() - within) as f32 / self.0.len().max(1) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentile_and_share_count_gaussians() {
        let between = Between::of((0..200).rev().map(|i| i as f32).collect());
        assert_eq!((between.measured(), between.largest(), between.percentile_99()), (200, 199.0, 197.0));
        assert_eq!((between.share_over(149.0), between.share_over(199.0), between.share_over(-1.0)), (0.25, 0.0, 1.0));
        let none = Between::of(Vec::new());
        assert_eq!((none.measured(), none.largest(), none.percentile_99(), none.share_over(1.0)), (0, 0.0, 0.0, 0.0));
    }
}
