//! How long an iteration takes, found by training for a few.

use crate::config::{Dynamic, InitSource, RunConfig};
use crate::train::{TrainJob, train};
use cc4dgs_core::{Event, Recorder, Registry, Result, Scene};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Iterations of each stage that are timed, and how many one measurement takes.
const ITERATIONS: usize = 24;
const PER_MEASUREMENT: usize = 4;
/// Share of the largest number of Gaussians that a run has on average.
const MEAN_GAUSSIANS: f64 = 0.8;

/// Milliseconds of an iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Timing {
    /// Where nothing moves.
    pub still: f64,
    /// Where everything moves.
    pub moving: f64,
}

/// Trains for a few iterations as `config` would, once without and once with motion, and forgets the result.
pub(super) fn calibrate(config: &RunConfig, scene: &Arc<Scene>, registry: &Registry) -> Result<Timing> {
    let mut trial = config.clone();
    let most = config.density.get("max_gaussians").and_then(|v| v.as_integer()).map_or(config.init.count, |v| v.max(1) as usize);
    trial.init.count = (MEAN_GAUSSIANS * most as f64) as usize;
    trial.init.source = if scene.points.is_some() { InitSource::Points } else { InitSource::Random };
    trial.density = toml::Table::from_iter([("kind".into(), "none".into())]);
    trial.train.iterations = 2 * ITERATIONS;
    trial.train.shares = [1.0, 0.0, 1.0];
    trial.train.dynamic = Dynamic::All;
    trial.train.lambda_r = 0.0;
    trial.train.log_every = PER_MEASUREMENT;
    trial.train.checkpoint_every = 0;
    (trial.train.checks, trial.train.validation) = (false, 0);
    trial.auto = Default::default();
    let recorder = Recorder::default();
    let stop = AtomicBool::new(false);
    train(&TrainJob { config: &trial, scene: scene.clone(), out: None, resume: false, registry, events: &recorder, stop: &stop })?;
    let events = recorder.events();
    let median = |wanted: &str| {
        let mut times: Vec<f32> = events
            .iter()
            .filter_map(|event| match event {
                // The first measurement holds whatever happens once.
                Event::Iteration { stage, iteration, ms, .. } if stage == wanted && *iteration > PER_MEASUREMENT => Some(*ms),
                _ => None,
            })
            .collect();
        times.sort_by(f32::total_cmp);
        times.get(times.len() / 2).copied().map(f64::from)
    };
    let still = median("coarse").unwrap_or(1.0).max(0.01);
    Ok(Timing { still, moving: median("main").unwrap_or(still).max(still) })
}
