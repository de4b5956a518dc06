//! Writing models in the file formats of other programs.
//!
//! The formats are plug-ins ([`cc4dgs_core::Exporter`]); this module feeds them: Gaussians at any time through the model's deformer, in the coordinates of the
//! dataset, and rendered images.

mod mp4;

use crate::playable::{PlayableOptions, Storage, Stored, Surroundings, presented};
use crate::{Model, Orbit, video};
use burn::tensor::Device;
use cc4dgs_core::archive::{Presentation, StreamKind};
use cc4dgs_core::exporter::export;
use cc4dgs_core::playback::MaxError;
use cc4dgs_core::playback::frame_time;
use cc4dgs_core::{Camera, Error, Event, EventSink, ExportFacts, ExportSource, ExporterPlugin, HostGaussians, Image8, Limits, Registry, Result, Similarity};
use cc4dgs_play::model::Model as PlayModel;
use cc4dgs_play::player::Player;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Frames per second, where neither the request nor the archive states them.
const RATE: f64 = 30.0;
/// The upward axis, where neither the request nor the archive states it.
const UP: [f64; 3] = [0.0, 0.0, 1.0];

/// What to export of a model.
#[derive(Clone, Debug, Default)]
pub struct ExportRequest {
    /// The instant (0..1) that formats of one instant hold; `None` is the canonical model. Other formats refuse one.
    pub time_norm: Option<f32>,
    /// Frames of formats that hold several; as many as the model was trained with where absent. Frame k of n is at time k / (n - 1).
    pub frames: Option<usize>,
    /// Frames per second. Where absent: in formats with a player what the archive states, else 30.
    pub frames_per_second: Option<f64>,
    /// The signed unit axis of the world that points up. Where absent: in formats with a player what the archive states or the cameras show, else z.
    pub up: Option<[f64; 3]>,
    /// Cameras (in the model's frame) and times of rendered images.
    pub shots: Vec<(Camera, f32)>,
    /// Background of rendered images where the model has none.
    pub background: Option<[f32; 3]>,
    /// Cameras of the recording, in the model's frame, for formats with a player.
    pub cameras: Vec<Camera>,
}

/// An export to run.
pub struct ExportJob<'a> {
    /// The model.
    pub model: &'a PlayModel,
    /// The archive that it was read from, if any: formats with a player take it as it is. Others store the model anew.
    pub archive: Option<&'a Path>,
    /// Name of the exporter.
    pub format: &'a str,
    /// Its settings.
    pub settings: &'a toml::Table,
    /// What to export.
    pub request: ExportRequest,
    /// The file or folder to write.
    pub out: &'a Path,
    /// Replace it where it exists.
    pub overwrite: bool,
    /// The linked plug-ins.
    pub registry: &'a Registry,
    /// The device of deformer and rasterizer.
    pub device: &'a Device,
    /// Limits on what is read back.
    pub limits: &'a Limits,
    /// Receives progress, and that the file was saved.
    pub events: &'a dyn EventSink,
    /// Ends the export with [`Error::Interrupted`] once it is set.
    pub stop: &'a AtomicBool,
}

/// What was exported.
#[derive(Clone, Debug, Serialize)]
pub struct ExportReport {
    /// The file or folder.
    pub file: PathBuf,
    /// Name of the exporter.
    pub format: String,
    /// What the format cannot carry of this model, in one sentence.
    pub lost: String,
    /// Gaussians per file; 0 for images.
    pub gaussians: usize,
    /// Spherical-harmonics degree that was kept.
    pub sh_degree: usize,
    /// Frames.
    pub frames: usize,
    /// The instant, where one was asked for.
    pub time: Option<f32>,
    /// Size on disk.
    pub bytes: u64,
    /// The same in MB = 10⁶ bytes.
    pub size_mb: f64,
    /// What was measured or left out while writing.
    pub notes: Vec<String>,
}

impl ExportJob<'_> {
    /// Writes the file or folder; it appears complete or not at all.
    ///
    /// # Errors
    /// [`Error::Parameter`] for unknown formats, settings and times, for an axis whose length is not 1, for a time where the format holds all of them, for
    /// images of several sizes where the format holds one, and for a name that exists without `overwrite`; [`Error::Interrupted`]; what the format cannot hold;
    /// what device and disk report.
    pub fn run(&self) -> Result<ExportReport> {
        let plugin = self.registry.exporter(self.format)?;
        let exporter = (plugin.build)(self.settings)?;
        check_time(self.registry, plugin, self.request.time_norm)?;
        self.request.up.map_or(Ok(()), check_up)?;
        if plugin.info.capabilities.contains(&"one-size") {
            video::check_sizes(&format!("exporter {}", plugin.info.name), &self.request.shots)?;
        }
        let mut source = ModelSource::new(self)?;
        let lost = exporter.loses(source.facts());
        let (exported, bytes) = export(exporter.as_ref(), plugin.target, &mut source, self.out, self.overwrite)?;
        self.events.emit(&Event::Saved { path: self.out.display().to_string(), bytes });
        Ok(ExportReport {
            file: self.out.to_path_buf(),
            format: self.format.to_string(),
            lost,
            gaussians: exported.gaussians,
            sh_degree: exported.sh_degree,
            frames: exported.frames,
            time: self.request.time_norm,
            bytes,
            size_mb: bytes as f64 / 1e6,
            notes: exported.notes,
        })
    }
}

