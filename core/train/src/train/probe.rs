//! Views rendered without a gradient, to judge a model that is still in training.

use super::{Context, TrainState};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Error, Gaussians, Posed, Result, Scene, SpatialInput, Splats, ordered_sum};

/// Mean of all `values`, the same bits whatever the number of threads; `object` names it in errors.
pub(super) fn mean<const D: usize>(values: Tensor<D>, object: &str) -> Result<f32> {
    let count = values.dims().iter().product::<usize>();
    Ok(to_vec(ordered_sum(values), object)?.first().copied().unwrap_or(f32::NAN) / count as f32)
}

/// PSNR in dB of `image` against `target`, both `[3,H,W]`, unrounded, data range 1; at most 100 dB, where float32 images stop differing.
pub(super) fn psnr_db(image: Tensor<3>, target: Tensor<3>) -> Result<f32> {
    let difference = image - target;
    let error = mean(difference.clone() * difference, "mean squared error")?;
    // Unlike `max`, `clamp` leaves NaN as it is.
    Ok(-10.0 * error.clamp(1e-10, f32::INFINITY).log10())
}

/// The pose of `camera` as errors name it.
pub(super) fn broken_pose(camera: &Camera) -> String {
    format!("the corrected pose of camera {}", camera.name)
}

impl Context<'_> {
    /// The camera of `view` of `scene`, which has the views of the run, as the pose model corrects it; `None` where it is that of the scene.
    pub(crate) fn posed(&self, scene: &Scene, state: &TrainState, view: usize) -> Result<Option<Posed>> {
        let Some(&index) = self.training_camera.get(&scene.views[view].camera) else { return Ok(None) };
        state.poses.corrected(scene.camera(view), index)
    }
    /// The camera of `view` where the run believes it to be.
    ///
    /// # Errors
    /// [`Error::Backend`] for a corrected pose that is not finite or not rigid.
    pub(crate) fn camera_of(&self, scene: &Scene, state: &TrainState, view: usize) -> Result<Camera> {
        let Some(Posed { camera, .. }) = self.posed(scene, state, view)? else { return Ok(scene.camera(view).clone()) };
        if camera.validate().is_err() {
            return Err(Error::backend(
                broken_pose(&camera),
                "it is not finite, or not rigid",
                "Lower the learning rates of poses, or choose another pose model",
            ));
        }
        Ok(camera)
    }
    /// Renders what the cameras of views record at given times (0..1). `gaussians` have the rows of `state`. Hands the index of each request and planes
    /// `[3,H,W]` to `each`.
    pub(crate) fn draw(
        &self,
        state: &mut TrainState,
        gaussians: &Gaussians,
        requests: &[(usize, f32)],
        sh_degree: usize,
        each: impl FnMut(usize, Tensor<3>) -> Result<()>,
    ) -> Result<()> {
        self.draw_at_size_of(&self.job.scene, state, gaussians, requests, sh_degree, each)
    }
    /// As [`Context::draw`], with images of the size that those of `scene` have, which has the views of the run.
    fn draw_at_size_of(
        &self,
        scene: &Scene,
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
            let camera = self.camera_of(scene, state, view)?;
            let output = self.rasterizer.render(&Splats::from_gaussians(&drawn, sh_degree), &camera, &settings)?;
            let own = self.training_camera.get(&scene.views[view].camera).copied();
            each(index, state.appearance.apply(output.planes, own)?.narrow(0, 0, 3))?;
        }
        Ok(())
    }
    /// Mean PSNR in dB of `gaussians`, which have the rows of `state`, on `views` of `scene`: the scene of the run, or the same views with images of another size.
    /// Images are not rounded.
    pub(crate) fn mean_psnr(&self, scene: &Scene, state: &mut TrainState, gaussians: &Gaussians, views: &[usize], sh_degree: usize) -> Result<f32> {
        let rgb = self.job.config.background()?;
        let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
        let mut scores: Vec<f32> = Vec::with_capacity(views.len());
        self.draw_at_size_of(scene, state, gaussians, &requests, sh_degree, |index, image| {
            let target = self.rasterizer.upload(&scene.frame(views[index])?, rgb, &self.device);
            scores.push(psnr_db(image, target)?);
            Ok(())
        })?;
        Ok(scores.iter().sum::<f32>() / scores.len().max(1) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn psnr_ends_at_a_hundred_and_keeps_nan() {
        let image = |value: f32| Tensor::<3>::full([3, 4, 5], value, &Device::flex());
        let of = |value: f32| psnr_db(image(value), image(0.5)).unwrap();
        assert!((of(0.6) - 20.0).abs() < 1e-4, "{}", of(0.6));
        assert!((of(0.5) - 100.0).abs() < 1e-4, "{}", of(0.5));
        assert!(of(f32::NAN).is_nan());
    }
}
