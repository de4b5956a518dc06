//! Images of a model that is still in training.

use crate::train::{Context, TrainState};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Result, Splats};

impl Context<'_> {
    /// Draws what `state` looks like for the cameras of views at given times (0..1), without gradients, as training cameras record it. Hands the index of each
    /// request and planes `[3,H,W]` to `each`. Nothing that training depends on changes.
    pub(crate) fn draw(&self, state: &mut TrainState, requests: &[(usize, f32)], mut each: impl FnMut(usize, Vec<f32>) -> Result<()>) -> Result<()> {
        let rows = state.moving_rows(&self.device)?;
        let gaussians = state.set.gaussians()?;
        let deformer = state.deformer.as_ref().filter(|d| !d.field.is_static() && rows.count() > 0);
        let moving = match deformer {
            Some(deformer) => Some((deformer, deformer.field.spatial(&state.spatial_input(deformer, &rows)?)?.values)),
            None => None,
        };
        let background = Tensor::<1>::from_data(TensorData::new(self.job.config.background()?.to_vec(), [3]), &self.device);
        let settings = self.job.config.render.settings(Some(background));
        for (index, &(view, time_norm)) in requests.iter().enumerate() {
            let drawn = match &moving {
                Some((deformer, features)) => deformer.field.deform(features.clone(), time_norm)?.apply(deformer.name(), &gaussians, rows.indices())?,
                None => gaussians.clone(),
            };
            let splats = Splats::from_gaussians(&drawn, state.set.sh_degree);
            let output = self.rasterizer.render(&splats, self.job.scene.camera(view), &settings)?;
            let camera = self.training_camera.get(&self.job.scene.views[view].camera).copied();
            let planes = state.appearance.apply(output.planes, camera)?;
            each(index, to_vec(planes.narrow(0, 0, 3), "drawn view")?)?;
        }
        Ok(())
    }
}
