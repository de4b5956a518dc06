//! What skipping saves: frames and training steps of a trained model's scene with each kind of skipped work switched off in turn, and with all of it.

use super::Spread;
use crate::args::BenchSkip;
use crate::commands::Context;
use crate::interrupt;
use crate::models::load_model;
use burn::tensor::Device;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Error, Event, EventSink, Result, Scene, Silent, Split, config};
use cc4dgs_play::Model;
use cc4dgs_play::player::{PlayShortcuts, Player};
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::eval::{Scored, evaluate};
use cc4dgs_train::train::{TrainJob, train};
use serde::Serialize;
use std::sync::Arc;

/// Test views that trainings are scored on.
const SCORED: usize = 10;
/// Switches the decoding of shared vertices off.
const REUSE: &str = "vertex_reuse";

#[derive(Serialize)]
struct SkipReport<'a> {
    version: &'static str,
    model: String,
    scene: String,
    device: &'a str,
    threads: usize,
    image_size: [u32; 2],
    gaussians: usize,
    dynamic_gaussians: usize,
    frames: Vec<FrameRow>,
    /// Iterations of every training; 0 where none was asked for.
    iterations: u32,
    steps: Vec<StepRow>,
}

/// Playback with something switched off.
#[derive(Serialize)]
struct FrameRow {
    off: &'static str,
    field: Spread,
    raster: Spread,
    frame: Spread,
    /// Over the frame with nothing switched off.
    ratio: f64,
    /// Whether all images are the same bits as with nothing switched off.
    same_bits: bool,
}

/// A training with something changed.
#[derive(Serialize)]
struct StepRow {
    off: &'static str,
    set: Vec<String>,
    ms_per_step: f64,
    ratio: f64,
    /// Whether the Gaussians at the end are the same bits as with nothing changed.
    same_bits: bool,
    /// Test views, after so few iterations.
    psnr_db: f64,
}

/// What a frame goes without.
#[derive(Clone, Copy)]
struct Without {
    name: &'static str,
    play: PlayShortcuts,
    vertex_reuse: bool,
    opacity: bool,
    transmittance: bool,
}

/// Times frames and, where asked for, training steps.
pub fn skip(context: &Context, args: &BenchSkip) -> Result<()> {
    let events = context.listeners(None)?;
    let mut loaded = load_model(&args.views.model, &args.device, &context.registry, &context.limits, &events)?;
    let scene = open_as_trained(&args.views.scene, &loaded.model, &args.views.sets, &context.registry, &context.limits)?;
    let moments: Vec<(Camera, f32)> = scene.split(args.views.split.into()).into_iter().map(|v| (scene.camera(v).clone(), scene.views[v].time_norm)).collect();
    let Some((camera, _)) = moments.first() else {
        return Err(Error::parameter("--split", format!("{} has no view of this split", scene.name), "Play the other split"));
    };
    let image_size = [camera.width, camera.height];
    let frames = playback(context, &mut loaded.model, &loaded.device, &scene, &moments, args.frames as usize, &events)?;
    let steps = if args.iterations == 0 { Vec::new() } else { trainings(context, &loaded.model, &loaded.device, &scene, args.iterations, &events)? };
    let moving = Player::new(&loaded.model, &context.registry, &loaded.device)?.moving();
    let report = SkipReport {
        version: env!("CARGO_PKG_VERSION"),
        model: args.views.model.display().to_string(),
        scene: scene.name.clone(),
        device: &loaded.device_name,
        threads: rayon::current_num_threads(),
        image_size,
        gaussians: loaded.model.gaussians.len(),
        dynamic_gaussians: moving,
        frames,
        iterations: args.iterations,
        steps,
    };
    context.output.result(&report, || text(&report))
}

