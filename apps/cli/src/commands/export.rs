//! `cc4dgs export`.

use super::{Context, check_writable};
use crate::args::Export;
use crate::ignored::{Stated, refuse_ignored, written};
use crate::models::load_model;
use crate::{interrupt, shots};
use cc4dgs::export::{ExportJob, ExportRequest, check_time};
use cc4dgs_core::exporter::check_target;
use cc4dgs_core::{Error, ExportTarget, ExporterPlugin, Registry, Result, config, plural};
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
    check_options(&context.registry, plugin, args, &scene_sets)?;
    shots::check_sets(&args.shots, &scene_sets)?;
    check_time(&context.registry, plugin, args.time)?;
    check_target(&args.out, plugin.target, args.overwrite)?;
    check_writable(&args.out)?;
    let events = context.listeners(None)?;
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    let images = plugin.info.capabilities.contains(&"images");
    // For formats that draw no image and begin at no camera, a dataset would be opened for nothing.
    let (shots, background) = match has_one(plugin, &["camera", "images"]).then(|| shots::choose(context, &args.shots, &scene_sets, &loaded.model, images)) {
        None => (Vec::new(), None),
        // Formats of Gaussians are written for models that no orbit can look at, too.
        Some(Err(Error::Data { .. })) if args.shots.scene.is_none() => (Vec::new(), None),
        Some(chosen) => chosen?,
    };
    let cameras = match &args.shots.scene {
        Some(scene) if plugin.info.capabilities.contains(&"player") => shots::capture_cameras(context, scene, &scene_sets, &loaded.model)?,
        _ => Vec::new(),
    };
    let request = ExportRequest {
        time_norm: args.time,
        frames: args.shots.frames.map(|n| n as usize),
        frames_per_second: args.shots.fps,
        up: args.shots.up.map(Into::into),
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
            (0, frames) => format!("{frames} {}", plural(frames, "frame", "frames")),
            (gaussians, 0 | 1) => format!("{gaussians} {}", plural(gaussians, "Gaussian", "Gaussians")),
            (gaussians, frames) => format!("{gaussians} Gaussians, {frames} instants"),
        };
        let first = format!("{}: {what}, {:.3} MB", report.file.display(), report.size_mb);
        [first, report.lost.clone()].into_iter().chain(report.notes.clone()).collect::<Vec<_>>().join("\n")
    })
}

/// Refuses options that the format has no use for; `scene_sets` are the scene options among `--set`. A format says by its capabilities what it uses.
fn check_options(registry: &Registry, plugin: &ExporterPlugin, args: &Export, scene_sets: &[String]) -> Result<()> {
    let shots = &args.shots;
    let options: [(&str, Option<String>, &[&str]); 9] = [
        ("--time", args.time.map(|time| time.to_string()), &["still"]),
        ("--frames", shots.frames.map(|frames| frames.to_string()), &["frames", "images"]),
        ("--fps", shots.fps.map(|rate| rate.to_string()), &["rate", "images", "player"]),
        ("--scene", shots.scene.as_ref().map(|scene| scene.display().to_string()), &["camera", "images", "player"]),
        ("--set", scene_sets.first().cloned(), &["camera", "images", "player"]),
        ("--split", shots.split.as_ref().map(written), &["camera", "images"]),
        ("--size", shots.size.map(|(width, height)| format!("{width}x{height}")), &["camera", "images"]),
        ("--turns", shots.turns.map(|turns| turns.to_string()), &["images"]),
        ("--up", shots.up.as_ref().map(written), &["up", "camera", "images", "player"]),
    ];
    let stated = options.map(|(option, value, capabilities)| {
        let users: Vec<&str> = registry.exporters().filter(|other| has_one(other, capabilities)).map(|other| other.info.name).collect();
        let remedy = format!("Leave it out, or choose one of the formats that use it: {}", users.join(", "));
        Stated { option, value, used: has_one(plugin, capabilities), remedy }
    });
    refuse_ignored(&format!("the format {}", plugin.info.name), stated)?;
    // With these, it is the axis of more than the orbit.
    if has_one(plugin, &["up", "player"]) { Ok(()) } else { shots::check_up(shots) }
}

