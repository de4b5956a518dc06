//! `cc4dgs train`.

use super::Context;
use crate::args::Train;
use crate::interrupt;
use cc4dgs_core::{AppearanceContext, DeformerContext, Result, Scene, Seed, parse_device};
use cc4dgs_engine::config::RunConfig;
use cc4dgs_engine::data;
use cc4dgs_engine::train::{CONFIG, TrainJob, TrainReport, train};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

/// Name of the log inside a run's folder.
pub const EVENTS: &str = "events.jsonl";

#[derive(Serialize)]
struct Report<'a> {
    scene: String,
    preset: String,
    device: String,
    seed: u64,
    iterations: usize,
    #[serde(flatten)]
    train: &'a TrainReport,
}

pub fn run(context: &Context, args: &Train) -> Result<()> {
    let own = args.out.join(CONFIG);
    // A resumed run goes on with its own settings unless told otherwise.
    let file = match &args.config {
        None if args.resume && args.preset.is_none() && own.exists() => Some(own.as_path()),
        given => given.as_deref(),
    };
    let config = resolve(context, args.preset.as_deref(), file, &args.sets, args.device.as_deref())?;
    let (scene, report) = train_into(context, &config, &args.scene, &args.out, args.resume)?;
    let shown =
        Report { scene, preset: config.preset.clone(), device: config.device.clone(), seed: config.seed, iterations: config.train.iterations, train: &report };
    context.output.result(&shown, || text(&report))
}

/// The configuration of preset, file and overrides, with the device and the limits of the command line on top.
pub fn resolve(context: &Context, preset: Option<&str>, file: Option<&Path>, sets: &[String], device: Option<&str>) -> Result<RunConfig> {
    let limits = context.limit_options.iter().map(|option| format!("limits.{option}"));
    let device = device.map(|name| format!("device={name}"));
    let sets: Vec<String> = sets.iter().cloned().chain(limits).chain(device).collect();
    RunConfig::resolve(preset, file, &sets)
}

/// Trains the scene at `scene_path` into the folder `out`; returns the scene's name and the report.
pub fn train_into(context: &Context, config: &RunConfig, scene_path: &Path, out: &Path, resume: bool) -> Result<(String, TrainReport)> {
    let stop = interrupt::stop_flag()?;
    check_plugins(context, config)?;
    let scene: Arc<Scene> = Arc::new(data::open(scene_path, &config.scene, &config.limits)?);
    // Opened only now: a mistyped path must not wipe the log of an earlier run.
    let events = context.listeners(Some((&out.join(EVENTS), resume)))?;
    let job = TrainJob { config, scene: scene.clone(), out: Some(out.to_path_buf()), resume, registry: &context.registry, events: &events, stop };
    Ok((scene.name.clone(), train(&job)?.1))
}

/// Builds every plug-in of the configuration once and drops it: a mistake in the deformer's settings should not wait for the main stage, nor leave
/// a folder behind.
fn check_plugins(context: &Context, config: &RunConfig) -> Result<()> {
    let device = parse_device(&config.device)?;
    context.registry.build_rasterizer(&config.rasterizer)?;
    let seed = Seed::root(config.seed).child("check");
    let field = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: config.train.sh_degree, seed };
    context.registry.build_deformer(&config.deformer, &field, &device)?;
    context.registry.build_density(&config.density)?;
    context.registry.build_appearance(&config.appearance, &AppearanceContext { cameras: 1, seed }, &device)?;
    context.registry.build_optimizer(&config.optimizer)?;
    Ok(())
}

/// The report for people.
pub fn text(report: &TrainReport) -> String {
    let stages: Vec<String> = report.stage_seconds.iter().map(|(name, s)| format!("{name} {s:.1} s")).collect();
    format!(
        "trained in {:.1} s ({}): {} Gaussians, {} of them dynamic\ncheckpoint {}",
        report.seconds,
        stages.join(", "),
        report.gaussians,
        report.dynamic_gaussians,
        report.checkpoint.as_ref().map_or_else(String::new, |path| path.display().to_string())
    )
}