/// Frames with each shortcut off. Cases take turns, so that all of them see the same machine.
fn playback(
    context: &Context,
    model: &mut Model,
    device: &Device,
    scene: &Scene,
    moments: &[(Camera, f32)],
    frames: usize,
    events: &dyn EventSink,
) -> Result<Vec<FrameRow>> {
    let on = PlayShortcuts::default();
    let nothing = Without { name: "nothing", play: on, vertex_reuse: true, opacity: true, transmittance: true };
    let uncached = PlayShortcuts { feature_cache: false, ..on };
    let neither = PlayShortcuts { feature_cache: false, static_gating: false };
    let cases = [
        nothing,
        Without { name: "static gating", play: PlayShortcuts { static_gating: false, ..on }, ..nothing },
        Without { name: "feature cache", play: uncached, ..nothing },
        Without { name: "feature cache, vertex reuse", play: uncached, vertex_reuse: false, ..nothing },
        Without { name: "opacity early out", opacity: false, ..nothing },
        Without { name: "transmittance early out", transmittance: false, ..nothing },
        Without { name: "all", play: neither, vertex_reuse: false, opacity: false, transmittance: false },
    ];
    let mut rows: Vec<FrameRow> = Vec::with_capacity(cases.len());
    let mut images: Vec<Vec<u32>> = Vec::new();
    let stop = interrupt::stop_flag()?;
    for (done, case) in cases.iter().enumerate() {
        interrupt::check(stop, "measuring; nothing was written")?;
        prepare(context, model, device, case)?;
        let mut player = Player::with_shortcuts(model, &context.registry, device, case.play)?.on(scene.background);
        let mut times: [Vec<f64>; 3] = Default::default();
        let mut same_bits = true;
        for frame in 0..super::WARM_UP + frames {
            let (camera, time_norm) = &moments[frame % moments.len()];
            let (output, time) = player.render(camera, *time_norm)?;
            if frame < super::WARM_UP {
                continue;
            }
            let bits: Vec<u32> = to_vec(output.planes, "planes")?.into_iter().map(f32::to_bits).collect();
            match images.get(frame - super::WARM_UP) {
                Some(image) if done > 0 => same_bits &= *image == bits,
                _ => images.push(bits),
            }
            for (list, ms) in times.iter_mut().zip([time.field_ms, time.raster_ms, time.field_ms + time.raster_ms]) {
                list.push(ms);
            }
        }
        let [field, raster, frame] = times.map(Spread::of);
        let ratio = frame.median_ms / rows.first().map_or(frame.median_ms, |row| row.frame.median_ms).max(1e-9);
        rows.push(FrameRow { off: case.name, field, raster, frame, ratio, same_bits });
        events.emit(&Event::Progress { task: "bench".into(), done: done as u64 + 1, total: cases.len() as u64 });
    }
    prepare(context, model, device, &nothing)?;
    Ok(rows)
}

/// Gives the model the rasterizer and the deformer of a case; weights stay.
fn prepare(context: &Context, model: &mut Model, device: &Device, case: &Without) -> Result<()> {
    if model.rasterizer.get("kind").and_then(|kind| kind.as_str()) == Some("tile") {
        model.rasterizer.insert("opacity_shortcut".into(), case.opacity.into());
        model.rasterizer.insert("transmittance_shortcut".into(), case.transmittance.into());
    }
    let Some(deformer) = &mut model.field else { return Ok(()) };
    let name = deformer.name().to_string();
    if !context.registry.deformer(&name)?.info.capabilities.contains(&"vertex-reuse") {
        return Ok(());
    }
    deformer.section.insert(REUSE.into(), case.vertex_reuse.into());
    let mut built = context.registry.build_deformer(&deformer.section, &deformer.context, device)?;
    for (new, old) in built.parameters_mut().into_iter().zip(deformer.field.parameters()) {
        new.value = old.value.clone();
    }
    built.set_progress(1.0);
    deformer.field = built;
    Ok(())
}

