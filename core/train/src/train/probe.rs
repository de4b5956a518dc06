//! Training views rendered without a gradient, to judge what was done to the Gaussians.

use super::{Context, TrainState};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Gaussians, Result, SpatialInput, Splats};

impl Context<'_> {
    /// `count` of `views`, evenly spread.
    pub(crate) fn evenly(views: &[usize], count: usize) -> Vec<usize> {
        let count = count.min(views.len());
        (0..count).map(|i| views[(2 * i + 1) * views.len() / (2 * count)]).collect()
    }
    /// PSNR in dB of each of `views`, images not rounded. `gaussians` have the rows of `state`.
    pub(crate) fn psnr_of_views(&self, state: &mut TrainState, gaussians: &Gaussians, views: &[usize], sh_degree: usize) -> Result<Vec<f32>> {
        let rows = state.moving_rows(&self.device)?;
        let deformer = state.deformer.as_ref().filter(|d| !d.field.is_static() && rows.count() > 0);
        let features = match deformer {
            Some(deformer) => {
                let wanted = deformer.field.attributes();
                let attributes = wanted.iter().filter_map(|a| gaussians.attribute(&a.name)).map(|values| rows.select(values)).collect();
                Some(deformer.field.spatial(&SpatialInput { means_world: rows.select(gaussians.means.clone()), attributes })?.values)
            }
            None => None,
        };
        let rgb = self.job.config.background()?;
        let settings = self.job.config.render.settings(Some(Tensor::from_data(TensorData::new(rgb.to_vec(), [3]), &self.device)));
        let mut scores = Vec::with_capacity(views.len());
        for &view in views {
            let own = &self.job.scene.views[view];
            let drawn = match (&features, deformer) {
                (Some(features), Some(deformer)) => {
                    deformer.field.deform(features.clone(), own.time_norm)?.apply(deformer.name(), gaussians, rows.indices())?
                }
                _ => gaussians.clone(),
            };
            let output = self.rasterizer.render(&Splats::from_gaussians(&drawn, sh_degree), self.job.scene.camera(view), &settings)?;
            let planes = state.appearance.apply(output.planes, self.training_camera.get(&own.camera).copied())?;
            let target = self.rasterizer.upload(&self.job.scene.frame(view)?, rgb, &self.device);
            let difference = planes.narrow(0, 0, 3) - target;
            let mse = to_vec((difference.clone() * difference).mean(), "mean squared error")?;
            scores.push(-10.0 * mse.first().copied().unwrap_or(f32::NAN).max(1e-10).log10());
        }
        Ok(scores)
    }
    /// Mean PSNR in dB of `gaussians` on `views`.
    pub(crate) fn mean_psnr(&self, state: &mut TrainState, gaussians: &Gaussians, views: &[usize], sh_degree: usize) -> Result<f32> {
        let scores = self.psnr_of_views(state, gaussians, views, sh_degree)?;
        Ok(scores.iter().sum::<f32>() / scores.len().max(1) as f32)
    }
}
