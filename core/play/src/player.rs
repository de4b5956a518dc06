//! Playback: spatial features once, then deform and draw per frame.

use crate::model::Model;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::{Camera, DeformerWork, Error, Gaussians, Image8, Rasterizer, Registry, RenderOutput, RenderSettings, Result, SpatialInput, Splats};
use serde::Serialize;
use std::time::Instant;

/// Frames between two read-backs of the number of pairs, in playback without waiting.
const LOOK_EVERY: u64 = 16;
/// Capacity for pairs over the most seen, so that a few more do not overflow it.
const SPARE: f64 = 1.25;

/// Capacity for (Gaussian, tile) pairs, learned from past frames.
#[derive(Default)]
struct PairCapacity {
    capacity: Option<usize>,
    /// The most pairs of any frame since the last read-back, on the device.
    most: Option<Tensor<1, Int>>,
    frames: u64,
}

impl PairCapacity {
    fn note(&mut self, count: Tensor<1, Int>) -> Result<()> {
        self.frames += 1;
        self.most = Some(match self.most.take() {
            Some(most) => most.max_pair(count),
            None => count,
        });
        if self.capacity.is_none() || self.frames.is_multiple_of(LOOK_EVERY) {
            let failed = |e| Error::backend("number of (Gaussian, tile) pairs", format!("reading it back failed: {e:?}"), "Try another device (--device flex)");
            let most = self.most.take().map_or(Ok(0), |most| most.try_into_scalar::<i64>()).map_err(failed)?.max(0) as f64;
            let wanted = (most * SPARE) as usize + 1024;
            // The capacity shrinks too, once it is twice what is needed: sorting takes time for all of it.
            if self.capacity.is_none_or(|capacity| most as usize > capacity || wanted * 2 < capacity || most * 1.1 > capacity as f64) {
                self.capacity = Some(wanted);
            }
        }
        Ok(())
    }
}

/// What playback skips. Nothing of it changes a bit of an image; it is switched off only to measure what it saves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlayShortcuts {
    /// The deformer is asked about moving Gaussians only.
    pub static_gating: bool,
    /// The deformer's spatial features are computed once.
    pub feature_cache: bool,
}

impl Default for PlayShortcuts {
    fn default() -> Self {
        Self { static_gating: true, feature_cache: true }
    }
}

/// How a frame is drawn where it differs from the model. The default draws the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameOptions {
    /// Largest degree of spherical harmonics that is evaluated.
    pub sh_degree: usize,
    /// Factor of all scales.
    pub scale: f32,
}

impl Default for FrameOptions {
    fn default() -> Self {
        Self { sh_degree: usize::MAX, scale: 1.0 }
    }
}

impl FrameOptions {
    fn splats(self, mut gaussians: Gaussians) -> Result<Splats> {
        if !(self.scale.is_finite() && self.scale > 0.0) {
            return Err(Error::parameter("scale of the Gaussians", format!("{} is no positive number", self.scale), "Give one such as 0.5"));
        }
        if self.scale != 1.0 {
            gaussians.log_scales = gaussians.log_scales.add_scalar(self.scale.ln());
        }
        Ok(Splats::from_gaussians(&gaussians, self.sh_degree))
    }
}

/// Plays one model on one device.
pub struct Player<'a> {
    model: &'a Model,
    device: Device,
    rasterizer: Box<dyn Rasterizer>,
    /// All Gaussians, moving ones first. The moving rows hold the last frame's values.
    frame: Gaussians,
    /// The moving Gaussians without offsets.
    moving_gaussians: Gaussians,
    /// What the deformer is asked about.
    spatial_input: SpatialInput,
    moving: usize,
    cache: Option<Tensor<2>>,
    settings: RenderSettings,
    pair_capacity: PairCapacity,
    shortcuts: PlayShortcuts,
    /// Work of the field since the start.
    pub work: PlayWork,
}

/// Counts of work done and skipped over all frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct PlayWork {
    /// Frames drawn.
    pub frames: u64,
    /// Gaussians deformed.
    pub deformed: u64,
    /// Static Gaussians the field was spared.
    pub static_skipped: u64,
    /// Spatial passes of the field.
    pub spatial: DeformerWork,
    /// Frames whose spatial pass came from the cache.
    pub spatial_cached: u64,
}

