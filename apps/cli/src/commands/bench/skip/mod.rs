//! What skipping saves: frames and training steps of a trained model's scene with each kind of skipped work switched off in turn, and with all of it.
//!
//! Rounds over all cases are the outer loop everywhere, so that a machine that slows down slows all of them down.

mod frames;
mod trainings;

use crate::args::BenchSkip;
use crate::commands::Context;
use crate::models::load_model;
use burn::tensor::Device;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::{Camera, Error, Gaussians, HostGaussians, RenderSettings, Result, Splats, plural, split_kind};
use cc4dgs_play::player::Player;
use frames::{FrameBench, FrameRow};
use serde::Serialize;
use std::hash::{DefaultHasher, Hasher};
use trainings::{StepBench, StepRow};

/// Deformers with this capability have a setting [`REUSE`].
const SHARES_VERTICES: &str = "vertex-reuse";
/// Setting of deformers: whether vertices that several Gaussians share are decoded once.
const REUSE: &str = "vertex_reuse";
/// Rasterizers with this capability have the settings [`EARLY_OUTS`].
const HAS_SHORTCUTS: &str = "shortcuts";
/// Settings of rasterizers: whether footprints end where opacity has faded, and rows where pixels have stopped.
const EARLY_OUTS: [&str; 2] = ["opacity_shortcut", "transmittance_shortcut"];

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
    /// Times that all cases took turns.
    rounds: usize,
    /// Frames measured per case, besides the first of each round.
    frames_per_case: u32,
    frames: Vec<FrameRow>,
    /// Iterations of every training; 0 where none was asked for.
    iterations: u32,
    steps: Vec<StepRow>,
    left_out: Vec<LeftOut>,
}

/// A case that does not apply.
#[derive(Serialize)]
struct LeftOut {
    /// `frames` or `trainings`.
    of: &'static str,
    off: &'static str,
    why: String,
}

/// Something that is skipped, and how a case goes without it.
struct Switch<F> {
    name: &'static str,
    off: F,
    /// Why there is nothing to switch off, if so.
    missing: Option<String>,
}

/// The switches that apply; notes the others.
fn available<F>(of: &'static str, switches: Vec<Switch<F>>, left_out: &mut Vec<LeftOut>) -> Vec<Switch<F>> {
    let mut kept = Vec::with_capacity(switches.len());
    for switch in switches {
        match switch.missing {
            Some(why) => left_out.push(LeftOut { of, off: switch.name, why }),
            None => kept.push(switch),
        }
    }
    kept
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
    let (image_size, rounds) = ([camera.width, camera.height], args.rounds as usize);
    let fixed = fixed_early_outs(context, &loaded.model.rasterizer, &loaded.device)?;
    let mut left_out = Vec::new();
    // Mistakes are found before anything is timed.
    let trainings = match args.iterations {
        0 => None,
        iterations => Some(StepBench {
            context,
            model: &args.views.model,
            stated: loaded.model.provenance.config.clone(),
            scene: scene.clone().into(),
            device: &loaded.device,
            device_name: &loaded.device_name,
            iterations: iterations as usize,
            rounds,
            split: args.views.split.into(),
            events: &events,
        }),
    };
    let cases = trainings.as_ref().map(|bench| bench.cases(fixed.as_deref(), &mut left_out)).transpose()?;
    let bench =
        FrameBench { context, device: &loaded.device, background: scene.background, moments: &moments, frames: args.frames as usize, rounds, events: &events };
    let frames = bench.run(&mut loaded.model, fixed.as_deref(), &mut left_out)?;
    let steps = match (&trainings, cases) {
        (Some(bench), Some(cases)) => bench.run(cases)?,
        _ => Vec::new(),
    };
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
        rounds,
        frames_per_case: args.frames,
        frames,
        iterations: args.iterations,
        steps,
        left_out,
    };
    context.output.result(&report, || text(&report))
}