/// Refuses an instant that is no time, or that a format which does not hold one instant has no use for.
///
/// # Errors
/// [`Error::Parameter`].
pub fn check_time(registry: &Registry, plugin: &ExporterPlugin, time_norm: Option<f32>) -> Result<()> {
    let Some(time) = time_norm else { return Ok(()) };
    let refuse = |problem: String, remedy: &str| Err(Error::parameter(format!("time {time}"), problem, remedy));
    if !(0.0..=1.0).contains(&time) {
        return refuse("it is not in 0..1".into(), "Give the normalised time, 0 for the first frame and 1 for the last");
    }
    let has = |capability| plugin.info.capabilities.contains(&capability);
    if !has("still") {
        let held = match (has("motion"), has("images")) {
            (true, _) => "the whole motion",
            (false, true) => "images of all times",
            (false, false) => "no single instant",
        };
        let still: Vec<&str> = registry.exporters().filter(|p| p.info.capabilities.contains(&"still")).map(|p| p.info.name).collect();
        return refuse(format!("{} holds {held}", plugin.info.name), &format!("Leave it out, or choose a format of one instant: {}", still.join(", ")));
    }
    Ok(())
}

/// Refuses an upward axis whose length is not 1.
fn check_up(up: [f64; 3]) -> Result<()> {
    let length = up.iter().map(|v| v * v).sum::<f64>().sqrt();
    if (length - 1.0).abs() <= 1e-3 {
        return Ok(());
    }
    let remedy = "Give one of x, y and z with its sign, such as [0, 0, 1]";
    Err(Error::parameter("up", format!("{up:?} has the length {length}, and an axis has 1"), remedy))
}

/// Spacing of float32 at a centre over the size of a Gaussian, from which the error of centres is visible.
const COARSE: f64 = 0.1;

/// A message where the rounding of the centres of `gaussians` to float32 is visible in the dataset's coordinates, because their origin is far away, as in maps.
fn coarse(gaussians: &HostGaussians, to_dataset: &Similarity) -> Option<String> {
    let centres = gaussians.means.chunks_exact(3).map(|mean| to_dataset.apply(std::array::from_fn(|k| f64::from(mean[k]))));
    let farthest = centres.flatten().fold(0.0, |most: f64, v| most.max(v.abs())) as f32;
    let mut scales = gaussians.log_scales.clone();
    scales.sort_unstable_by(f32::total_cmp);
    let size = to_dataset.scale * f64::from(*scales.get(scales.len() / 2)?).exp();
    let step = f64::from(farthest.next_up()) - f64::from(farthest);
    let remedy = "shift the dataset's origin near the scene, or keep the archive, whose coordinates are its own";
    (step > COARSE * size).then(|| {
        format!(
            "centres are up to {farthest:.3e} from the dataset's origin, where float32 has steps of {step:.1e}, and Gaussians have a middle size of {size:.1e}: {remedy}"
        )
    })
}

/// A model as exporters see it.
struct ModelSource<'a> {
    job: &'a ExportJob<'a>,
    player: Player<'a>,
    facts: ExportFacts,
    /// Whether [`coarse`] was called.
    checked: bool,
}

impl<'a> ModelSource<'a> {
    fn new(job: &'a ExportJob<'a>) -> Result<Self> {
        let (model, request) = (job.model, &job.request);
        let player = Player::new(model, job.registry, job.device)?.on(request.background);
        // What stands still is the same in every frame.
        let all = if player.moving() == 0 { 1 } else { model.frame_count };
        let frames = request.frames.unwrap_or(all).max(1);
        let up = request.up.unwrap_or(UP);
        let orbit = Orbit { frames: 1, up, ..Orbit::default() };
        // The home camera is optional: there is none if no orbit around the model is possible.
        let home = request.shots.first().map(|(camera, _)| camera.clone()).or_else(|| orbit.around(&model.gaussians).ok()?.pop());
        let facts = ExportFacts {
            name: job.out.file_stem().map_or_else(|| "model".into(), |stem| stem.to_string_lossy().into_owned()),
            gaussians: model.gaussians.len(),
            moving: player.moving(),
            sh_degree: model.gaussians.sh_degree,
            time_norm: request.time_norm,
            times_norm: (0..frames).map(|k| frame_time(k, frames)).collect(),
            frames_per_second: request.frames_per_second.unwrap_or(RATE),
            antialiased: model.render.antialiased,
            blur: model.render.blur,
            up,
            home: home.map(|camera| model.normalisation.inverse().apply_camera(&camera)),
            images: request.shots.len(),
        };
        Ok(Self { job, player, facts, checked: false })
    }
    /// Ends the export where the user wants to stop; `when` says how far it is.
    fn check_stop(&self, when: &str) -> Result<()> {
        if self.job.stop.load(Ordering::Relaxed) { Err(Error::Interrupted(format!("{when} of {}", self.job.out.display()))) } else { Ok(()) }
    }
}

