//! `cc4dgs bake`.

use super::{Context, check_file, create_parent, megabytes};
use crate::args::Bake;
use crate::interrupt;
use crate::shots::capture_cameras;
use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings, presented};
use cc4dgs_core::archive::{Archive, Presentation, StreamKind, write_atomically};
use cc4dgs_core::{Camera, Error, Event, EventSink, Registry, Result, parse_device, toml};
use cc4dgs_play::ArchiveOptions;
use cc4dgs_play::bake::{BakeReport, MaxError};
use cc4dgs_play::source::{Source, SourceKind};
use serde::Serialize;
use std::ops::RangeInclusive;
use std::path::PathBuf;
use std::time::Instant;

/// Frames per second of a recording.
const RATES: RangeInclusive<f32> = 0.01..=1000.0;

#[derive(Serialize)]
struct Report {
    archive: PathBuf,
    bytes: u64,
    /// Bytes of the layer as stored.
    layer_bytes: u64,
    /// Bytes of the deformer's weights as stored; what the layer stands in for.
    field_bytes: u64,
    poster_bytes: u64,
    seconds: f64,
    /// Absent where nothing moves.
    layer: Option<BakeReport>,
}

pub fn run(context: &Context, args: &Bake) -> Result<()> {
    let began = Instant::now();
    check_file(&args.out, args.overwrite)?;
    let max_error: MaxError = args.max_error.parse()?;
    if let Some(rate) = args.fps.filter(|rate| !RATES.contains(rate)) {
        return Err(Error::parameter("--fps", format!("{rate} frames per second"), format!("Choose {} to {}", RATES.start(), RATES.end())));
    }
    let storage = storage(args, &context.registry)?;
    let (events, device) = (context.listeners(None)?, parse_device(&args.device)?);
    create_parent(&args.out)?;
    let stop = interrupt::stop_flag()?;
    let around = Surroundings { registry: &context.registry, device: &device, limits: &context.limits, events: &events, stop };
    let stored = Stored::open(&args.model, storage.unwrap_or_default(), around)?;
    let cameras = match &args.scene {
        Some(scene) => capture_cameras(context, scene, &args.sets, &stored.model)?,
        None => stored.archive.manifest().presentation.cameras.clone(),
    };
    let presentation = shown(args, &stored, &cameras)?;
    let options = PlayableOptions {
        max_error: Some(max_error),
        cameras: &cameras,
        presentation,
        poster: !args.no_poster,
        without_field: args.without_field,
        baked: true,
    };
    let playable = stored.playable(options, around)?;
    let codec = storage.map(|storage| context.registry.build_codec(storage.codec, &toml::Table::new())).transpose()?;
    if let Some(most) = codec.and_then(|codec| codec.most_bytes()).filter(|most| playable.bytes.len() as u64 > *most) {
        let problem = format!("with playback layer and poster the file has {} bytes, {most} are allowed", playable.bytes.len());
        return Err(Error::parameter("--codec", problem, "Bound the model lower, allow a larger --max-error, or leave the poster out (--no-poster)"));
    }
    interrupt::check(stop, "in baking; nothing was written")?;
    write_atomically(&args.out, &playable.bytes)?;
    let bytes = playable.bytes.len() as u64;
    events.emit(&Event::Saved { path: args.out.display().to_string(), bytes });
    let written = Archive::from_bytes(args.out.display().to_string(), playable.bytes, &context.limits)?;
    let of_kind = |kind| written.stream_sizes().iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum();
    let report = Report {
        archive: args.out.clone(),
        bytes,
        layer_bytes: of_kind(StreamKind::Playback),
        field_bytes: stored.bytes_of(StreamKind::Field),
        poster_bytes: of_kind(StreamKind::Poster),
        seconds: began.elapsed().as_secs_f64(),
        layer: playable.report,
    };
    context.output.result(&report, || text(&report))
}

/// How the model is to be stored; `None` where it is an archive, whose streams are kept. What needs a scene is refused: `--scene` gives cameras alone.
fn storage<'a>(args: &'a Bake, registry: &Registry) -> Result<Option<Storage<'a>>> {
    let default = Storage::default();
    let codec = args.codec.as_deref().unwrap_or(default.codec);
    let field_weights = args.field_weights.as_deref().unwrap_or(default.field_weights);
    ArchiveOptions::check(codec, &toml::Table::new(), field_weights, false, registry)?;
    if Source::expect(&args.model)?.kind == SourceKind::Archive {
        let stated = args.codec.as_ref().map(|_| "--codec").or(args.field_weights.as_ref().map(|_| "--field-weights"));
        let problem = "the model is an archive, whose Gaussians and weights are kept as they are";
        return stated.map_or(Ok(None), |option| Err(Error::parameter(option, problem, "Leave it out, or bake the run that the archive was made of")));
    }
    Ok(Some(Storage { codec, field_weights }))
}

/// Clock and cameras of the archive, overridden by those of `cameras` and of the options where these are given.
fn shown(args: &Bake, stored: &Stored, cameras: &[Camera]) -> Result<Presentation> {
    let (up, before) = (args.up.map(Into::into), stored.presentation(cameras, None)?);
    let replaced = args.scene.is_some() || args.up.is_some();
    let (rate, seconds) = (args.fps.or(before.frames_per_second), before.seconds);
    let base = if replaced { presented(&stored.model, cameras, up)? } else { before };
    let intervals = stored.model.frame_count.saturating_sub(1).max(1) as f32;
    let seconds = if args.fps.is_some() { None } else { seconds };
    Ok(Presentation { frames_per_second: rate, seconds: seconds.or(rate.map(|rate| intervals / rate)), ..base })
}

fn text(report: &Report) -> String {
    let first = format!(
        "{}: {:.4} MB, of which the layer {:.4} MB (weights of the deformer: {:.4} MB), poster {:.4} MB, in {:.1} s",
        report.archive.display(),
        megabytes(report.bytes),
        megabytes(report.layer_bytes),
        megabytes(report.field_bytes),
        megabytes(report.poster_bytes),
        report.seconds
    );
    let Some(layer) = &report.layer else { return format!("{first}\n  nothing moves: no layer is needed") };
    let (bound, unit) = match layer.max_error {
        MaxError::Pixels(value) => (value, "px"),
        MaxError::Length(value) => (value, " units"),
    };
    let mut lines = vec![
        first,
        format!(
            "  {} moving Gaussians, {} samples in {} segments; error at samples up to {:.3} of the bound of {bound}{unit}, between them {:.3}",
            layer.moving, layer.samples, layer.segments, layer.at_samples, layer.between_samples
        ),
        format!(
            "  of {} Gaussians, 99 % are within {:.3} of the bound between samples, and {:.1} % are over it",
            layer.between_measured,
            layer.between_p99,
            100.0 * layer.between_over
        ),
    ];
    lines.extend(layer.heads.iter().map(|h| {
        format!(
            "  {:<11} up to {} functions, {} Gaussians, {} coefficients, error up to {:.3} of its tolerance",
            h.head, h.functions, h.rows, h.coefficients, h.max_error
        )
    }));
    lines.join("\n")
}
