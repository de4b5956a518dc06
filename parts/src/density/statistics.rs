//! Statistics summed over the views between two rounds, on the device.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Error, Result, ViewStatistics};

/// Sums over the views since the last round.
pub(super) struct Statistics {
    /// Sum of the norms of screen gradients, in normalised device coordinates `[N]`.
    pub gradient_sum: Tensor<1>,
    /// Views that saw the Gaussian `[N]`.
    pub seen: Tensor<1>,
    /// Largest blending weight since the last weight pruning `[N]`.
    pub max_weight: Tensor<1>,
}

impl Statistics {
    /// Zeros for `count` Gaussians.
    pub fn zeros(count: usize, device: &Device) -> Self {
        let zeros = || Tensor::<1>::zeros([count], device);
        Self { gradient_sum: zeros(), seen: zeros(), max_weight: zeros() }
    }
    /// Adds one view: its absolute screen gradients where they were collected, else the signed ones.
    pub fn add(&mut self, view: &ViewStatistics) {
        if let Some(gradient) = view.absolute_screen_gradient.as_ref().or(view.screen_gradient.as_ref()) {
            let n = gradient.dims()[0];
            // Converts the gradient per pixel of a loss divided by the number of views to the gradient of the view's own loss per unit of normalised device coordinates.
            let scale = view.views as f32 * 0.5;
            let axis = |k: usize, side: u32| gradient.clone().narrow(1, k, 1).reshape([n]).mul_scalar(scale * side as f32);
            let (x, y) = (axis(0, view.size.0), axis(1, view.size.1));
            let norm = (x.clone() * x + y.clone() * y).sqrt();
            let visible = view.radii.clone().greater_elem(0).float();
            self.gradient_sum.inplace(|sum| sum + norm * visible.clone());
            self.seen.inplace(|seen| seen + visible);
        }
        if let Some(weights) = &view.max_weights {
            self.max_weight.inplace(|largest| largest.max_pair(weights.clone()));
        }
    }
    /// Mean norm of the screen gradient over the views that saw a Gaussian; 0 where none did `[N]`.
    pub fn mean_gradients(&self) -> Result<Vec<f32>> {
        let (sums, seen) = (to_vec(self.gradient_sum.clone(), "screen gradients")?, to_vec(self.seen.clone(), "screen counts")?);
        Ok(sums.into_iter().zip(seen).map(|(sum, seen)| if seen > 0.0 { sum / seen } else { 0.0 }).collect())
    }
    /// The statistics with which the Gaussians of `plan` start. Gradients start from zero after every round, weights after a weight pruning. New Gaussians have no
    /// weights yet; weight 1 protects them from the next weight pruning.
    pub fn after(&self, plan: &DensityPlan, weights_restart: bool, device: &Device) -> Result<Self> {
        let count = plan.len();
        let mut next = Self::zeros(count, device);
        if !weights_restart {
            let weights = to_vec(self.max_weight.clone(), "blending weights")?;
            let rows = plan.parents().iter().zip(plan.fresh());
            let inherited: Vec<f32> = rows.map(|(&parent, &fresh)| if fresh { 1.0 } else { weights[parent].min(1.0) }).collect();
            next.max_weight = Tensor::from_data(TensorData::new(inherited, [count]), device);
        }
        Ok(next)
    }
    /// The arrays by name.
    pub fn arrays(&self) -> Vec<(String, Tensor<1>)> {
        vec![("gradient_sum".into(), self.gradient_sum.clone()), ("seen".into(), self.seen.clone()), ("max_weight".into(), self.max_weight.clone())]
    }
    /// The arrays of [`Statistics::arrays`] for `count` Gaussians.
    pub fn from_arrays(arrays: Vec<(String, Tensor<1>)>, count: usize) -> Result<Self> {
        let damaged =
            |name: &str, problem: String| Error::data(format!("density state '{name}'"), problem, "The checkpoint is damaged or of another density control");
        if arrays.len() != 3 {
            return Err(damaged("statistics", format!("there are {} arrays, expected 3", arrays.len())));
        }
        let take = |name: &str| match arrays.iter().find(|(n, _)| n == name) {
            Some((_, values)) if values.dims() == [count] => Ok(values.clone()),
            Some((_, values)) => Err(damaged(name, format!("it has {} values for {count} Gaussians", values.dims()[0]))),
            None => Err(damaged(name, "it is missing".into())),
        };
        Ok(Self { gradient_sum: take("gradient_sum")?, seen: take("seen")?, max_weight: take("max_weight")? })
    }
}
