//! Blending weights over views: which Gaussians are hidden, faint or covered.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::view_sums::add_weights;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Result, ViewStatistics};

/// Share of the sums of blending weights that is kept after a round, because one round does not draw every view.
const MEMORY: f32 = 0.7;
/// Rounds after which a Gaussian is judged by its blending weights: until then, halves are fainter than after training.
const LEAST_ROUNDS: f32 = 3.0;

/// Blending weights of N Gaussians: sums over views, which decay with every round.
pub(super) struct Weights {
    /// Of the largest weight, of its square, and of views that show the Gaussian `[N,3]`.
    pub sums: Tensor<2>,
    /// Rounds since the Gaussian was new `[N]`.
    pub rounds: Vec<f32>,
}

impl Weights {
    pub fn zeros(count: usize, device: &Device) -> Self {
        Self { sums: Tensor::zeros([count, 3], device), rounds: vec![0.0; count] }
    }
    pub fn add(&mut self, view: &ViewStatistics) -> Result<()> {
        if let Some(weights) = &view.max_weights {
            // Moved out, so that this is the only reference and the kernel changes the tensor in place.
            let sums = std::mem::replace(&mut self.sums, Tensor::empty([0, 3], &weights.device()));
            self.sums = add_weights(sums, view.radii.clone(), weights.clone())?;
        }
        Ok(())
    }
    /// Of the rows that can be judged, up to `most` with the smallest weights, the smallest first. A row's weight is its sum of squares over its sum, so
    /// that Gaussians that are bright for a short time, or from one side, have large weights.
    pub fn smallest(&self, most: usize) -> Result<Vec<usize>> {
        let sums = to_vec(self.sums.clone(), "blending weights")?;
        let weight = |row: usize| sums[3 * row + 1] / sums[3 * row].max(f32::MIN_POSITIVE);
        let mut rows: Vec<usize> = (0..self.rounds.len()).filter(|&row| self.rounds[row] >= LEAST_ROUNDS && sums[3 * row + 2] > 0.0).collect();
        rows.sort_by(|&a, &b| weight(a).total_cmp(&weight(b)).then(a.cmp(&b)));
        rows.truncate(most);
        Ok(rows)
    }
    /// The sums of the Gaussians of `plan`; those of new ones are 0. Sums decay and rounds are counted only for a `round` of this control: the trainer makes
    /// plans at any time.
    pub fn after(&self, plan: &DensityPlan, round: bool, device: &Device) -> Result<Self> {
        let (share, passed) = if round { (MEMORY, 1.0) } else { (1.0, 0.0) };
        let (old, rows) = (to_vec(self.sums.clone(), "blending weights")?, || plan.parents().iter().zip(plan.fresh()));
        let of = |(&parent, &fresh): (&usize, &bool)| std::array::from_fn::<f32, 3, _>(|k| if fresh { 0.0 } else { share * old[3 * parent + k] });
        let sums = Tensor::from_data(TensorData::new(rows().flat_map(of).collect(), [plan.len(), 3]), device);
        Ok(Self { sums, rounds: rows().map(|(&parent, &fresh)| if fresh { 0.0 } else { self.rounds[parent] + passed }).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::density::seen;

    #[test]
    fn who_is_hidden_is_judged_after_some_rounds() {
        let device = Device::flex();
        let mut weights = Weights::zeros(4, &device);
        let view = |largest: &[f32], radii: &[i64]| {
            let mut view = seen(radii, &device);
            view.max_weights = Some(Tensor::from_floats(largest, &device));
            view
        };
        weights.add(&view(&[0.5, 0.1, 0.0, 0.9], &[3, 3, 3, 0])).unwrap();
        assert!(weights.smallest(9).unwrap().is_empty(), "all are new");
        weights.rounds = vec![3.0; 4];
        // The last one was never shown, so it is not judged.
        assert_eq!((weights.smallest(9).unwrap(), weights.smallest(1).unwrap()), (vec![2, 1, 0], vec![2]));
        let mut plan = DensityPlan::new();
        plan.keep(1);
        plan.copy(0);
        plan.keep(0);
        let mut after = weights.after(&plan, true, &device).unwrap();
        assert_eq!((after.rounds.as_slice(), after.smallest(9).unwrap()), (&[4.0, 0.0, 4.0][..], vec![0, 2]));
        // A plan of the trainer does not decay the sums.
        let other = weights.after(&plan, false, &device).unwrap();
        assert_eq!((other.rounds.as_slice(), other.smallest(9).unwrap()), (&[3.0, 0.0, 3.0][..], vec![0, 2]));
        assert_eq!(to_vec(other.sums, "sums").unwrap()[..3], to_vec(weights.sums.clone(), "sums").unwrap()[3..6]);
        (0..3).for_each(|_| after.add(&view(&[0.9, 0.0, 0.1], &[1, 1, 1])).unwrap());
        assert_eq!(after.smallest(9).unwrap(), [2, 0]);
    }
}
