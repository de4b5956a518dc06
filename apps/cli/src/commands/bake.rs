//! `cc4dgs bake`.

use super::{Context, create_parent, megabytes};
use crate::args::Bake;
use crate::models::load_model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::archive::{Archive, Presentation, StreamKind};
use cc4dgs_core::{Camera, Event, EventSink, Limits, Result, Split};
use cc4dgs_play::bake::{Additions, BakeOptions, BakeReport, MaxError, bake, write_archive};
use cc4dgs_play::player::Player;
use cc4dgs_play::{ArchiveOptions, Model, presentation};
use cc4dgs_train::images::encode_png;
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Longer side of the poster in pixels.
const POSTER: u32 = 320;

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
    let max_error: MaxError = args.max_error.parse()?;
    let events = context.listeners(None)?;
    create_parent(&args.out)?;
    let archive = as_archive(context, args, &events)?;
    // The model of the archive, not that of the checkpoint: codecs move and reorder Gaussians.
    let loaded = load_model(&archive, &args.device, &context.registry, &context.limits, &events)?;
    let cameras = capture_cameras(context, args, &loaded.model)?;
    let options = BakeOptions { max_error, cameras: &cameras };
    let baked = bake(&loaded.model, &options, &loaded.device, &events)?;
    let open = Archive::open(&archive, &context.limits)?;
    let presentation = presented(args, &open.manifest().presentation, &loaded.model, &cameras)?;
    let poster = match &presentation.home {
        Some(home) if !args.no_poster => Some(poster(context, &loaded.model, home, &loaded.device)?),
        _ => None,
    };
    let additions = Additions { baked: baked.as_ref(), presentation, poster, without_field: args.without_field };
    let bytes = write_archive(&open, additions, &args.out)?;
    events.emit(&Event::Saved { path: args.out.display().to_string(), bytes });
    let of_kind = |archive: &Archive, kind| archive.stream_sizes().iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum();
    let written = Archive::open(&args.out, &context.limits)?;
    let report = Report {
        archive: args.out.clone(),
        bytes,
        layer_bytes: of_kind(&written, StreamKind::Playback),
        field_bytes: of_kind(&open, StreamKind::Field),
        poster_bytes: of_kind(&written, StreamKind::Poster),
        seconds: began.elapsed().as_secs_f64(),
        layer: baked.map(|b| b.report),
    };
    context.output.result(&report, || text(&report))
}

/// The archive of the model: itself, or one written now at the place of the result.
fn as_archive(context: &Context, args: &Bake, events: &dyn EventSink) -> Result<PathBuf> {
    use cc4dgs_play::source::{Source, SourceKind};
    let source = Source::expect(&args.model)?;
    if source.kind == SourceKind::Archive {
        return Ok(source.file);
    }
    let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, events)?;
    let options = ArchiveOptions { codec: &args.codec, settings: &toml::Table::new(), field_weights: &args.field_weights, scene: None };
    loaded.model.save_archive(&args.out, &options, &context.registry, &context.limits, events)?;
    Ok(args.out.clone())
}

/// The training cameras of the scene, each once; those of the archive where no scene is given.
fn capture_cameras(context: &Context, args: &Bake, model: &Model) -> Result<Vec<Camera>> {
    let Some(path) = &args.scene else { return Ok(stored_cameras(&args.model, &context.limits)) };
    let scene = open_as_trained(path, model, &[], &context.registry, &context.limits)?;
    let mut indices: Vec<usize> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].camera).collect();
    indices.sort_unstable();
    indices.dedup();
    Ok(indices.into_iter().map(|i| scene.cameras[i].clone()).collect())
}

fn stored_cameras(path: &Path, limits: &Limits) -> Vec<Camera> {
    Archive::open(path, limits).map(|archive| archive.manifest().presentation.cameras.clone()).unwrap_or_default()
}

/// What the archive said already, what the cameras say, and what the options say, the last first.
fn presented(args: &Bake, stored: &Presentation, model: &Model, cameras: &[Camera]) -> Result<Presentation> {
    let up: Option<[f64; 3]> = args.up.map(Into::into);
    let found =
        if cameras.is_empty() { presentation::of_gaussians(&model.gaussians, up.unwrap_or([0.0, 0.0, 1.0]))? } else { presentation::of_cameras(cameras, up) };
    let replaced = args.scene.is_some() || args.up.is_some() || stored.home.is_none();
    let kept = if replaced { found } else { stored.clone() };
    let rate = args.fps.or(stored.frames_per_second);
    let seconds = rate.map(|rate| model.frame_count.saturating_sub(1).max(1) as f32 / rate);
    let out = Presentation { frames_per_second: rate, seconds: if args.fps.is_some() { seconds } else { stored.seconds.or(seconds) }, ..kept };
    out.validate("presentation")?;
    Ok(out)
}

/// The model at half time, from its home camera, as a PNG.
fn poster(context: &Context, model: &Model, home: &Camera, device: &burn::tensor::Device) -> Result<Vec<u8>> {
    let scale = f64::from(POSTER) / f64::from(home.width.max(home.height));
    let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    let camera = home.resized(side(home.width), side(home.height));
    encode_png(&Player::new(model, &context.registry, device)?.frame(&camera, 0.5)?)
}

fn text(report: &Report) -> String {
    let first = format!(
        "{}: {:.4} MB, of which the layer {:.4} MB (weights of the field: {:.4} MB), poster {:.4} MB, in {:.1} s",
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
    ];
    lines.extend(layer.heads.iter().map(|h| {
        format!(
            "  {:<11} up to {} functions, {} Gaussians, {} coefficients, error up to {:.3} of its tolerance",
            h.head, h.functions, h.rows, h.coefficients, h.max_error
        )
    }));
    lines.join("\n")
}
