//! What a codec may use of a model and its scene while it encodes: training views, those that judge, a renderer, the field.

use crate::model::Model;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::sample::by_camera;
use cc4dgs_core::{
    Camera, Deformer, EvaluateDeformer, Gaussians, HostGaussians, Image8, ParameterSpace, Rasterizer, Registry, RenderModel, RenderSettings, RenderedPlanes,
    Result, Scene, Seed, SpatialInput, SplatColors, Splats, Split, TrainingViews,
};
use rayon::prelude::*;

/// The views of one split of a scene, camera after camera ([`by_camera`]): every so many are of all cameras.
pub struct SceneViews<'a> {
    scene: &'a Scene,
    split: Split,
    views: Vec<usize>,
}

impl<'a> SceneViews<'a> {
    /// The training views of `scene`.
    pub fn new(scene: &'a Scene) -> Self {
        Self::of(scene, Split::Train)
    }
    /// The views of `split`.
    pub fn of(scene: &'a Scene, split: Split) -> Self {
        Self { scene, split, views: by_camera(scene, &scene.split(split)) }
    }
    /// The views of `scene` on which a loss is measured ([`Scene::judging_split`]).
    pub fn judging(scene: &'a Scene) -> Self {
        Self::of(scene, scene.judging_split())
    }
}

impl TrainingViews for SceneViews<'_> {
    fn len(&self) -> usize {
        self.views.len()
    }
    fn kind(&self) -> &'static str {
        self.split.name()
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        let view = self.views[index];
        (self.scene.camera(view), self.scene.views[view].time_norm)
    }
    fn image(&self, index: usize) -> Result<Image8> {
        Ok(self.scene.frame(self.views[index])?.as_ref().clone())
    }
}

/// What is added to colours where derivatives are measured: no trained colour is as far below 0.
const BRIGHTER: f64 = 16.0;
/// Value of the spherical-harmonics basis function of degree 0.
const SH0: f64 = 0.282_094_791_773_878_14;

/// Moves and draws Gaussians as a model does.
pub struct ModelServices<'a> {
    model: &'a Model,
    deformer: Option<&'a dyn Deformer>,
    device: Device,
    rasterizer: Box<dyn Rasterizer>,
    settings: RenderSettings,
}