/// Whether the exporter has one of `capabilities`.
fn has_one(plugin: &ExporterPlugin, capabilities: &[&str]) -> bool {
    capabilities.iter().any(|capability| plugin.info.capabilities.contains(capability))
}

/// Refuses other endings than that of the format, by which other programs recognise it.
fn check_name(out: &Path, target: ExportTarget, format: &str) -> Result<()> {
    match target.at(out) {
        ExportTarget::File(extension) if out.extension().is_none_or(|e| !e.eq_ignore_ascii_case(extension)) => {
            let remedy = format!("Name it {}", out.with_extension(extension).display());
            Err(Error::parameter(format!("--out {}", out.display()), format!("{format} files end in .{extension}"), remedy))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Cli, Command};
    use cc4dgs_core::Plugin;
    use clap::Parser;

    /// What `export` says of the options in `line`, in the format `plugin`.
    fn checked(registry: &Registry, plugin: &ExporterPlugin, line: &str) -> std::result::Result<(), String> {
        let cli = Cli::try_parse_from(format!("cc4dgs export {} model --out file {line}", plugin.info.name).split_whitespace()).unwrap();
        let Command::Export(args) = &cli.command else { panic!("{line}") };
        check_options(registry, plugin, args, &args.sets).map_err(|error| error.to_string())
    }

    #[test]
    fn every_format_takes_what_it_uses_and_refuses_the_rest() {
        let registry = Registry::collect().unwrap();
        let lines = [
            "--time 0.5",
            "--frames 3",
            "--fps 24",
            "--scene a",
            "--scene a --set scene.width=8",
            "--set scene.width=8",
            "--scene a --split train",
            "--size 64x48",
            "--turns 2",
            "--up y",
            "--scene a --up y",
        ];
        let formats: [(&str, &[usize]); 8] = [
            ("ply", &[0]),
            ("spz", &[0]),
            ("sog", &[0]),
            ("gltf", &[0, 9]),
            ("ply-sequence", &[1]),
            ("splatv", &[3, 4, 5, 6, 7, 9]),
            ("web", &[2, 3, 4, 5, 9, 10]),
            ("mp4", &[1, 2, 3, 4, 5, 6, 7, 8, 9]),
        ];
        for (format, taken) in formats {
            let plugin = registry.exporter(format).unwrap();
            let found: Vec<usize> = (0..lines.len()).filter(|index| checked(&registry, plugin, lines[*index]).is_ok()).collect();
            assert_eq!(found, taken, "{format}");
        }
        let ply = registry.exporter("ply").unwrap();
        let message = checked(&registry, ply, "--size 64x48").unwrap_err();
        assert_eq!(message, "--size 64x48: it has no effect on the format ply. Leave it out, or choose one of the formats that use it: mp4, splatv");
        let message = checked(&registry, registry.exporter("mp4").unwrap(), "--scene a --up=-x").unwrap_err();
        assert!(message.contains("--up -x: it has no effect on the cameras of --scene"), "{message}");
    }

    #[test]
    fn a_format_of_another_crate_says_what_it_takes() {
        let of = |capabilities: &'static [&'static str]| ExporterPlugin {
            info: Plugin { name: "usd", version: "1", summary: "", paper: "", schema: "", capabilities },
            target: ExportTarget::File("usd"),
            build: |_| Err(Error::parameter("usd", "it cannot be built", "Leave it")),
        };
        let registry = Registry::collect().unwrap();
        let all = "--frames 3 --fps 24 --scene a --split train --size 64x48";
        assert_eq!(checked(&registry, &of(&["motion", "frames", "rate", "camera"]), all), Ok(()));
        let refusals: [(&[&str], &str); 3] =
            [(&["motion", "rate", "camera"], "--frames 3"), (&["frames", "camera"], "--fps 24"), (&["frames", "rate"], "--scene a")];
        for (capabilities, refused) in refusals {
            let message = checked(&registry, &of(capabilities), all).unwrap_err();
            assert!(message.contains(&format!("{refused}: it has no effect on the format usd")), "{message}");
        }
        assert!(checked(&registry, &of(&[]), "--time 0.5").unwrap_err().contains("gltf, ply, sog, spz"));
    }
}
