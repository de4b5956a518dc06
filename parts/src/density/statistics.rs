//! Statistics summed over the views between two rounds, on the device.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::view_sums::add_gradients;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Error, Result, ViewStatistics};

/// Sums over the views since the last round.
pub(super) struct Statistics {
    /// Sum of the norms of screen gradients, in normalised device coordinates, and views that saw the Gaussian `[N,2]`.
    pub gradients: Tensor<2>,
    /// Largest blending weight since the last weight pruning; 0 in controls that do not prune by it `[N]`.
    pub max_weight: Tensor<1>,
}

impl Statistics {
    /// Zeros for `count` Gaussians.
    pub fn zeros(count: usize, device: &Device) -> Self {
        Self { gradients: Tensor::zeros([count, 2], device), max_weight: Tensor::zeros([count], device) }
    }
    /// Adds the screen gradients of one view: the absolute ones where they were collected, else the signed ones.
    pub fn add_gradients(&mut self, view: &ViewStatistics) -> Result<()> {
        if let Some(gradient) = view.absolute_screen_gradient.as_ref().or(view.screen_gradient.as_ref()) {
            // Converts the gradient per pixel of a loss divided by the number of views to the gradient of the view's own loss per unit of normalised device
            // coordinates.
            let scale = view.views as f32 * 0.5;
            let scale = [scale * view.size.0 as f32, scale * view.size.1 as f32];
            // Moved out, so that this is the only reference and the kernel changes the tensor in place.
            let sums = std::mem::replace(&mut self.gradients, Tensor::empty([0, 2], &gradient.device()));
            self.gradients = add_gradients(sums, view.radii.clone(), gradient.clone(), scale)?;
        }
        Ok(())
    }
    /// Raises the largest blending weights to those of one view, where they were collected.
    pub fn add_weights(&mut self, view: &ViewStatistics) {
        if let Some(weights) = &view.max_weights {
            self.max_weight.inplace(|largest| largest.max_pair(weights.clone()));
        }
    }
    /// Mean norm of the screen gradient over the views that saw a Gaussian; 0 where none did `[N]`.
    pub fn mean_gradients(&self) -> Result<Vec<f32>> {
        let sums = to_vec(self.gradients.clone(), "screen gradients")?;
        Ok(sums.as_chunks::<2>().0.iter().map(|[sum, seen]| if *seen > 0.0 { sum / seen } else { 0.0 }).collect())
    }
    /// The number of Gaussians.
    pub fn len(&self) -> usize {
        self.max_weight.dims()[0]
    }
    /// The statistics with which the Gaussians of `plan` start. Gradients start from zero after every round, weights after a weight pruning. New Gaussians have
    /// no weights yet; weight 1 protects them from the next weight pruning.
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
        let column = |k| self.gradients.clone().narrow(1, k, 1).squeeze_dim(1);
        vec![("gradient_sum".into(), column(0)), ("seen".into(), column(1)), ("max_weight".into(), self.max_weight.clone())]
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
        Ok(Self { gradients: Tensor::stack(vec![take("gradient_sum")?, take("seen")?], 1), max_weight: take("max_weight")? })
    }
}
