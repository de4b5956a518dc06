//! Whole training steps.

use super::scene_cases;
use crate::args::BenchStep;
use crate::commands::Context;
use cc4dgs_backends::bench::{OPERATIONS_PER_PAIR, STANDARD_CASES, StepTiming, Workload, synthetic_scene, time_step};
use cc4dgs_core::{Event, EventSink, Result, Seed, parse_device, plural, resolved_device};
use serde::Serialize;

#[derive(Serialize)]
struct StepReport<'a> {
    version: &'static str,
    device: &'a str,
    threads: usize,
    cpu_features: Vec<&'static str>,
    seed: u64,
    repeats: u32,
    /// What `peak_share` counts per (Gaussian, pixel) pair.
    operations_per_pair: f64,
    cases: Vec<StepTiming>,
}

/// Times the standard cases of a whole training step.
pub fn step(context: &Context, args: &BenchStep) -> Result<()> {
    let device = parse_device(&args.device)?;
    let events = context.listeners(None)?;
    let seed = Seed::root(args.seed).child("bench");
    let mut workloads: Vec<Workload> = STANDARD_CASES.iter().map(|case| Workload::random(case, seed)).collect();
    if !args.case.is_empty() {
        workloads = scene_cases(&args.case, args.scale)?.iter().map(|case| synthetic_scene(case, seed.child(&case.name))).collect();
    }
    for path in &args.scene {
        workloads.push(Workload::from_fixture(path)?);
    }
    let mut cases = Vec::with_capacity(workloads.len());
    for (done, workload) in workloads.iter().enumerate() {
        cases.push(time_step(workload, &device, seed, args.repeats as usize)?);
        events.emit(&Event::Progress { task: "bench".into(), done: done as u64 + 1, total: workloads.len() as u64 });
    }
    let report = StepReport {
        version: env!("CARGO_PKG_VERSION"),
        device: resolved_device(&args.device),
        threads: rayon::current_num_threads(),
        cpu_features: crate::commands::doctor::cpu_features(),
        seed: args.seed,
        repeats: args.repeats,
        operations_per_pair: OPERATIONS_PER_PAIR,
        cases,
    };
    context.output.result(&report, || text(&report))
}

fn text(report: &StepReport) -> String {
    let [threads, repeats] = [plural(report.threads, "thread", "threads"), plural(report.repeats, "repeat", "repeats")];
    let mut lines = vec![format!("training step on {}, {} {threads}, {} {repeats}", report.device, report.threads, report.repeats)];
    lines.push("workload        image  Gaussians  median ms   min ms  (render    loss  backward   Adam)   pairs/s  of peak".into());
    lines.extend(report.cases.iter().map(|c| {
        // Devices that do not read their counters back have no pairs to show.
        let counted = Some(c).filter(|c| c.pixel_pairs > 0);
        format!(
            "{:<12} {:>4}x{:<4} {:>9} {:>10.2} {:>8.2}  {:>7.2} {:>7.2} {:>9.2} {:>6.2}  {:>8}  {:>7}",
            c.name,
            c.width,
            c.height,
            c.gaussians,
            c.median_ms,
            c.min_ms,
            c.forward_ms,
            c.loss_ms,
            c.backward_ms,
            c.adam_ms,
            counted.map_or("-".into(), |c| format!("{:.2e}", c.pairs_per_s)),
            counted.map_or("-".into(), |c| format!("{:.1}%", 100.0 * c.peak_share))
        )
    }));
    lines.join("\n")
}