/// Why the early outs of the rasterizer in `section` cannot be switched off on `device`, if so.
fn fixed_early_outs(context: &Context, section: &toml::Table, device: &Device) -> Result<Option<String>> {
    let (kind, _) = split_kind("rasterizer", section)?;
    if !context.registry.rasterizer(&kind)?.info.capabilities.contains(&HAS_SHORTCUTS) {
        return Ok(Some(format!("the rasterizer {kind} has no such switch")));
    }
    let mut without = section.clone();
    without.extend(EARLY_OUTS.map(|name| (name.to_string(), false.into())));
    let one = HostGaussians {
        means: vec![0.0; 3],
        log_scales: vec![0.0; 3],
        quaternions: vec![1.0, 0.0, 0.0, 0.0],
        opacity_logits: vec![0.0],
        sh_dc: vec![0.0; 3],
        dynamic_scores: vec![0.0],
        ..Default::default()
    };
    let splats = Splats::from_gaussians(&Gaussians::from_host(&one, device), 0);
    let camera = Camera::look_at("probe", (16, 16), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, -1.0, 0.0]);
    match context.registry.build_rasterizer(&without)?.render(&splats, &camera, &RenderSettings::default()) {
        Err(e @ Error::Unsupported { .. }) => Ok(Some(e.to_string())),
        drawn => drawn.map(|_| None),
    }
}

/// A fingerprint of the bits of some values.
fn digest<'v>(values: impl IntoIterator<Item = &'v f32>) -> u64 {
    let mut hasher = DefaultHasher::new();
    values.into_iter().for_each(|value| hasher.write_u32(value.to_bits()));
    hasher.finish()
}

fn text(report: &SkipReport) -> String {
    let on = format!("{} on {}, {}, {} {}", report.model, report.scene, report.device, report.threads, plural(report.threads, "thread", "threads"));
    let [width, height] = report.image_size;
    let mut lines = vec![format!("{on}: {width}x{height}, {} Gaussians, {} of them moving", report.gaussians, report.dynamic_gaussians)];
    let bits = |same: bool| if same { "the same" } else { "others" };
    let title = "a frame without";
    lines.push(format!("{title:<32} deform ms raster ms  frame ms  ratio  first ms  total ms  peak MB difference  bits"));
    lines.extend(report.frames.iter().map(|r| {
        let later = [r.field, r.raster, r.frame].map(|time| format!(" {:>9.2}", time.median_ms)).concat();
        let whole = format!("{:>9.2} {:>9.2}", r.first_frame.median_ms, r.total_frame_ms);
        let peak = r.peak_memory_mb.map_or_else(|| "-".to_string(), |mb| format!("{mb:.0}"));
        format!("{:<32}{later} {:>6.2} {whole} {peak:>8} {:>10.2e}  {}", r.off, r.ratio, r.largest_difference, bits(r.same_bits))
    }));
    if !report.steps.is_empty() {
        let title = format!("{} {} without", report.iterations, plural(report.iterations, "iteration", "iterations"));
        lines.push(format!("{title:<32} {:>12} {:>6} {:>8}  bits of the Gaussians", "ms per view", "ratio", "PSNR dB"));
        lines.extend(
            report.steps.iter().map(|r| format!("{:<32} {:>12.2} {:>6.2} {:>8.2}  {}", r.off, r.ms_per_view.median_ms, r.ratio, r.psnr_db, bits(r.same_bits))),
        );
    }
    lines.extend(report.left_out.iter().map(|l| format!("left out of the {}: {} ({})", l.of, l.off, l.why)));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digests_are_of_bits() {
        assert_eq!(digest(&[1.0, f32::NAN]), digest(&[1.0, f32::NAN]));
        assert_ne!(digest(&[0.0]), digest(&[-0.0]));
        assert_ne!(digest(&[1.0, 2.0]), digest(&[2.0, 1.0]));
    }

    #[test]
    fn what_does_not_apply_is_left_out_and_said() {
        let switch = |name, missing: Option<&str>| Switch { name, off: (), missing: missing.map(Into::into) };
        let mut left_out = Vec::new();
        let kept = available("frames", vec![switch("a", None), switch("b", Some("no deformer")), switch("c", None)], &mut left_out);
        assert_eq!(kept.iter().map(|s| s.name).collect::<Vec<_>>(), ["a", "c"]);
        assert_eq!((left_out.len(), left_out[0].off, left_out[0].why.as_str()), (1, "b", "no deformer"));
    }
}