/// Milliseconds of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct FrameTime {
    /// The field and the application of its offsets.
    pub field_ms: f64,
    /// Projection, sorting and blending, to pixels in host-readable memory.
    pub raster_ms: f64,
}

fn colour(rgb: [f32; 3], device: &Device) -> Tensor<1> {
    Tensor::from_data(TensorData::new(rgb.to_vec(), [3]), device)
}

impl<'a> Player<'a> {
    /// Uploads the model. Where it has no background of its own, it is drawn on black; see [`Player::on`].
    ///
    /// # Errors
    /// [`Error::Data`] for arrays of Gaussians that differ in length, and what the rasterizer says of the model's `[rasterizer]` section.
    pub fn new(model: &'a Model, registry: &Registry, device: &Device) -> Result<Self> {
        Self::with_shortcuts(model, registry, device, PlayShortcuts::default())
    }
    /// As [`Player::new`], with some of what is skipped switched off.
    ///
    /// # Errors
    /// As [`Player::new`].
    pub fn with_shortcuts(model: &'a Model, registry: &Registry, device: &Device, shortcuts: PlayShortcuts) -> Result<Self> {
        // A program may have changed them since the model was opened.
        model.gaussians.validate_shapes("Gaussians to play")?;
        let n = model.gaussians.len();
        let moves = model.field.as_ref().is_some_and(|f| !f.field.is_static());
        let rows = if moves { model.moving.rows(&model.gaussians.dynamic_scores) } else { Some(Vec::new()) };
        let moving = rows.as_ref().map_or(n, Vec::len);
        // Moving rows come first, so that a frame adds to one block of rows instead of gathering and scattering them.
        let sorted = rows.filter(|_| (1..n).contains(&moving)).map(|rows| {
            let mut still = vec![true; n];
            rows.iter().for_each(|&row| still[row] = false);
            let order: Vec<usize> = rows.into_iter().chain((0..n).filter(|&i| still[i])).collect();
            model.gaussians.select(&order)
        });
        let host = sorted.as_ref().unwrap_or(&model.gaussians);
        let frame = Gaussians::from_host(host, device);
        let moving_gaussians =
            if (1..n).contains(&moving) { Gaussians::from_host(&host.select(&(0..moving).collect::<Vec<_>>()), device) } else { frame.clone() };
        let asked = if shortcuts.static_gating { moving } else { n };
        let wanted = model.field.iter().filter(|_| moving > 0).flat_map(|f| f.field.attributes());
        let moving_attributes = wanted
            .filter_map(|spec| host.extra.get(&spec.name))
            .map(|a| Tensor::<2>::from_data(TensorData::new(a.values[..asked * a.width].to_vec(), [asked, a.width]), device))
            .collect();
        let means_world = if shortcuts.static_gating { moving_gaussians.means.clone() } else { frame.means.clone() };
        Ok(Self {
            device: device.clone(),
            rasterizer: registry.build_rasterizer(&model.rasterizer)?,
            frame,
            spatial_input: SpatialInput { means_world, attributes: moving_attributes },
            moving_gaussians,
            moving,
            cache: None,
            settings: model.render.settings(Some(colour(model.background_on(None), device))),
            pair_capacity: PairCapacity::default(),
            shortcuts,
            work: PlayWork::default(),
            model,
        })
    }
    /// The same player for comparison with images of a scene, whose background counts where the model has none.
    pub fn on(mut self, scene: Option<[f32; 3]>) -> Self {
        self.settings = self.model.render.settings(Some(colour(self.model.background_on(scene), &self.device)));
        self
    }
    /// Gaussians the field moves.
    pub fn moving(&self) -> usize {
        self.moving
    }
    /// The Gaussians at `time_norm`, moving ones first: 0 is the first frame, 1 the last. What comes before 0 and after 1 depends on the deformer.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a time that is not finite, and what the deformer reports.
    pub fn gaussians_at(&mut self, time_norm: f32) -> Result<Gaussians> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("player", format!("the time {time_norm} is not a number"), "Use a time from 0 (first frame) to 1 (last frame)"));
        }
        self.work.frames += 1;
        self.work.deformed += self.moving as u64;
        self.work.static_skipped += (self.frame.len() - self.moving) as u64;
        let Some(field) = self.model.field.as_ref().filter(|_| self.moving > 0) else { return Ok(self.frame.clone()) };
        let features = match &self.cache {
            Some(features) => {
                self.work.spatial_cached += 1;
                features.clone()
            }
            None => {
                let spatial = field.field.spatial(&self.spatial_input)?;
                self.work.spatial.gaussians += spatial.work.gaussians;
                self.work.spatial.vertices_queried += spatial.work.vertices_queried;
                self.work.spatial.vertices_decoded += spatial.work.vertices_decoded;
                let features = field.field.packed(spatial.values);
                if field.field.caches_spatial() && self.shortcuts.feature_cache {
                    self.cache = Some(features.clone());
                }
                features
            }
        };
        let offsets = field.field.deform(features, time_norm)?;
        let offsets = if self.shortcuts.static_gating { offsets } else { offsets.first(self.moving) };
        // What `apply_over` refuses is refused while the frame is whole.
        offsets.check(field.name(), self.moving_gaussians.len())?;
        // The frame is written in place. A caller who kept the last one keeps a copy of its own.
        let nothing = self.moving_gaussians.clone();
        let frame = std::mem::replace(&mut self.frame, nothing);
        self.frame = offsets.apply_over(field.name(), &self.moving_gaussians, frame)?;
        Ok(self.frame.clone())
    }
    /// The 8-bit RGB image that `camera` sees at `time_norm` (0 to 1).
    ///
    /// # Errors
    /// As [`Player::gaussians_at`], and [`Error::Data`] for a camera that [`Camera::validate`] refuses.
    pub fn frame(&mut self, camera: &Camera, time_norm: f32) -> Result<Image8> {
        let planes = self.render(camera, time_norm)?.0.planes;
        self.download(planes)
    }
    /// As [`Player::frame`], drawn as `options` say.
    ///
    /// # Errors
    /// Also [`Error::Parameter`] for scales that are no positive number.
    pub fn frame_as(&mut self, camera: &Camera, time_norm: f32, options: FrameOptions) -> Result<Image8> {
        let planes = self.render_as(camera, time_norm, options)?.0.planes;
        self.download(planes)
    }
    /// Draws one frame and waits for it.
    pub fn render(&mut self, camera: &Camera, time_norm: f32) -> Result<(RenderOutput, FrameTime)> {
        self.render_as(camera, time_norm, FrameOptions::default())
    }
    fn render_as(&mut self, camera: &Camera, time_norm: f32, options: FrameOptions) -> Result<(RenderOutput, FrameTime)> {
        let began = Instant::now();
        let gaussians = self.gaussians_at(time_norm)?;
        self.sync()?;
        let field_ms = began.elapsed().as_secs_f64() * 1000.0;
        let began = Instant::now();
        let splats = options.splats(gaussians)?;
        let output = self.rasterizer.render(&splats, camera, &self.settings)?;
        self.sync()?;
        Ok((output, FrameTime { field_ms, raster_ms: began.elapsed().as_secs_f64() * 1000.0 }))
    }
    /// Draws one frame without waiting for the device. Only the number of (Gaussian, tile) pairs is read back, every 16 frames, to set the capacity for
    /// them. If a frame suddenly has a quarter more than the most seen, its farthest Gaussians are left out until the next read-back.
    pub fn play(&mut self, camera: &Camera, time_norm: f32) -> Result<RenderOutput> {
        let gaussians = self.gaussians_at(time_norm)?;
        let splats = Splats::from_gaussians(&gaussians, gaussians.sh_degree);
        let settings = RenderSettings { pair_capacity: self.pair_capacity.capacity, ..self.settings.clone() };
        let output = self.rasterizer.render(&splats, camera, &settings)?;
        if let Some(count) = &output.stats.pair_count {
            self.pair_capacity.note(count.clone())?;
        }
        Ok(output)
    }
    /// The 8-bit image of rendered planes `[5,H,W]`, read back from the device.
    pub fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        self.rasterizer.download(planes)
    }
    /// Waits until the device has finished.
    pub fn sync(&self) -> Result<()> {
        self.device.sync().map_err(|e| Error::backend("device", format!("{e:?}"), "Try another device (--device flex)"))
    }
}
