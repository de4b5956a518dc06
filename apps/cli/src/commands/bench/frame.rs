//! Playback of a synthetic scene: field and rasterizer, frame by frame, and the field's own costs.

use super::{Playback, Spread, WARM_UP, scene_cases, time_playback};
use crate::args::BenchFrame;
use crate::commands::{Context, check_writable, create_parent};
use crate::ignored::{Stated, refuse_ignored};
use crate::interrupt;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings, presented};
use cc4dgs_backends::bench::{SceneCase, Workload, growth, shrunk, synthetic_scene};
use cc4dgs_core::archive::{MAGIC, Provenance, write_atomically};
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::format::conformance::uniform;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    Camera, Deformer, DeformerContext, Error, Event, EventSink, HostGaussians, Result, Seed, Similarity, SpatialInput, config, parse_device, plural,
    resolved_device,
};
use cc4dgs_play::Moving;
use cc4dgs_play::RenderConfig;
use cc4dgs_play::model::{Model, ModelDeformer, ModelSize};
use cc4dgs_play::player::Player;
use cc4dgs_train::config::RunConfig;
use serde::Serialize;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Frames of the sequence the scenes stand for.
const SEQUENCE: usize = 300;
/// Where the size of a motion is measured.
const MOTION_TIMES: [f32; 4] = [0.1, 0.35, 0.6, 0.85];
/// Weights that motion is tried with first; the second try has the size that is asked for.
const FIRST_MOTION: f32 = 0.1;

#[derive(Serialize)]
struct FrameReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    cpu_features: Vec<&'static str>,
    seed: u64,
    deformer: String,
    cases: Vec<FrameCase>,
}

#[derive(Serialize)]
struct FrameCase {
    name: String,
    width: u32,
    height: u32,
    gaussians: usize,
    dynamic_gaussians: usize,
    #[serde(flatten)]
    playback: Playback,
    /// Spatial pass, offsets at one time, and both with the gradient of all weights.
    field_spatial: Spread,
    field_forward_backward: Spread,
}

/// Times playback of the scenes.
pub fn frame(context: &Context, args: &BenchFrame) -> Result<()> {
    let device = parse_device(&args.device)?;
    let events = context.listeners(None)?;
    let mut table = toml::Table::from_iter([("deformer".to_string(), toml::Value::Table(toml::Table::from_iter([("kind".into(), "cdf".into())])))]);
    config::set_all(&mut table, &args.set)?;
    let config: RunConfig = config::parse_section("configuration", &table)?;
    let mut cases = Vec::new();
    let wanted: Vec<SceneCase> =
        if args.growth { growth().iter().map(|case| shrunk(case, args.scale)).collect() } else { scene_cases(&args.case, args.scale)? };
    if let (Some(archive), true) = (&args.archive, wanted.len() != 1) {
        let object = format!("--archive {}", archive.display());
        return Err(Error::parameter(object, format!("there are {} cases, and a file holds one", wanted.len()), "Choose one with --case NAME"));
    }
    if let Some(archive) = &args.archive {
        refuse_other_content(archive, "an archive", |head| head.starts_with(&MAGIC))?;
        check_writable(archive)?;
    }
    let stop = interrupt::stop_flag()?;
    for (done, case) in wanted.iter().enumerate() {
        // After an interruption the finished cases are reported.
        if done > 0 && stop.load(Ordering::Relaxed) {
            break;
        }
        let (mut model, camera) = scene_model(context, case, &config, &device, args)?;
        if let Some(path) = &args.archive {
            write_playable(context, &model, &camera, &device, &events, stop, path)?;
        }
        cases.push(time_case(context, case.name.to_string(), &mut model, &camera, &device, args)?);
        events.emit(&Event::Progress { task: "bench".into(), done: done as u64 + 1, total: wanted.len() as u64 });
    }
    let deformer = config.deformer.get("kind").and_then(|k| k.as_str()).unwrap_or_default().to_string();
    let report = FrameReport {
        version: env!("CARGO_PKG_VERSION"),
        device: resolved_device(&args.device),
        threads: rayon::current_num_threads(),
        cpu_features: crate::commands::doctor::cpu_features(),
        seed: args.seed,
        deformer,
        cases,
    };
    let measured = report.cases.len();
    context.output.result(&report, || text(&report))?;
    if measured < wanted.len() {
        return Err(Error::Interrupted(format!("after {measured} of {} cases", wanted.len())));
    }
    Ok(())
}

