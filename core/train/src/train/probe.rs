//! Views rendered without a gradient, to judge a model that is still in training.

use super::{Context, TrainState};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Error, Gaussians, Posed, Poses, Result, Scene, SpatialInput, Splats, ordered_sum};
use std::collections::BTreeMap;
use std::sync::Arc;

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

/// The corrected camera.
///
/// # Errors
/// [`Error::Backend`] for a pose that is not finite or not rigid.
fn sound(Posed { camera, .. }: Posed) -> Result<Camera> {
    if camera.validate().is_err() {
        let remedy = "Lower the learning rates of poses, or choose another pose model";
        return Err(Error::backend(broken_pose(&camera), "it is not finite, or not rigid", remedy));
    }
    Ok(camera)
}

/// `scene` with its training cameras (their indices by index in the scene) as `poses` corrects them, and the same images; `scene` itself if it corrects none.
fn posed_scene(scene: &Arc<Scene>, training_camera: &BTreeMap<usize, usize>, poses: &dyn Poses) -> Result<Arc<Scene>> {
    let mut corrected = Vec::new();
    for (&camera, &index) in training_camera {
        if let Some(posed) = poses.corrected(&scene.cameras[camera], index)? {
            corrected.push((camera, sound(posed)?));
        }
    }
    if corrected.is_empty() {
        return Ok(scene.clone());
    }
    let mut posed = Scene::clone(scene);
    for (camera, own) in corrected {
        posed.cameras[camera] = own;
    }
    Ok(Arc::new(posed))
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
        self.posed(scene, state, view)?.map_or_else(|| Ok(scene.camera(view).clone()), sound)
    }
    /// `scene`, which has the cameras of the run at some size of images, with each training camera where the run believes it to be. Images are shared with
    /// `scene`. For what reads cameras from a scene: [`Context::camera_of`] and [`Context::draw`] would correct them a second time.
    ///
    /// # Errors
    /// As [`Context::camera_of`].
    pub(crate) fn posed_scene(&self, scene: &Arc<Scene>, state: &TrainState) -> Result<Arc<Scene>> {
        posed_scene(scene, &self.training_camera, state.poses.as_ref())
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
    /// Mean PSNR in dB of `gaussians`, which have the rows of `state`, on `views` of `scene`: the scene of the run, or the same views with images of another
    /// size. Images are not rounded.
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
    use super::super::training_cameras;
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::{FrameSource, Image8, Split, View};
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Moves the training cameras from the second one on along their x axes.
    struct Shifted(f64);

    impl Poses for Shifted {
        fn corrected(&self, camera: &Camera, index: usize) -> Result<Option<Posed>> {
            let mut camera = camera.clone();
            camera.world_to_camera[0][3] += self.0;
            Ok((index > 0).then(|| Posed { camera, probe: Tensor::zeros([4, 4], &Device::flex()) }))
        }
    }

    /// Black images of 4x2 pixels; counts how many are loaded.
    #[derive(Default)]
    struct Counted(AtomicUsize);

    impl FrameSource for Counted {
        fn load(&self, _: usize) -> Result<Image8> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(Image8 { width: 4, height: 2, channels: 3, data: vec![0; 24] })
        }
    }

    #[test]
    fn a_posed_scene_has_corrected_training_cameras_and_the_same_images() {
        let source = Arc::new(Counted::default());
        let scene = |splits: &[Split]| {
            let camera = |k: usize| Camera::look_at(&format!("c{k}"), (4, 2), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let views = splits.iter().enumerate().map(|(camera, &split)| View { camera, frame: 0, time_norm: 0.0, split }).collect();
            Arc::new(Scene::new("s", (0..splits.len()).map(camera).collect(), views, source.clone(), 1000).unwrap())
        };
        let of = |scene: &Arc<Scene>, shift: f64| posed_scene(scene, &training_cameras(scene), &Shifted(shift));
        // The second training camera is the third one of the scene.
        let three = scene(&[Split::Train, Split::Test, Split::Train]);
        let posed = of(&three, 0.5).unwrap();
        let moved = |k: usize| posed.cameras[k].world_to_camera[0][3] - three.cameras[k].world_to_camera[0][3];
        assert!(moved(0) == 0.0 && moved(1) == 0.0 && (moved(2) - 0.5).abs() < 1e-12, "{:?}", [0, 1, 2].map(moved));
        assert!(three.frame(2).is_ok() && posed.frame(2).is_ok());
        assert_eq!(source.0.load(Ordering::Relaxed), 1, "the scenes share their cache");
        let message = of(&three, f64::NAN).err().unwrap().to_string();
        assert!(message.contains("the corrected pose of camera c2"), "{message}");
        let one = scene(&[Split::Train, Split::Test]);
        assert!(Arc::ptr_eq(&of(&one, 0.5).unwrap(), &one), "no camera is corrected");
    }

    #[test]
    fn psnr_ends_at_a_hundred_and_keeps_nan() {
        let image = |value: f32| Tensor::<3>::full([3, 4, 5], value, &Device::flex());
        let of = |value: f32| psnr_db(image(value), image(0.5)).unwrap();
        assert!((of(0.6) - 20.0).abs() < 1e-4, "{}", of(0.6));
        assert!((of(0.5) - 100.0).abs() < 1e-4, "{}", of(0.5));
        assert!(of(f32::NAN).is_nan());
    }
}
