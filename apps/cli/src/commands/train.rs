//! `cc4dgs train`.

use super::Context;
use crate::args::Train;
use crate::ignored::{Stated, refuse_ignored};
use crate::interrupt;
use cc4dgs::plugins;
use cc4dgs::runs::{EVENTS, Existing, check_folder};
use cc4dgs_core::{Error, Result, resolved_device};
use cc4dgs_train::auto;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::layers::Layers;
use cc4dgs_train::train::{CONFIG, Observer, TrainJob, TrainReport, train};
use serde::Serialize;
use std::path::Path;

#[derive(Serialize)]
struct Report<'a> {
    scene: String,
    preset: String,
    device: String,
    seed: u64,
    iterations: usize,
    /// What the preset `auto` chose, and why.
    plan: &'a [String],
    #[serde(flatten)]
    train: &'a TrainReport,
}

pub fn run(context: &Context, args: &Train, observer: Option<&dyn Observer>) -> Result<()> {
    let own = args.out.join(CONFIG);
    // A resumed run goes on with its own settings unless told otherwise.
    let file = match &args.config {
        None if args.resume && args.preset.is_none() && own.exists() => Some(own.as_path()),
        given => given.as_deref(),
    };
    // Without preset and configuration, `auto` chooses settings for the scene.
    let preset = args.preset.as_deref().or((file.is_none()).then_some(auto::PRESET));
    refuse_overruled(&args.sets, "auto.minutes", "--minutes", args.minutes.is_some())?;
    let minutes = args.minutes.map(|minutes| format!("auto.minutes={minutes}"));
    let sets: Vec<String> = args.sets.iter().cloned().chain(minutes).collect();
    let layers = layers(context, preset, file, &sets, args.device.as_deref())?;
    refuse_minutes(&sets, args.minutes.is_some(), &layers)?;
    let existing = match (args.resume, args.overwrite) {
        (true, _) => Existing::Resume,
        (false, true) => Existing::Overwrite,
        (false, false) => Existing::Refuse,
    };
    let trained = train_into(context, &layers, &args.scene, &args.out, existing, observer)?;
    let Trained { scene, config, report } = &trained;
    let (preset, device) = (config.preset.clone(), config.device.clone());
    let shown = Report { scene: scene.clone(), preset, device, seed: config.seed, iterations: report.iterations, plan: &config.auto.plan, train: report };
    context.output.result(&shown, || text(report))
}

/// Preset, file and overrides, with the device and the limits of the command line on top.
pub fn layers(context: &Context, preset: Option<&str>, file: Option<&Path>, sets: &[String], device: Option<&str>) -> Result<Layers> {
    refuse_overruled(sets, "device", "--device", device.is_some())?;
    for limit in context.limit_options {
        let name = limit.split_once('=').map_or(limit.as_str(), |(name, _)| name);
        refuse_overruled(sets, &format!("limits.{}", name.trim()), &format!("--limit {limit}"), true)?;
    }
    let limits = context.limit_options.iter().map(|option| format!("limits.{option}"));
    let device = device.map(|name| format!("device={}", resolved_device(name)));
    let sets: Vec<String> = sets.iter().cloned().chain(limits).chain(device).collect();
    Layers::collect(&context.registry, preset, file, &sets)
}

/// Refuses the time of a training among `sets`, which is that of --minutes where this is `stated`, where `layers` ask for no plan.
fn refuse_minutes(sets: &[String], stated: bool, layers: &Layers) -> Result<()> {
    let Some(set) = assignment(sets, "auto.minutes").filter(|_| !layers.want_plan()) else { return Ok(()) };
    let object = if stated { "--minutes".into() } else { format!("--set {set}") };
    let remedy = "Leave --preset, --config and --resume out, or set train.iterations";
    Err(Error::parameter(object, "only the preset auto plans for a time", remedy))
}

/// The first of `sets` that assigns to `key`.
fn assignment<'a>(sets: &'a [String], key: &str) -> Option<&'a String> {
    sets.iter().find(|set| set.split_once('=').is_some_and(|(name, _)| name.trim() == key))
}

/// Refuses the setting `key` among `sets` where an option of the command line, `option`, is stated, which takes its place.
fn refuse_overruled(sets: &[String], key: &str, option: &str, stated: bool) -> Result<()> {
    let value = assignment(sets, key).cloned();
    refuse_ignored(&format!("a command with {option}"), [Stated { option: "--set", value, used: !stated, remedy: "Leave one of the two out".into() }])
}

/// A training that ended.
pub struct Trained {
    /// Name of the scene.
    pub scene: String,
    /// The settings, with what the preset `auto` chose.
    pub config: RunConfig,
    /// Its report.
    pub report: TrainReport,
}

/// Trains the scene at `scene_path` into the folder `out`; `observer` looks at it.
pub fn train_into(context: &Context, layers: &Layers, scene_path: &Path, out: &Path, existing: Existing, observer: Option<&dyn Observer>) -> Result<Trained> {
    let stop = interrupt::stop_flag()?;
    let remedy = match existing {
        Existing::Resume => "Leave --resume out to begin; add --overwrite where a run ended before its first checkpoint",
        _ => "Go on with it (train --resume), start anew in its place (--overwrite), or choose another folder",
    };
    check_folder(out, existing, remedy)?;
    if !layers.want_plan() {
        plugins::check(&layers.config()?, &context.registry)?;
    }
    let (config, scene) = auto::open(scene_path, layers, &context.registry, &context.listeners(None)?, stop)?;
    plugins::check(&config, &context.registry)?;
    // Opened only now: a mistyped path must not wipe the log of an earlier run.
    let resume = existing == Existing::Resume;
    let events = context.listeners(Some((&out.join(EVENTS), resume)))?;
    let job =
        TrainJob { config: &config, scene: scene.clone(), out: Some(out.to_path_buf()), resume, registry: &context.registry, events: &events, stop, observer };
    let report = train(&job)?.1;
    Ok(Trained { scene: scene.name.clone(), config, report })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_needs_a_plan() {
        let registry = cc4dgs_core::Registry::collect().unwrap();
        let refused = |preset: &str, set: &str, stated| {
            let sets = vec![set.to_string()];
            let layers = Layers::collect(&registry, Some(preset), None, &sets).unwrap();
            refuse_minutes(&sets, stated, &layers).map_err(|error| error.to_string())
        };
        assert_eq!((refused("auto+hexplane", "auto.minutes=3", false), refused("demo", "seed=3", false)), (Ok(()), Ok(())));
        for (stated, object) in [(true, "--minutes: "), (false, "--set auto.minutes=3: ")] {
            let message = refused("demo", "auto.minutes=3", stated).unwrap_err();
            assert!(message.starts_with(object) && message.contains("only the preset auto") && message.contains("train.iterations"), "{message}");
        }
    }

    #[test]
    fn settings_that_an_option_replaces_are_refused() {
        let refused = |sets: &[&str], stated| {
            let sets: Vec<String> = sets.iter().map(ToString::to_string).collect();
            refuse_overruled(&sets, "auto.minutes", "--minutes", stated).map_err(|error| error.to_string())
        };
        assert_eq!((refused(&["auto.minutes=3"], false), refused(&["auto.method=none", "seed=3"], true)), (Ok(()), Ok(())));
        let message = refused(&["seed=3", "auto.minutes=3"], true).unwrap_err();
        assert_eq!(message, "--set auto.minutes=3: it has no effect on a command with --minutes. Leave one of the two out");
    }
}
