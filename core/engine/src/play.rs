//! Playback: spatial features once, then per frame gate, deform and draw.

use crate::model::Model;
use crate::train::Rows;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::{Camera, FieldWork, Gaussians, Rasterizer, Registry, RenderOutput, RenderSettings, Result, Splats};
use serde::Serialize;
use std::time::Instant;

/// Plays one model on one device.
pub struct Player<'a> {
    model: &'a Model,
    device: Device,
    rasterizer: Box<dyn Rasterizer>,
    gaussians: Gaussians,
    moving_means: Tensor<2>,
    rows: Rows,
    moving: usize,
    cache: Option<Tensor<2>>,
    settings: RenderSettings,
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
    pub spatial: FieldWork,
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
        let gaussians = Gaussians::from_host(&model.gaussians, device);
        let moves = model.field.as_ref().is_some_and(|f| !f.field.is_static());
        let rows = if moves { Rows::new(model.moving.rows(&model.gaussians.dynamic_scores), device) } else { Rows::new(Some(Vec::new()), device) };
        let moving = rows.count(gaussians.len());
        let background = Tensor::<1>::from_data(TensorData::new(model.background.to_vec(), [3]), device);
        Ok(Self {
            device: device.clone(),
            rasterizer: registry.build_rasterizer(&model.rasterizer)?,
            moving_means: if moving > 0 { rows.select(gaussians.means.clone()) } else { gaussians.means.clone() },
            gaussians,
            rows,
            moving,
            cache: None,
            settings: model.render.settings(Some(background)),
            work: PlayWork::default(),
            model,
        })
    }
    /// Gaussians the field moves.
    pub fn moving(&self) -> usize {
        self.moving
    }
    /// The Gaussians at `time_norm`.
    pub fn gaussians_at(&mut self, time_norm: f32) -> Result<Gaussians> {
        self.work.frames += 1;
        self.work.deformed += self.moving as u64;
        self.work.static_skipped += (self.gaussians.len() - self.moving) as u64;
        let Some(field) = self.model.field.as_ref().filter(|_| self.moving > 0) else { return Ok(self.gaussians.clone()) };
        let features = match &self.cache {
            Some(features) => {
                self.work.spatial_cached += 1;
                features.clone()
            }
            None => {
                let spatial = field.field.spatial(self.moving_means.clone())?;
                self.work.spatial.gaussians += spatial.work.gaussians;
                self.work.spatial.vertices_queried += spatial.work.vertices_queried;
                self.work.spatial.vertices_decoded += spatial.work.vertices_decoded;
                if field.field.caches_spatial() {
                    self.cache = Some(spatial.values.clone());
                }
                spatial.values
            }
        };
        Ok(field.field.deform(features, time_norm)?.apply(&self.gaussians, self.rows.tensor()))
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
    fn sync(&self) -> Result<()> {
        self.device.sync().map_err(|e| cc4dgs_core::Error::backend("device", format!("{e:?}"), "Try another device (--device flex)"))
    }
}