impl<'a> ModelServices<'a> {
    /// Services of `model` on `device`, which its field must be on.
    pub fn new(model: &'a Model, registry: &Registry, device: &Device) -> Result<Self> {
        let background = Tensor::<1>::from_data(TensorData::new(model.background_on(None).to_vec(), [3]), device);
        let rasterizer = registry.build_rasterizer(&model.rasterizer)?;
        let deformer = model.field.as_ref().map(|f| f.field.as_ref());
        Ok(Self { model, deformer, device: device.clone(), rasterizer, settings: model.render.settings(Some(background)) })
    }
    /// The same services with `deformer` in place of the model's, which must be of the same kind.
    pub fn with_deformer(mut self, deformer: &'a dyn Deformer) -> Self {
        self.deformer = Some(deformer);
        self
    }
    /// The image `[3,H,W]` of the model's own Gaussians, which a tracked deformer moves.
    pub(crate) fn image(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<Tensor<3>> {
        let moved = self.moved(gaussians, time_norm)?;
        Ok(self.rasterizer.render(&Splats::from_gaussians(&moved, moved.sh_degree), camera, &self.settings)?.image())
    }
    fn moved(&self, host: &HostGaussians, time_norm: f32) -> Result<Gaussians> {
        self.unmoved(host.clone())?.at(time_norm)
    }
    /// What all times share.
    fn unmoved(&self, host: HostGaussians) -> Result<Unmoved<'_>> {
        let rows = self.model.moving.rows(&host.dynamic_scores);
        let nothing_moves = host.is_empty() || rows.as_ref().is_some_and(Vec::is_empty);
        let canonical = Gaussians::of_host(host, &self.device);
        let Some(deformer) = self.deformer.filter(|d| !nothing_moves && !d.is_static()) else { return Ok(Unmoved { canonical, motion: None }) };
        let rows = rows.map(|rows| {
            let indices: Vec<i64> = rows.iter().map(|&row| row as i64).collect();
            Tensor::<1, Int>::from_data(TensorData::new(indices, [rows.len()]), &self.device)
        });
        let select = |values: &Tensor<2>| rows.as_ref().map_or_else(|| values.clone(), |rows| values.clone().select(0, rows.clone()));
        let attributes: Vec<Tensor<2>> = deformer.attributes().iter().filter_map(|spec| canonical.extra.get(&spec.name)).map(select).collect();
        let features = deformer.spatial(&SpatialInput { means_world: select(&canonical.means), attributes })?.values;
        let name = self.model.field.as_ref().map_or("", |f| f.name());
        Ok(Unmoved { canonical, motion: Some(Motion { deformer, name, features, rows }) })
    }
    /// The estimate of [`RenderModel::squared_derivatives`] for Gaussians as they are drawn.
    fn squares(&self, mut moved: Gaussians, camera: &Camera, seed: Seed) -> Result<HostGaussians> {
        let tracked = self.device.clone().autodiff();
        let leaf = |t: Tensor<2>| Tensor::<2>::from_inner(t).require_grad();
        let [n, coefficients, _] = moved.sh_rest.dims();
        // A colour below 0 is drawn as 0 and has no derivative, but a rounded one may be above. All colours and the background are made brighter alike, which
        // changes no other derivative.
        moved.sh_dc = moved.sh_dc + BRIGHTER / SH0;
        let (means, log_scales, quaternions, sh_dc) = (leaf(moved.means), leaf(moved.log_scales), leaf(moved.quaternions), leaf(moved.sh_dc));
        let opacity_logits = Tensor::<1>::from_inner(moved.opacity_logits).require_grad();
        let sh_rest = Tensor::<3>::from_inner(moved.sh_rest).require_grad();
        let splats = Splats {
            means: means.clone(),
            scales: log_scales.clone(),
            quaternions: quaternions.clone(),
            opacities: opacity_logits.clone(),
            colors: SplatColors::Sh { dc: sh_dc.clone(), rest: sh_rest.clone(), degree: moved.sh_degree },
            space: ParameterSpace::Raw,
            screen_probe: None,
            absolute_screen_probe: None,
            camera_probe: None,
        };
        let background = self.settings.background.clone().map(|b| Tensor::<1>::from_inner(b + BRIGHTER));
        let planes = self.rasterizer.render(&splats, camera, &RenderSettings { background, ..self.settings.clone() })?.image();
        let shape = planes.dims();
        let signs = rand_signs(seed, shape.iter().product());
        let mut gradients = (planes * Tensor::<3>::from_data(TensorData::new(signs, shape), &tracked)).sum().backward();
        fn squared<const D: usize>(gradient: Option<Tensor<D>>, count: usize, name: &str) -> Result<Vec<f32>> {
            // A tensor that no pixel depends on has no gradient.
            let Some(gradient) = gradient else { return Ok(vec![0.0; count]) };
            let mut values = to_vec(gradient, name)?;
            values.par_iter_mut().for_each(|v| *v = if v.is_finite() { *v * *v } else { 0.0 });
            Ok(values)
        }
        // Derivatives are taken out: what has no other owner is not copied.
        Ok(HostGaussians {
            sh_degree: moved.sh_degree,
            means: squared(means.grad_remove(&mut gradients), 3 * n, "derivatives by centres")?,
            log_scales: squared(log_scales.grad_remove(&mut gradients), 3 * n, "derivatives by scales")?,
            quaternions: squared(quaternions.grad_remove(&mut gradients), 4 * n, "derivatives by rotations")?,
            opacity_logits: squared(opacity_logits.grad_remove(&mut gradients), n, "derivatives by opacities")?,
            sh_dc: squared(sh_dc.grad_remove(&mut gradients), 3 * n, "derivatives by colours")?,
            sh_rest: squared(sh_rest.grad_remove(&mut gradients), 3 * n * coefficients, "derivatives by colours")?,
            dynamic_scores: vec![0.0; n],
            extra: Default::default(),
        })
    }
}

/// Views that are drawn at a time where threads of this process draw: while one thread works on a serial part of a view, such as sorting, others draw another.
/// Every further view takes memory for its moved Gaussians and its tile lists.
const TOGETHER: usize = 2;

/// Whether Gaussians on `device` are drawn by the threads of this process.
#[cfg(feature = "cpu")]
fn draws_in_threads(device: &Device) -> bool {
    matches!(device.as_dispatch(), burn::backend::DispatchDevice::Flex(_))
}

#[cfg(not(feature = "cpu"))]
fn draws_in_threads(_: &Device) -> bool {
    false
}

/// The planes of `moved` in `camera`. No method of [`ModelServices`], which threads cannot share.
fn drawn(rasterizer: &dyn Rasterizer, settings: &RenderSettings, moved: &Gaussians, camera: &Camera) -> Result<RenderedPlanes> {
    let output = rasterizer.render(&Splats::from_gaussians(moved, moved.sh_degree), camera, settings)?;
    Ok(RenderedPlanes { width: camera.width, height: camera.height, planes: to_vec(output.planes, "rendered planes")? })
}

/// Canonical Gaussians on the device, and how they move, if they do.
struct Unmoved<'a> {
    canonical: Gaussians,
    motion: Option<Motion<'a>>,
}

