//! Playback of a room with people: field and rasterizer, frame by frame, and the field's own costs.

use super::{Playback, Spread, WARM_UP, rooms, time_playback};
use crate::args::BenchFrame;
use crate::commands::Context;
use crate::interrupt;
use crate::models::resolved_device;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_backends::bench::{RoomCase, growth, room, shrunk};
use cc4dgs_core::archive::Provenance;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DeformerContext, Event, EventSink, Result, Seed, Similarity, SpatialInput, config, parse_device};
use cc4dgs_play::Moving;
use cc4dgs_play::RenderConfig;
use cc4dgs_play::model::{Model, ModelDeformer, ModelSize};
use cc4dgs_play::player::Player;
use cc4dgs_train::config::RunConfig;
use serde::Serialize;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// Frames of the sequence the rooms stand for.
const SEQUENCE: usize = 300;

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

/// Times playback of the rooms.
pub fn frame(context: &Context, args: &BenchFrame) -> Result<()> {
    let device = parse_device(&args.device)?;
    let events = context.listeners(None)?;
    let mut table = toml::Table::from_iter([("deformer".to_string(), toml::Value::Table(toml::Table::from_iter([("kind".into(), "cdf".into())])))]);
    config::set_all(&mut table, &args.set)?;
    let config: RunConfig = config::parse_section("configuration", &table)?;
    let mut cases = Vec::new();
    let wanted = if args.growth { growth().iter().map(|case| shrunk(case, args.scale)).collect() } else { rooms(&args.case, args.scale)? };
    let stop = interrupt::stop_flag()?;
    for (done, case) in wanted.iter().enumerate() {
        // What was measured so far is worth keeping.
        if done > 0 && stop.load(Ordering::Relaxed) {
            break;
        }
        cases.push(time_case(context, case, &config, &device, args)?);
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
    context.output.result(&report, || text(&report))
}

fn time_case(context: &Context, case: &RoomCase, config: &RunConfig, device: &burn::tensor::Device, args: &BenchFrame) -> Result<FrameCase> {
    let seed = Seed::root(args.seed).child("bench").child(&case.name);
    let workload = room(case, seed);
    let moving = Moving::Scored { zeta: 0.0 };
    let rows = moving.rows(&workload.gaussians.dynamic_scores).unwrap_or_default();
    let axis = |k: usize, from: f32, pick: fn(f32, f32) -> f32| rows.iter().map(|&i| workload.gaussians.means[3 * i + k]).fold(from, pick);
    let field_context = DeformerContext {
        box_min: std::array::from_fn(|k| if rows.is_empty() { 0.0 } else { axis(k, f32::INFINITY, f32::min) }),
        box_max: std::array::from_fn(|k| if rows.is_empty() { 1.0 } else { axis(k, f32::NEG_INFINITY, f32::max) }),
        frame_count: SEQUENCE,
        sh_degree: workload.gaussians.sh_degree,
        seed: seed.child("field"),
    };
    let mut field = context.registry.build_deformer(&config.deformer, &field_context, device)?;
    let means: Vec<f32> = rows.iter().flat_map(|&i| workload.gaussians.means[3 * i..3 * i + 3].to_vec()).collect();
    let means = Tensor::<2>::from_data(TensorData::new(means, [rows.len(), 3]), device);
    let (field_spatial, field_forward_backward) = time_field(field.as_mut(), means, args.frames.min(10))?;

    let (n, camera) = (workload.gaussians.len(), workload.camera);
    let model = Model {
        gaussians: workload.gaussians,
        field: Some(ModelDeformer { field, section: config.deformer.clone(), context: field_context }),
        moving,
        render: RenderConfig::default(),
        background: Some([0.0; 3]),
        rasterizer: config.rasterizer.clone(),
        frame_count: SEQUENCE,
        normalisation: Similarity::IDENTITY,
        provenance: Provenance::default(),
        size: ModelSize::default(),
    };
    let mut player = Player::new(&model, &context.registry, device)?;
    let playback = time_playback(&mut player, args.frames as usize, |frame| (&camera, frame as f32 / SEQUENCE as f32))?;
    Ok(FrameCase {
        name: case.name.to_string(),
        width: camera.width,
        height: camera.height,
        gaussians: n,
        dynamic_gaussians: player.moving(),
        playback,
        field_spatial,
        field_forward_backward,
    })
}

/// The spatial pass alone, and a pass forwards and backwards through the whole field.
fn time_field(field: &mut dyn cc4dgs_core::Deformer, means_world: Tensor<2>, repeats: u32) -> Result<(Spread, Spread)> {
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
    let mut lines = vec![format!("playback on {}, {} threads, deformer {}", report.device, report.threads, report.deformer)];
    lines.push("case             image  Gaussians  moving   field ms  raster ms    play ms   frames/s  first ms  spatial ms  field fwd+bwd ms".into());
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
