//! Times playback of a trained model over a number of frames.

use super::{Playback, time_playback};
use crate::args::BenchPlay;
use crate::commands::Context;
use crate::models::load_model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::{Camera, Error, Result, plural};
use cc4dgs_play::player::Player;
use serde::Serialize;

#[derive(Serialize)]
struct PlayReport<'a> {
    version: &'static str,
    model: String,
    scene: String,
    device: &'a str,
    threads: usize,
    width: u32,
    height: u32,
    gaussians: usize,
    dynamic_gaussians: usize,
    #[serde(flatten)]
    playback: Playback,
}

/// Plays the views of a dataset's split with a trained model, over and over.
pub fn play(context: &Context, args: &BenchPlay) -> Result<()> {
    let events = context.listeners(None)?;
    let loaded = load_model(&args.views.model, &args.device, &context.registry, &context.limits, &events)?;
    let scene = open_as_trained(&args.views.scene, &loaded.model, &args.views.sets, &context.registry, &context.limits)?;
    let moments: Vec<(Camera, f32)> = scene.split(args.views.split.into()).into_iter().map(|v| (scene.camera(v).clone(), scene.views[v].time_norm)).collect();
    let Some((camera, _)) = moments.first() else {
        return Err(Error::parameter("--split", format!("{} has no view of this split", scene.name), "Play the other split"));
    };
    let mut player = Player::new(&loaded.model, &context.registry, &loaded.device)?.on(scene.background);
    let playback = time_playback(&mut player, args.frames as usize, |frame| {
        let (camera, time_norm) = &moments[frame % moments.len()];
        (camera, *time_norm)
    })?;
    let report = PlayReport {
        version: env!("CARGO_PKG_VERSION"),
        model: args.views.model.display().to_string(),
        scene: scene.name.clone(),
        device: &loaded.device_name,
        threads: rayon::current_num_threads(),
        width: camera.width,
        height: camera.height,
        gaussians: loaded.model.gaussians.len(),
        dynamic_gaussians: player.moving(),
        playback,
    };
    context.output.result(&report, || text(&report))
}

fn text(report: &PlayReport) -> String {
    let p = &report.playback;
    format!(
        "{} on {}, {}, {} {}: {}x{}, {} Gaussians, {} of them moving\n  {:.1} frames/s without waiting; deformer {:.3} ms + rasterizer {:.2} ms (medians, waited for); first frame {:.1} + {:.1} ms",
        report.model,
        report.scene,
        report.device,
        report.threads,
        plural(report.threads, "thread", "threads"),
        report.width,
        report.height,
        report.gaussians,
        report.dynamic_gaussians,
        p.frames_per_s,
        p.field.median_ms,
        p.raster.median_ms,
        p.first_field_ms,
        p.first_raster_ms
    )
}
