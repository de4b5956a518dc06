//! Playback: spatial features once, then per frame gate, deform and draw.

use crate::model::Model;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::{Camera, DeformerWork, Gaussians, Image8, Rasterizer, Registry, RenderOutput, RenderSettings, Result, SpatialInput, Splats};
use serde::Serialize;
use std::time::Instant;

/// Frames between two looks at how many pairs there were, in playback without waiting.
const LOOK_EVERY: u64 = 16;
/// Room for pairs over the most seen, so that a little more does not overflow.
const SPARE: f64 = 1.25;

/// Room for (Gaussian, tile) pairs, learned from frames past.
#[derive(Default)]
struct PairRoom {
    room: Option<usize>,
    /// The most pairs of any frame since the last look, on the device.
    most: Option<Tensor<1, Int>>,
    frames: u64,
}

impl PairRoom {
    fn note(&mut self, count: Tensor<1, Int>) {
        self.frames += 1;
        self.most = Some(match self.most.take() {
            Some(most) => most.max_pair(count),
            None => count,
        });
        if self.room.is_none() || self.frames.is_multiple_of(LOOK_EVERY) {
            let most = self.most.take().map_or(0, |most| most.into_scalar::<i64>().max(0)) as f64;
            let wanted = (most * SPARE) as usize + 1024;
            // Room shrinks too, once it is twice what is needed: sorting takes as long as there is room.
            if self.room.is_none_or(|room| most as usize > room || wanted * 2 < room || most * 1.1 > room as f64) {
                self.room = Some(wanted);
            }
        }
    }
}

/// Plays one model on one device.
pub struct Player<'a> {
    model: &'a Model,
    device: Device,
    rasterizer: Box<dyn Rasterizer>,
    /// All Gaussians; those that move, which come first, as they were at the last frame.
    frame: Gaussians,
    /// Those that move, as they are without a field.
    moving_gaussians: Gaussians,
    /// What the deformer is asked about.
    spatial_input: SpatialInput,
    moving: usize,
    cache: Option<Tensor<2>>,
    settings: RenderSettings,
    pair_room: PairRoom,
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

impl<'a> Player<'a> {
    /// Uploads the model.
    pub fn new(model: &'a Model, registry: &Registry, device: &Device) -> Result<Self> {
        let n = model.gaussians.len();
        let moves = model.field.as_ref().is_some_and(|f| !f.field.is_static());
        let rows = if moves { model.moving.rows(&model.gaussians.dynamic_scores) } else { Some(Vec::new()) };
        let moving = rows.as_ref().map_or(n, Vec::len);
        // What moves comes first, so that a frame adds to a block of rows instead of gathering and scattering them.
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
        let background = Tensor::<1>::from_data(TensorData::new(model.background.to_vec(), [3]), device);
        let wanted = model.field.iter().filter(|_| moving > 0).flat_map(|f| f.field.attributes());
        let moving_attributes = wanted
            .filter_map(|spec| host.extra.get(&spec.name))
            .map(|a| Tensor::<2>::from_data(TensorData::new(a.values[..moving * a.width].to_vec(), [moving, a.width]), device))
            .collect();
        Ok(Self {
            device: device.clone(),
            rasterizer: registry.build_rasterizer(&model.rasterizer)?,
            frame,
            spatial_input: SpatialInput { means_world: moving_gaussians.means.clone(), attributes: moving_attributes },
            moving_gaussians,
            moving,
            cache: None,
            settings: model.render.settings(Some(background)),
            pair_room: PairRoom::default(),
            work: PlayWork::default(),
            model,
        })
    }
    /// Gaussians the field moves.
    pub fn moving(&self) -> usize {
        self.moving
    }
    /// The Gaussians at `time_norm`, those that move before those that do not.
    pub fn gaussians_at(&mut self, time_norm: f32) -> Result<Gaussians> {
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
                if field.field.caches_spatial() {
                    self.cache = Some(features.clone());
                }
                features
            }
        };
        let offsets = field.field.deform(features, time_norm)?;
        // Nobody else holds the frame while it is written, unless a caller kept the last one, which then stays as it is.
        let nothing = self.moving_gaussians.clone();
        let frame = std::mem::replace(&mut self.frame, nothing);
        self.frame = offsets.apply_over(field.name(), &self.moving_gaussians, frame)?;
        Ok(self.frame.clone())
    }
    /// Draws one frame.
    pub fn render(&mut self, camera: &Camera, time_norm: f32) -> Result<(RenderOutput, FrameTime)> {
        let began = Instant::now();
        let gaussians = self.gaussians_at(time_norm)?;
        self.sync()?;
        let field_ms = began.elapsed().as_secs_f64() * 1000.0;
        let began = Instant::now();
        let splats = Splats::from_gaussians(&gaussians, gaussians.sh_degree);
        let output = self.rasterizer.render(&splats, camera, &self.settings)?;
        self.sync()?;
        Ok((output, FrameTime { field_ms, raster_ms: began.elapsed().as_secs_f64() * 1000.0 }))
    }
    /// Draws one frame without waiting for the device: nothing is read back but, every 16 frames, the number of (Gaussian, tile) pairs, by which room for
    /// them is made. If a frame has suddenly more than a quarter over the most seen, its farthest Gaussians are left out until the next look.
    pub fn play(&mut self, camera: &Camera, time_norm: f32) -> Result<RenderOutput> {
        let gaussians = self.gaussians_at(time_norm)?;
        let splats = Splats::from_gaussians(&gaussians, gaussians.sh_degree);
        let settings = RenderSettings { pair_capacity: self.pair_room.room, ..self.settings.clone() };
        let output = self.rasterizer.render(&splats, camera, &settings)?;
        if let Some(count) = &output.stats.pair_count {
            self.pair_room.note(count.clone());
        }
        Ok(output)
    }
    /// The 8-bit image of rendered planes.
    pub fn download(&self, planes: Tensor<3>) -> Result<Image8> {
        self.rasterizer.download(planes)
    }
    /// Waits until everything asked for is done.
    pub fn sync(&self) -> Result<()> {
        self.device.sync().map_err(|e| cc4dgs_core::Error::backend("device", format!("{e:?}"), "Try another device (--device flex)"))
    }
}