/// The model of a case, and the camera that looks at it.
fn scene_model(context: &Context, case: &SceneCase, config: &RunConfig, device: &Device, args: &BenchFrame) -> Result<(Model, Camera)> {
    let seed = Seed::root(args.seed).child("bench").child(&case.name);
    let Workload { gaussians, camera, .. } = synthetic_scene(case, seed);
    let moving = Moving::Scored { zeta: 0.0 };
    let rows = moving.rows(&gaussians.dynamic_scores).unwrap_or_default();
    let axis = |k: usize, from: f32, pick: fn(f32, f32) -> f32| rows.iter().map(|&i| gaussians.means[3 * i + k]).fold(from, pick);
    let deformer = DeformerContext {
        box_min: std::array::from_fn(|k| if rows.is_empty() { 0.0 } else { axis(k, f32::INFINITY, f32::min) }),
        box_max: std::array::from_fn(|k| if rows.is_empty() { 1.0 } else { axis(k, f32::NEG_INFINITY, f32::max) }),
        frame_count: SEQUENCE,
        sh_degree: gaussians.sh_degree,
        seed: seed.child("field"),
    };
    let mut field = context.registry.build_deformer(&config.deformer, &deformer, device)?;
    if field.is_static() {
        let (value, remedy) = ((args.motion > 0.0).then(|| args.motion.to_string()), "Leave it out, or choose a deformer (--set deformer.kind=NAME)".into());
        refuse_ignored("a deformer that moves nothing", [Stated { option: "--motion", value, used: false, remedy }])?;
    }
    if args.motion > 0.0 && !rows.is_empty() {
        set_in_motion(field.as_mut(), moving_means(&gaussians, &rows, device), args.motion, seed.child("motion"))?;
    }
    let model = Model {
        gaussians,
        field: Some(ModelDeformer { field, section: config.deformer.clone(), context: deformer }),
        moving,
        render: RenderConfig::default(),
        background: Some([0.0; 3]),
        rasterizer: config.rasterizer.clone(),
        frame_count: SEQUENCE,
        normalisation: Similarity::IDENTITY,
        provenance: Provenance::default(),
        size: ModelSize::default(),
    };
    Ok((model, camera))
}

/// Centres of the rows, `[M,3]`.
fn moving_means(gaussians: &HostGaussians, rows: &[usize], device: &Device) -> Tensor<2> {
    let means: Vec<f32> = rows.iter().flat_map(|&i| gaussians.means[3 * i..3 * i + 3].to_vec()).collect();
    Tensor::from_data(TensorData::new(means, [rows.len(), 3]), device)
}

/// Gives weights that are zero random values, so that the largest offset becomes about `motion`: what makes a fresh deformer the identity is zero.
fn set_in_motion(field: &mut dyn Deformer, means_world: Tensor<2>, motion: f32, seed: Seed) -> Result<()> {
    let device = means_world.device();
    let mut scale = FIRST_MOTION;
    let fresh: Vec<Vec<f32>> = field.parameters().iter().map(|p| to_vec(p.value.clone(), "weights")).collect::<Result<_>>()?;
    for _ in 0..2 {
        for (index, (parameter, values)) in field.parameters_mut().into_iter().zip(&fresh).enumerate() {
            let seed = seed.index(index as u64);
            let moved: Vec<f32> = values.iter().enumerate().map(|(k, v)| if *v == 0.0 { scale * uniform(seed, k) } else { *v }).collect();
            parameter.value = Tensor::from_data(TensorData::new(moved, [values.len()]), &device);
        }
        let features = field.spatial(&SpatialInput::new(means_world.clone()))?.values;
        let mut largest = 0.0f32;
        for time in MOTION_TIMES {
            if let Some(offsets) = field.deform(features.clone(), time)?.concatenated() {
                largest = largest.max(offsets.abs().max().into_scalar::<f32>());
            }
        }
        scale *= motion / largest.max(f32::MIN_POSITIVE);
    }
    Ok(())
}

/// Stores the model with a playback layer; players start from `camera`.
fn write_playable(context: &Context, model: &Model, camera: &Camera, device: &Device, events: &dyn EventSink, stop: &AtomicBool, path: &Path) -> Result<()> {
    let around = Surroundings { registry: &context.registry, device, limits: &context.limits, events, stop };
    let stored = Stored::of_model(model, Storage::default(), around)?;
    let cameras = std::slice::from_ref(camera);
    let presentation = presented(&stored.model, cameras, None)?;
    let options = PlayableOptions { max_error: None, cameras, presentation, poster: false, without_field: true, baked: true };
    create_parent(path)?;
    let bytes = stored.playable(options, around)?.bytes;
    write_atomically(path, &bytes)?;
    events.emit(&Event::Saved { path: path.display().to_string(), bytes: bytes.len() as u64 });
    Ok(())
}

