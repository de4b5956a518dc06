//! Blending weights over views: which Gaussians are hidden, faint or covered.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::view_sums::add_weights;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Result, ViewStatistics};

/// Share of the sums of blending weights that a round leaves to the next: a round alone has not seen every view.
const MEMORY: f32 = 0.7;
/// Rounds after which a Gaussian is judged by its blending weights: until then, halves are still fainter than they will be.
const LEAST_ROUNDS: f32 = 3.0;

/// What is remembered of the blending weights of N Gaussians: sums over views, of which every round leaves a share to the next.
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
            // Moved out, so that nobody else holds it and it is changed in place.
            let sums = std::mem::replace(&mut self.sums, Tensor::empty([0, 3], &weights.device()));
            self.sums = add_weights(sums, view.radii.clone(), weights.clone())?;
        }
        Ok(())
    }
    /// Of the rows that can be judged, at most so many with the smallest weights, the smallest first. Weights are averaged with themselves as shares: what is bright
    /// for a short time, or on one side, counts by that.
    pub fn smallest(&self, most: usize) -> Result<Vec<usize>> {
        let sums = to_vec(self.sums.clone(), "blending weights")?;
        let weight = |row: usize| sums[3 * row + 1] / sums[3 * row].max(f32::MIN_POSITIVE);
        let mut rows: Vec<usize> = (0..self.rounds.len()).filter(|&row| self.rounds[row] >= LEAST_ROUNDS && sums[3 * row + 2] > 0.0).collect();
        rows.sort_by(|&a, &b| weight(a).total_cmp(&weight(b)).then(a.cmp(&b)));
        rows.truncate(most);
        Ok(rows)
    }
    /// What the Gaussians of `plan` go on with; new ones with nothing. Only a `round` of this control leaves a share and counts: plans of others come at any time.
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
        // The last one was never shown, so nobody can tell.
        assert_eq!((weights.smallest(9).unwrap(), weights.smallest(1).unwrap()), (vec![2, 1, 0], vec![2]));
        let mut plan = DensityPlan::new();
        plan.keep(1);
        plan.copy(0);
        plan.keep(0);
        let mut after = weights.after(&plan, true, &device).unwrap();
        assert_eq!((after.rounds.as_slice(), after.smallest(9).unwrap()), (&[4.0, 0.0, 4.0][..], vec![0, 2]));
        // A plan of somebody else takes nothing from what is known.
        let other = weights.after(&plan, false, &device).unwrap();
        assert_eq!((other.rounds.as_slice(), other.smallest(9).unwrap()), (&[3.0, 0.0, 3.0][..], vec![0, 2]));
        assert_eq!(to_vec(other.sums, "sums").unwrap()[..3], to_vec(weights.sums.clone(), "sums").unwrap()[3..6]);
        (0..3).for_each(|_| after.add(&view(&[0.9, 0.0, 0.1], &[1, 1, 1])).unwrap());
        assert_eq!(after.smallest(9).unwrap(), [2, 0]);
    }
}
