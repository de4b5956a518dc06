//! A session holds what most calls need (plug-ins, limits, events, the device), so that a program states it once.

use crate::Model;
use crate::runs::{Existing, check_folder};
use crate::{plugins, scenes};
use burn::tensor::Device;
use cc4dgs_core::{Error, Event, EventSink, Limits, Registry, Result, Scene, SceneOptions, Silent, Split, parse_device, resolved_device};
use cc4dgs_play::player::Player;
use cc4dgs_train::auto;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data;
use cc4dgs_train::eval::{EvalReport, Scored, evaluate};
use cc4dgs_train::layers::Layers;
use cc4dgs_train::train::{CONFIG, TrainJob, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Plug-ins, limits, events and the device. Cloning shares them.
#[derive(Clone)]
pub struct Session {
    shared: Arc<Shared>,
}

struct Shared {
    registry: Registry,
    limits: Limits,
    events: Arc<dyn EventSink>,
    device: Device,
    device_name: String,
    stop: AtomicBool,
}

/// How a [`Session`] is set up; see [`Session::builder`].
pub struct SessionBuilder {
    device: String,
    limits: Limits,
    events: Arc<dyn EventSink>,
}

impl SessionBuilder {
    /// The device to compute on: `auto` (the default: a graphics card if there is one, else `flex`), `flex`, `ndarray`, `wgpu`, `wgpu:N` or `cuda`.
    pub fn device(mut self, name: impl Into<String>) -> Self {
        self.device = name.into();
        self
    }
    /// Upper bounds for what readers accept of files.
    pub fn limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
    }
    /// Receives all events; by default they are dropped.
    pub fn events(mut self, sink: impl EventSink + 'static) -> Self {
        self.events = Arc::new(sink);
        self
    }
    /// Calls `listener` with every event, from any thread.
    pub fn on_event(self, listener: impl Fn(&Event) + Send + Sync + 'static) -> Self {
        self.events(Listener(listener))
    }
    /// Collects the linked plug-ins and starts the device.
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown device and for two plug-ins of one name,
    /// [`Error::Unsupported`] for a device that does not answer.
    pub fn build(self) -> Result<Session> {
        let device_name = resolved_device(&self.device).to_string();
        let device = parse_device(&device_name)?;
        let (limits, events, stop) = (self.limits, self.events, AtomicBool::new(false));
        Ok(Session { shared: Arc::new(Shared { registry: Registry::collect()?, limits, events, device, device_name, stop }) })
    }
}

struct Listener<F>(F);

impl<F: Fn(&Event) + Send + Sync> EventSink for Listener<F> {
    fn emit(&self, event: &Event) {
        (self.0)(event);
    }
}

