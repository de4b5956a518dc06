//! Views rendered without a gradient, to judge a model that is still in training.

use super::{Context, TrainState};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Gaussians, Result, SpatialInput, Splats};

impl Context<'_> {
    /// Renders what the cameras of views record at given times (0..1). `gaussians` have the rows of `state`. Hands the index of each request and planes
    /// `[3,H,W]` to `each`.
    pub(crate) fn draw(
        &self,
        state: &mut TrainState,
        gaussians: &Gaussians,
        requests: &[(usize, f32)],
        sh_degree: usize,
        mut each: impl FnMut(usize, Tensor<3>) -> Result<()>,
    ) -> Result<()> {
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
        for (index, &(view, time_norm)) in requests.iter().enumerate() {
            let drawn = match (&features, deformer) {
                (Some(features), Some(deformer)) => deformer.field.deform(features.clone(), time_norm)?.apply(deformer.name(), gaussians, rows.indices())?,
                _ => gaussians.clone(),
            };
            let output = self.rasterizer.render(&Splats::from_gaussians(&drawn, sh_degree), self.job.scene.camera(view), &settings)?;
            let camera = self.training_camera.get(&self.job.scene.views[view].camera).copied();
            each(index, state.appearance.apply(output.planes, camera)?.narrow(0, 0, 3))?;
        }
        Ok(())
    }
    /// PSNR in dB of each of `views`, images not rounded. `gaussians` have the rows of `state`.
    pub(crate) fn psnr_of_views(&self, state: &mut TrainState, gaussians: &Gaussians, views: &[usize], sh_degree: usize) -> Result<Vec<f32>> {
        let rgb = self.job.config.background()?;
        let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, self.job.scene.views[view].time_norm)).collect();
        let mut scores = Vec::with_capacity(views.len());
        self.draw(state, gaussians, &requests, sh_degree, |index, image| {
            let target = self.rasterizer.upload(&self.job.scene.frame(views[index])?, rgb, &self.device);
            let difference = image - target;
            let mse = to_vec((difference.clone() * difference).mean(), "mean squared error")?;
            // Unlike `max`, `clamp` leaves NaN as it is.
            scores.push(-10.0 * mse.first().copied().unwrap_or(f32::NAN).clamp(1e-10, f32::INFINITY).log10());
            Ok(())
        })?;
        Ok(scores)
    }
    /// Mean PSNR in dB of `gaussians` on `views`.
    pub(crate) fn mean_psnr(&self, state: &mut TrainState, gaussians: &Gaussians, views: &[usize], sh_degree: usize) -> Result<f32> {
        let scores = self.psnr_of_views(state, gaussians, views, sh_degree)?;
        Ok(scores.iter().sum::<f32>() / scores.len().max(1) as f32)
    }
}