/// Short trainings with the configuration of the model, each with one thing changed.
fn trainings(context: &Context, model: &Model, device: &Device, scene: &Scene, iterations: u32, events: &dyn EventSink) -> Result<Vec<StepRow>> {
    let stated = model.provenance.config.clone();
    let base: RunConfig = config::parse_section("configuration of the model", &stated)?;
    let reuses = context.registry.deformer(model.field.as_ref().map_or("none", |f| f.name()))?.info.capabilities.contains(&"vertex-reuse");
    let batch = base.train.batch;
    let exact = ["rasterizer.opacity_shortcut=false", "rasterizer.transmittance_shortcut=false"];
    let reuse = format!("deformer.{REUSE}=false");
    let mut cases: Vec<(&'static str, Vec<String>)> = vec![
        ("nothing", Vec::new()),
        ("opacity early out", vec![exact[0].into()]),
        ("transmittance early out", vec![exact[1].into()]),
        ("sparse Adam", vec!["train.sparse_adam=false".into()]),
        ("several views per spatial pass", vec!["train.batch=1".into(), format!("train.iterations={}", iterations as usize * batch)]),
        ("lower resolution early", vec!["train.image_growth=0.0".into()]),
        ("SH degrees one after another", vec!["train.sh_interval=1".into()]),
    ];
    let mut all: Vec<String> = exact.iter().map(ToString::to_string).collect();
    if reuses {
        cases.insert(1, ("vertex reuse", vec![reuse.clone()]));
        all.push(reuse);
    }
    cases.push(("all exact ones", all));
    let (scene, stop) = (Arc::new(scene.clone()), interrupt::stop_flag()?);
    let mut rows: Vec<StepRow> = Vec::with_capacity(cases.len());
    let mut first: Option<cc4dgs_core::HostGaussians> = None;
    let total = cases.len() as u64;
    for (done, (name, set)) in cases.into_iter().enumerate() {
        let mut table = stated.clone();
        let common = [format!("train.iterations={iterations}"), "train.checks=false".into(), "train.validation=0".into()];
        config::set_all(&mut table, &[&common[..], &set].concat())?;
        let config: RunConfig = config::parse_section("configuration of the model", &table)?;
        let job =
            TrainJob { config: &config, scene: scene.clone(), out: None, resume: false, registry: &context.registry, events: &Silent, observer: None, stop };
        let (trained, report) = train(&job)?;
        let scored = Scored { max_views: SCORED, ..Scored::all(Split::Test) };
        let psnr_db = evaluate(&trained, &scene, scored, &context.registry, device, &Silent, &mut |_, _, _, _| Ok(()))?.psnr_db;
        // Per view drawn: the case with one view per pass takes as many more iterations.
        let views = iterations as usize * batch;
        let ms_per_step = report.stage_seconds.values().sum::<f64>() * 1e3 / views as f64;
        let same_bits = first.as_ref().is_none_or(|gaussians| *gaussians == trained.gaussians);
        let ratio = ms_per_step / rows.first().map_or(ms_per_step, |row| row.ms_per_step).max(1e-9);
        first.get_or_insert(trained.gaussians);
        rows.push(StepRow { off: name, set, ms_per_step, ratio, same_bits, psnr_db });
        events.emit(&Event::Progress { task: "bench trainings".into(), done: done as u64 + 1, total });
    }
    Ok(rows)
}

fn text(report: &SkipReport) -> String {
    let mut lines = vec![format!(
        "{} on {}, {}, {} threads: {}x{}, {} Gaussians, {} of them moving",
        report.model, report.scene, report.device, report.threads, report.image_size[0], report.image_size[1], report.gaussians, report.dynamic_gaussians
    )];
    let bits = |same: bool| if same { "the same" } else { "others" };
    lines.push(format!("{:<32} {:>9} {:>9} {:>9} {:>6}  bits", "a frame without", "field ms", "raster ms", "frame ms", "ratio"));
    lines.extend(report.frames.iter().map(|r| {
        format!("{:<32} {:>9.2} {:>9.2} {:>9.2} {:>6.2}  {}", r.off, r.field.median_ms, r.raster.median_ms, r.frame.median_ms, r.ratio, bits(r.same_bits))
    }));
    if !report.steps.is_empty() {
        lines.push(format!("{:<32} {:>12} {:>6} {:>8}  bits", format!("{} iterations without", report.iterations), "ms per view", "ratio", "PSNR dB"));
        lines.extend(report.steps.iter().map(|r| format!("{:<32} {:>12.2} {:>6.2} {:>8.2}  {}", r.off, r.ms_per_step, r.ratio, r.psnr_db, bits(r.same_bits))));
    }
    lines.join("\n")
}