struct Motion<'a> {
    deformer: &'a dyn Deformer,
    name: &'a str,
    /// Of the moving Gaussians, whose indices are `rows`; `None` if all move.
    features: Tensor<2>,
    rows: Option<Tensor<1, Int>>,
}

impl Unmoved<'_> {
    fn at(&self, time_norm: f32) -> Result<Gaussians> {
        let Some(Motion { deformer, name, features, rows }) = &self.motion else { return Ok(self.canonical.clone()) };
        deformer.deform(features.clone(), time_norm)?.apply(name, &self.canonical, rows.as_ref())
    }
}

impl EvaluateDeformer for ModelServices<'_> {
    fn deform(&self, gaussians: &HostGaussians, time_norm: f32) -> Result<HostGaussians> {
        self.moved(gaussians, time_norm)?.to_host()
    }
}

impl RenderModel for ModelServices<'_> {
    fn render(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<RenderedPlanes> {
        drawn(self.rasterizer.as_ref(), &self.settings, &self.moved(gaussians, time_norm)?, camera)
    }
    fn render_views(&self, gaussians: &HostGaussians, views: &[(&Camera, f32)], take: &mut dyn FnMut(usize, RenderedPlanes) -> Result<()>) -> Result<()> {
        self.render_views_once(gaussians.clone(), views, take)
    }
    fn render_views_once(&self, gaussians: HostGaussians, views: &[(&Camera, f32)], take: &mut dyn FnMut(usize, RenderedPlanes) -> Result<()>) -> Result<()> {
        let unmoved = self.unmoved(gaussians)?;
        let together = if draws_in_threads(&self.device) { TOGETHER } else { 1 };
        let (rasterizer, settings) = (self.rasterizer.as_ref(), &self.settings);
        for (k, views) in views.chunks(together).enumerate() {
            let moved = views.iter().map(|(_, time_norm)| unmoved.at(*time_norm)).collect::<Result<Vec<Gaussians>>>()?;
            let draw = |((camera, _), moved): (&(&Camera, f32), &Gaussians)| drawn(rasterizer, settings, moved, camera);
            let images: Vec<Result<RenderedPlanes>> =
                if views.len() > 1 { views.par_iter().zip(&moved).map(draw).collect() } else { views.iter().zip(&moved).map(draw).collect() };
            images.into_iter().enumerate().try_for_each(|(index, image)| take(k * together + index, image?))?;
        }
        Ok(())
    }
    fn background(&self) -> [f32; 3] {
        self.model.background_on(None)
    }
    fn squared_derivatives(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32, seed: Seed) -> Result<Option<HostGaussians>> {
        self.squares(self.moved(gaussians, time_norm)?, camera, seed).map(Some)
    }
    fn squared_derivatives_in_views(
        &self,
        gaussians: &HostGaussians,
        views: &[(&Camera, f32)],
        seed: Seed,
        take: &mut dyn FnMut(usize, HostGaussians, Option<Vec<f32>>) -> Result<()>,
    ) -> Result<bool> {
        let unmoved = self.unmoved(gaussians.clone())?;
        for (index, &(camera, time_norm)) in views.iter().enumerate() {
            let moved = unmoved.at(time_norm)?;
            let means = to_vec(moved.means.clone(), "centres")?;
            take(index, self.squares(moved, camera, seed.index(index as u64))?, Some(means))?;
        }
        Ok(true)
    }
}

/// `count` numbers of 1 and -1.
pub(crate) fn rand_signs(seed: Seed, count: usize) -> Vec<f32> {
    let mut signs = vec![0.0; count];
    signs.par_chunks_mut(64).enumerate().for_each(|(k, signs)| {
        let word = seed.index(k as u64).value();
        signs.iter_mut().enumerate().for_each(|(bit, sign)| *sign = if word >> bit & 1 == 1 { 1.0 } else { -1.0 });
    });
    signs
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{NoImages, View};
    use std::collections::BTreeSet;
    use std::sync::Arc;

    #[test]
    fn every_so_many_views_are_of_all_cameras() {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |i: usize| View { camera: i % 4, frame: i / 4, time_norm: (i / 4) as f32 / 11.0, split: Split::Train };
        let scene = Scene::new("s", (0..4).map(camera).collect(), (0..48).map(view).collect(), Arc::new(NoImages), 0).unwrap();
        let views = SceneViews::new(&scene);
        // As codecs choose 12 of them.
        let chosen: Vec<(&Camera, f32)> = (0..12).map(|k| views.view(k * views.len() / 12)).collect();
        let cameras: BTreeSet<&str> = chosen.iter().map(|(camera, _)| camera.name.as_str()).collect();
        let times: BTreeSet<u32> = chosen.iter().map(|(_, time)| time.to_bits()).collect();
        assert_eq!((views.len(), cameras.len()), (48, 4));
        assert!(times.len() >= 6, "{times:?}");
    }
}