impl ExportSource for ModelSource<'_> {
    fn facts(&self) -> &ExportFacts {
        &self.facts
    }
    fn gaussians(&mut self, time_norm: Option<f32>) -> Result<HostGaussians> {
        // Images and pages keep the coordinates of the model.
        let model = self.job.model;
        if !std::mem::replace(&mut self.checked, true)
            && let Some(message) = coarse(&model.gaussians, &model.normalisation.inverse())
        {
            self.job.events.emit(&Event::Warning { object: format!("export of {}", self.job.out.display()), message });
        }
        let mut gaussians = match time_norm {
            None => self.job.model.gaussians.clone(),
            Some(time) => self.player.gaussians_at(time)?.to_host()?,
        };
        self.job.model.to_dataset(&mut gaussians);
        Ok(gaussians)
    }
    fn image(&mut self, index: usize) -> Result<Image8> {
        match self.job.request.shots.get(index) {
            Some((camera, time)) => self.player.frame(camera, *time),
            None => Err(Error::parameter("image", format!("{index} of {}", self.facts.images), "Ask for an image that is there")),
        }
    }
    fn playable(&mut self, max_error: MaxError, baked: bool) -> Result<Vec<u8>> {
        let ExportJob { model, request, registry, device, limits, events, stop, .. } = self.job;
        let around = Surroundings { registry, device, limits, events: *events, stop };
        let stored = match self.job.archive {
            Some(path) => Stored::open(path, Storage::default(), around)?,
            None => Stored::of_model(model, Storage::default(), around)?,
        };
        self.check_stop("before baking the motion")?;
        let before = stored.presentation(&request.cameras, request.up)?;
        let shown = match (request.cameras.as_slice(), request.up) {
            ([], None) => before.clone(),
            ([], up) => presented(&stored.model, &before.cameras, up)?,
            (cameras, up) => presented(&stored.model, cameras, up)?,
        };
        let rate = request.frames_per_second.map(|rate| rate as f32);
        // The duration follows from a rate that is stated.
        let seconds = before.seconds.filter(|_| rate.is_none());
        let presentation = Presentation { frames_per_second: rate.or(before.frames_per_second).or(Some(RATE as f32)), seconds, ..shown };
        // A layer that is there was made with a bound of its own.
        let max_error = (stored.bytes_of(StreamKind::Playback) == 0).then_some(max_error);
        let options = PlayableOptions { max_error, cameras: &request.cameras, presentation, poster: true, without_field: true, baked };
        Ok(stored.playable(options, around)?.bytes)
    }
    fn progress(&mut self, done: usize, total: usize) -> Result<()> {
        self.check_stop(&format!("after {done} of {total} parts"))?;
        self.job.events.emit(&Event::Progress { task: format!("export {}", self.job.format), done: done as u64, total: total as u64 });
        Ok(())
    }
}

impl Model {
    /// Writes the model in the format of the exporter `format` (`ply`, `spz`, `sog`, `gltf`, `splatv`, …) with its default settings. The file appears complete
    /// or not at all and must not exist. [`ExportJob`] has the other choices.
    ///
    /// # Errors
    /// As [`ExportJob::run`].
    pub fn export(&self, format: &str, path: impl AsRef<Path>) -> Result<ExportReport> {
        let session = self.session();
        ExportJob {
            model: self,
            archive: None,
            format,
            settings: &toml::Table::new(),
            request: ExportRequest::default(),
            out: path.as_ref(),
            overwrite: false,
            registry: session.registry(),
            device: session.device(),
            limits: session.limits(),
            events: session.events(),
            stop: &AtomicBool::new(false),
        }
        .run()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn origins_too_far_for_float32_are_told() {
        let gaussians = HostGaussians { means: vec![0.5, -0.25, 0.125], log_scales: vec![-3.0; 3], ..Default::default() };
        let at = |origin: f64| coarse(&gaussians, &Similarity { scale: 1.0, translation: [0.0, origin, 0.0] });
        assert_eq!(at(100.0), None);
        assert!(at(5e6).unwrap().contains("steps of 5.0e-1"), "{:?}", at(5e6));
        assert_eq!(coarse(&HostGaussians::default(), &Similarity::IDENTITY), None);
    }

    #[test]
    fn only_axes_of_length_one_point_up() {
        for up in [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.6, 0.0, 0.8]] {
            check_up(up).unwrap();
        }
        for up in [[0.0; 3], [0.0, 2.0, 0.0], [f64::NAN, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0]] {
            let message = check_up(up).unwrap_err().to_string();
            assert!(message.starts_with("up: ") && message.contains("[0, 0, 1]"), "{message}");
        }
    }
}