fn time_case(context: &Context, name: String, model: &mut Model, camera: &Camera, device: &Device, args: &BenchFrame) -> Result<FrameCase> {
    let rows = model.moving.rows(&model.gaussians.dynamic_scores).unwrap_or_default();
    let means = moving_means(&model.gaussians, &rows, device);
    let (field_spatial, field_forward_backward) = match &mut model.field {
        Some(deformer) => time_field(deformer.field.as_mut(), means, args.frames.min(10))?,
        None => (Spread::of(Vec::new()), Spread::of(Vec::new())),
    };
    let mut player = Player::new(model, &context.registry, device)?;
    let playback = time_playback(&mut player, args.frames as usize, |frame| (camera, time_of(frame)))?;
    Ok(FrameCase {
        name,
        width: camera.width,
        height: camera.height,
        gaussians: model.gaussians.len(),
        dynamic_gaussians: player.moving(),
        playback,
        field_spatial,
        field_forward_backward,
    })
}

/// The normalised time of a frame of playback, which begins again where the sequence ends: Gaussians may have faded at later times.
fn time_of(frame: usize) -> f32 {
    (frame % SEQUENCE) as f32 / SEQUENCE as f32
}

/// The spatial pass alone, and a pass forwards and backwards through the whole field.
fn time_field(field: &mut dyn Deformer, means_world: Tensor<2>, repeats: u32) -> Result<(Spread, Spread)> {
    if field.is_static() || means_world.dims()[0] == 0 {
        return Ok((Spread::of(Vec::new()), Spread::of(Vec::new())));
    }
    let (mut spatial, mut both) = (Vec::new(), Vec::new());
    for round in 0..WARM_UP + repeats as usize {
        let began = Instant::now();
        let features = field.spatial(&SpatialInput::new(means_world.clone()))?.values;
        // One number read back says that everything before it is done.
        to_vec(features.narrow(0, 0, 1), "features")?;
        let spatial_ms = began.elapsed().as_secs_f64() * 1e3;
        for parameter in field.parameters_mut() {
            parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
        }
        let began = Instant::now();
        let tracked = Tensor::<2>::from_inner(means_world.clone());
        let features = field.spatial(&SpatialInput::new(tracked))?.values;
        if let Some(offsets) = field.deform(features, 0.3)?.concatenated() {
            let gradients = offsets.sum().backward();
            if let Some(gradient) = field.parameters().first().and_then(|p| p.value.grad(&gradients)) {
                to_vec(gradient.narrow(0, 0, 1), "gradient")?;
            }
        }
        let both_ms = began.elapsed().as_secs_f64() * 1e3;
        for parameter in field.parameters_mut() {
            parameter.value = parameter.value.clone().inner();
        }
        if round >= WARM_UP {
            spatial.push(spatial_ms);
            both.push(both_ms);
        }
    }
    Ok((Spread::of(spatial), Spread::of(both)))
}

fn text(report: &FrameReport) -> String {
    let threads = plural(report.threads, "thread", "threads");
    let mut lines = vec![format!("playback on {}, {} {threads}, deformer {}", report.device, report.threads, report.deformer)];
    lines.push("case             image  Gaussians  moving  deform ms  raster ms    play ms   frames/s  first ms  spatial ms deform fwd+bwd ms".into());
    lines.extend(report.cases.iter().map(|c| {
        format!(
            "{:<12} {:>4}x{:<4} {:>9} {:>7} {:>10.3} {:>10.2} {:>10.2} {:>10.1} {:>9.1} {:>11.2} {:>17.2}",
            c.name,
            c.width,
            c.height,
            c.gaussians,
            c.dynamic_gaussians,
            c.playback.field.median_ms,
            c.playback.raster.median_ms,
            c.playback.playback_ms,
            c.playback.frames_per_s,
            c.playback.first_field_ms + c.playback.first_raster_ms,
            c.field_spatial.median_ms,
            c.field_forward_backward.median_ms
        )
    }));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn playback_stays_within_the_sequence() {
        assert_eq!([0, 150, 300, 450, 10_000].map(time_of), [0.0, 0.5, 0.0, 0.5, 100.0 / 300.0]);
    }
}
