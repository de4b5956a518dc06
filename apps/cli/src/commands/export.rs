//! `cc4dgs export`.

use super::Context;
use crate::args::{Export, Shots};
use crate::models::load_model;
use crate::{interrupt, shots};
use cc4dgs::export::{ExportJob, ExportRequest, check_time};
use cc4dgs_core::{Error, ExportTarget, ExporterPlugin, Registry, Result, config};
use cc4dgs_play::source::{Source, SourceKind};
use std::path::Path;

pub fn run(context: &Context, args: &Export) -> Result<()> {
    let plugin = context.registry.exporter(&args.format)?;
    let (scene_sets, exporter_sets): (Vec<String>, Vec<String>) = args.sets.iter().cloned().partition(|set| set.starts_with("scene."));
    let mut settings = toml::Table::new();
    config::set_all(&mut settings, &exporter_sets)?;
    // Mistakes are found before anything long begins.
    context.registry.build_exporter(&args.format, &settings)?;
    check_name(&args.out, plugin.target, &args.format)?;
    check_time(&context.registry, plugin, args.time)?;
    check_clock(&context.registry, plugin, &args.shots)?;
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    let images = plugin.info.capabilities.contains(&"images");
    let (shots, background) = match shots::choose(context, &args.shots, &scene_sets, &loaded.model, images) {
        // Formats of Gaussians are written for models that no orbit can look at, too.
        Err(Error::Data { .. }) if args.shots.scene.is_none() => (Vec::new(), None),
        chosen => chosen?,
    };
    let cameras = match &args.shots.scene {
        Some(scene) if plugin.info.capabilities.contains(&"player") => shots::capture_cameras(context, scene, &scene_sets, &loaded.model)?,
        _ => Vec::new(),
    };
    let request = ExportRequest {
        time_norm: args.time,
        frames: args.shots.frames.map(|n| n as usize),
        frames_per_second: args.shots.rate(),
        up: args.shots.up.into(),
        shots,
        background,
        cameras,
    };
    let source = Source::expect(&args.model)?;
    let archive = (source.kind == SourceKind::Archive).then_some(source.file);
    finish(
        context,
        &ExportJob {
            model: &loaded.model,
            archive: archive.as_deref(),
            format: &args.format,
            settings: &settings,
            request,
            out: &args.out,
            overwrite: args.overwrite,
            registry: &context.registry,
            device: &loaded.device,
            limits: &context.limits,
            events: &events,
            stop: interrupt::stop_flag()?,
        },
    )
}

/// Runs the job and reports it.
pub fn finish(context: &Context, job: &ExportJob) -> Result<()> {
    let report = job.run()?;
    context.output.result(&report, || {
        let what = match (report.gaussians, report.frames) {
            (0, frames) => format!("{frames} frames"),
            (gaussians, 0 | 1) => format!("{gaussians} Gaussians"),
            (gaussians, frames) => format!("{gaussians} Gaussians, {frames} instants"),
        };
        let first = format!("{}: {what}, {:.3} MB", report.file.display(), report.size_mb);
        [first, report.lost.clone()].into_iter().chain(report.notes.clone()).collect::<Vec<_>>().join("\n")
    })
}

/// Refuses a number of frames and their rate for formats that have no use for them.
fn check_clock(registry: &Registry, plugin: &ExporterPlugin, shots: &Shots) -> Result<()> {
    let can = |plugin: &ExporterPlugin, capability: &&str| plugin.info.capabilities.contains(capability);
    let name = plugin.info.name;
    for (option, given, useful) in [("--frames", shots.frames.is_some(), ["frames", "images"]), ("--fps", shots.fps.is_some(), ["player", "images"])] {
        if !given || useful.iter().any(|capability| can(plugin, capability)) {
            continue;
        }
        let others: Vec<&str> = registry.exporters().filter(|p| useful.iter().any(|capability| can(p, capability))).map(|p| p.info.name).collect();
        let problem = match (option, plugin.info.capabilities) {
            (_, capabilities) if capabilities.contains(&"still") => format!("{name} holds one instant"),
            ("--fps", _) => format!("{name} says nothing of how fast it is played"),
            _ => format!("{name} holds the whole time of a model"),
        };
        return Err(Error::parameter(option, problem, format!("Leave it out, or choose one of the formats that use it: {}", others.join(", "))));
    }
    Ok(())
}

/// Other programs go by the ending of a file.
fn check_name(out: &Path, target: ExportTarget, format: &str) -> Result<()> {
    match target.at(out) {
        ExportTarget::File(extension) if out.extension().is_none_or(|e| !e.eq_ignore_ascii_case(extension)) => {
            let remedy = format!("Name it {}", out.with_extension(extension).display());
            Err(Error::parameter(format!("--out {}", out.display()), format!("{format} files end in .{extension}"), remedy))
        }
        _ => Ok(()),
    }
}
