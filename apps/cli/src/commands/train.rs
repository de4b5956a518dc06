//! `cc4dgs train`.

use super::Context;
use crate::args::Train;
use crate::interrupt;
use cc4dgs::plugins;
use cc4dgs::runs::{EVENTS, Existing, check_folder};
use cc4dgs_core::{Result, Scene};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::data;
use cc4dgs_train::train::{CONFIG, TrainJob, TrainReport, train};
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;

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
    let existing = match (args.resume, args.overwrite) {
        (true, _) => Existing::Resume,
        (false, true) => Existing::Overwrite,
        (false, false) => Existing::Refuse,
    };
    let (scene, report) = train_into(context, &config, &args.scene, &args.out, existing)?;
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
pub fn train_into(context: &Context, config: &RunConfig, scene_path: &Path, out: &Path, existing: Existing) -> Result<(String, TrainReport)> {
    let stop = interrupt::stop_flag()?;
    check_folder(out, existing, "Go on with it (train --resume), start anew in its place (--overwrite), or choose another folder")?;
    plugins::check(config, &context.registry)?;
    let scene: Arc<Scene> = Arc::new(data::open(scene_path, &config.scene, &context.registry, &config.limits)?);
    // Opened only now: a mistyped path must not wipe the log of an earlier run.
    let resume = existing == Existing::Resume;
    let events = context.listeners(Some((&out.join(EVENTS), resume)))?;
    let job = TrainJob { config, scene: scene.clone(), out: Some(out.to_path_buf()), resume, registry: &context.registry, events: &events, stop };
    Ok((scene.name.clone(), train(&job)?.1))
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