impl Session {
    /// A session with the defaults: device `auto`, default limits, no listener.
    ///
    /// # Errors
    /// As [`SessionBuilder::build`].
    pub fn new() -> Result<Self> {
        Self::builder().build()
    }
    /// Starts from the defaults.
    pub fn builder() -> SessionBuilder {
        SessionBuilder { device: "auto".into(), limits: Limits::default(), events: Arc::new(Silent) }
    }
    /// The linked plug-ins.
    pub fn registry(&self) -> &Registry {
        &self.shared.registry
    }
    /// Upper bounds for what readers accept of files.
    pub fn limits(&self) -> &Limits {
        &self.shared.limits
    }
    /// Receives all events.
    pub fn events(&self) -> &dyn EventSink {
        self.shared.events.as_ref()
    }
    /// The device to compute on.
    pub fn device(&self) -> &Device {
        &self.shared.device
    }
    /// Asks a running [`Session::train`] to stop after its current iteration, with a checkpoint where it has a folder, and a running [`Session::plan`] or
    /// [`Model::save_tuned`] to end with nothing. What begins later is not stopped. May be called from any thread.
    ///
    /// A program that calls it on Ctrl-C also calls `cc4dgs::train::data::answers_interrupts` first: else Ctrl-C ends an ffmpeg that decodes a video, and
    /// opening the scene fails.
    pub fn stop(&self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }
    /// The flag that [`Session::stop`] sets, for work that begins now: an earlier stop is forgotten.
    pub(crate) fn stop_flag(&self) -> &AtomicBool {
        self.shared.stop.store(false, Ordering::Relaxed);
        &self.shared.stop
    }
    /// The settings of a preset (`demo`, `dnerf+hexplane`) with `key=value` overrides, on this session's device and limits.
    ///
    /// # Errors
    /// [`Error::Parameter`] for unknown presets, unknown keys and values out of range, and for `auto`, which chooses by looking at a scene: that is
    /// [`Session::plan`].
    pub fn config(&self, preset: &str, overrides: &[&str]) -> Result<RunConfig> {
        let overrides: Vec<String> = overrides.iter().map(ToString::to_string).collect();
        let layers = Layers::collect(self.registry(), Some(preset), None, &overrides)?;
        if layers.want_plan() {
            let remedy = "Call Session::plan with the path of the scene; the override deformer.kind=NAME chooses another method";
            return Err(Error::parameter(format!("preset '{preset}'"), "it chooses settings by looking at a scene, and none is given", remedy));
        }
        Ok(self.adopted(layers.config()?))
    }
    /// Opens the dataset at `path` and chooses the settings of a training by looking at it (the preset `auto`), with `key=value` overrides, on this session's
    /// device and limits. `auto.minutes=5` states the time for the training.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after [`Session::stop`]; as [`Session::config`] and [`Session::read_scene`].
    pub fn plan(&self, path: impl AsRef<Path>, overrides: &[&str]) -> Result<(RunConfig, Arc<Scene>)> {
        let device = format!("device={}", self.shared.device_name);
        let overrides: Vec<String> = overrides.iter().map(ToString::to_string).chain([device]).collect();
        let layers = Layers::collect(self.registry(), Some(auto::PRESET), None, &overrides)?;
        let (config, scene) = auto::open(path.as_ref(), &layers, self.registry(), self.events(), self.stop_flag())?;
        Ok((self.adopted(config), scene))
    }
    /// Opens the dataset at `path`; `procedural` and `procedural:NAME` are built in. Images are decoded later, on demand.
    ///
    /// # Errors
    /// What the reader reports: options without meaning, formats that are not known, broken files, claims over the limits.
    pub fn read_scene(&self, path: impl AsRef<Path>, options: &SceneOptions) -> Result<Scene> {
        data::open(path.as_ref(), options, self.registry(), self.limits())
    }
    /// Opens the dataset at `path` as `model` was trained on it. The configuration stored in a model never chooses programs to run, folders to write or memory
    /// to take.
    ///
    /// # Errors
    /// As [`Session::read_scene`].
    pub fn open_scene(&self, path: impl AsRef<Path>, model: &Model) -> Result<Scene> {
        scenes::open_as_trained(path.as_ref(), model, &[], self.registry(), self.limits())
    }
    /// Trains on `scene`. With a folder, checkpoint and configuration are left there; it must not hold a run already.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after [`Session::stop`], [`Error::Backend`] when the loss is no longer a
    /// number, and whatever scene, plug-ins and disk report.
    pub fn train(&self, config: &RunConfig, scene: impl Into<Arc<Scene>>, out: Option<&Path>) -> Result<Model> {
        if let Some(folder) = out {
            check_folder(folder, Existing::Refuse, "Choose another folder, or go on with Session::resume")?;
        }
        self.run(config, scene.into(), out, false)
    }
    /// Goes on with the run in `folder` from its checkpoint; the result is the same as without the interruption. The session must compute on the device that
    /// the run's `config.toml` names.
    ///
    /// # Errors
    /// As [`Session::train`], and for a folder without a run.
    pub fn resume(&self, scene: impl Into<Arc<Scene>>, folder: &Path) -> Result<Model> {
        check_folder(folder, Existing::Resume, "Begin with Session::train")?;
        let config = RunConfig::resolve(None, Some(&folder.join(CONFIG)), &[])?;
        self.run(&config, scene.into(), Some(folder), true)
    }
    fn run(&self, config: &RunConfig, scene: Arc<Scene>, out: Option<&Path>, resume: bool) -> Result<Model> {
        let config = &self.adopted(config.clone());
        plugins::check(config, self.registry())?;
        let (registry, events, stop) = (self.registry(), self.events(), self.stop_flag());
        let (model, _) = train(&TrainJob { config, scene, out: out.map(Path::to_path_buf), resume, registry, events, stop, observer: None })?;
        Ok(Model::new(model, self.clone()))
    }
    /// The configuration with this session's device and limits.
    fn adopted(&self, mut config: RunConfig) -> RunConfig {
        (config.device, config.limits) = (self.shared.device_name.clone(), self.shared.limits);
        config
    }
    /// Opens a model: the folder of a run, a checkpoint, an archive, a PLY or an SPZ file. The first bytes decide.
    ///
    /// # Errors
    /// As [`cc4dgs_play::model::Model::open`].
    pub fn open(&self, path: impl AsRef<Path>) -> Result<Model> {
        let inner = cc4dgs_play::model::Model::open(path.as_ref(), self.registry(), self.device(), self.limits(), self.events())?;
        Ok(Model::new(inner, self.clone()))
    }
    /// Uploads `model` for playback.
    ///
    /// # Errors
    /// What the rasterizer says of the model's settings.
    pub fn player<'a>(&self, model: &'a Model) -> Result<Player<'a>> {
        Player::new(model, self.registry(), self.device())
    }
    /// Scores `model` against the images of one side of the scene's split.
    ///
    /// # Errors
    /// As [`evaluate`].
    pub fn evaluate(&self, model: &Model, scene: &Scene, split: Split) -> Result<EvalReport> {
        evaluate(model, scene, Scored::all(split), self.registry(), self.device(), self.events(), &mut |_, _, _, _| Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_need_a_scene_are_planned() {
        let session = Session::builder().device("flex").build().unwrap();
        for preset in ["auto", "auto+hexplane"] {
            let message = session.config(preset, &[]).err().unwrap().to_string();
            assert!(message.contains(preset) && message.contains("Session::plan"), "{message}");
        }
        session.config("demo", &[]).unwrap();
    }

    #[test]
    fn a_stop_is_for_what_runs() {
        let session = Session::builder().device("flex").build().unwrap();
        session.stop();
        assert!(!session.stop_flag().load(Ordering::Relaxed));
    }
}
