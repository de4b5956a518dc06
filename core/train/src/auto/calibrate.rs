//! How long an iteration takes, found by training for a few.

use super::proceed;
use crate::config::{Dynamic, RunConfig};
use crate::train::{TrainJob, growth, share_per_view, train};
use cc4dgs_core::{Event, Recorder, Registry, Result, Scene, Split};
use rayon::prelude::*;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Iterations of each stage that are timed, and how many one measurement takes.
const ITERATIONS: usize = 36;
const PER_MEASUREMENT: usize = 4;
/// Opacity of the Gaussians that are timed.
const OPACITY: f32 = 0.5;
/// Views of the iterations that tell what views share, and from which cost of motion on, as a multiple of an iteration without, they are worth their time.
const VIEWS: usize = 3;
const WORTH_SHARING: f64 = 1.2;

/// Milliseconds: of an iteration of one view, and of what comes before all of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Timing {
    /// Where nothing moves.
    pub still: f64,
    /// More where everything moves, however many views there are.
    pub shared: f64,
    /// More for each view where everything moves: what a deformer does for each time.
    pub per_time: f64,
    /// All that comes before the first iteration.
    pub start: f64,
}

/// Trains for a few iterations as `config` would, from the same first Gaussians, once without and once with motion, and forgets the result. Images are decoded
/// before, for at most `patience`: most iterations of a run find theirs in the cache.
pub(super) fn calibrate(config: &RunConfig, scene: &Arc<Scene>, registry: &Registry, patience: Duration, stop: &AtomicBool) -> Result<Timing> {
    let began = Instant::now();
    scene
        .split(Split::Train)
        .into_par_iter()
        .filter(|_| began.elapsed() < patience && !stop.load(Ordering::Relaxed))
        .try_for_each(|view| scene.frame(view).map(drop))?;
    let mut trial = config.clone();
    let most = config.density.get("max_gaussians").and_then(|v| v.as_integer()).filter(|v| *v > 0).map_or(config.init.count, |v| v as usize);
    trial.init.count = trial.init.count.min(most);
    trial.density = toml::Table::from_iter([("kind".into(), "none".into())]);
    trial.train.iterations = 2 * ITERATIONS;
    (trial.train.batch, trial.train.coarse_batch) = (1, 0);
    (trial.train.shares, trial.train.stretch) = ([1.0, 0.0, 1.0], 1.0);
    trial.train.dynamic = Dynamic::All;
    (trial.train.lambda_r, trial.train.recover) = (0.0, false);
    // Small images would make the first stage, where nothing moves, cheaper than what it stands for.
    trial.train.image_growth = 0.0;
    trial.train.log_every = PER_MEASUREMENT;
    trial.train.checkpoint_every = 0;
    // Trained Gaussians are mostly opaque, and pixels behind them cost nothing.
    trial.init.opacity = trial.init.opacity.max(OPACITY);
    (trial.train.checks, trial.train.validation) = (false, 0);
    trial.auto = Default::default();
    let began = Instant::now();
    let recorder = Recorder::default();
    let job = TrainJob { config: &trial, scene: scene.clone(), out: None, resume: false, registry, events: &recorder, stop, observer: None };
    let trained = train(&job);
    proceed(stop)?;
    let (model, _) = trained?;
    let all_ms = 1000.0 * began.elapsed().as_secs_f64();
    let events = recorder.events();
    let iterations_ms: f64 =
        events.iter().map(|event| if let Event::Iteration { ms, .. } = event { f64::from(*ms) * PER_MEASUREMENT as f64 } else { 0.0 }).sum();
    // The lower quartile: whatever else the machine does now makes some measurements longer, and none shorter.
    let typical = |wanted: &str| {
        let mut times: Vec<f32> = events
            .iter()
            .filter_map(|event| match event {
                // The first measurement holds whatever happens once.
                Event::Iteration { stage, iteration, ms, .. } if stage == wanted && *iteration > PER_MEASUREMENT => Some(*ms),
                _ => None,
            })
            .collect();
        times.sort_by(f32::total_cmp);
        times.get(times.len() / 4).copied().map(f64::from)
    };
    let grown = growth(model.gaussians.len(), most);
    let still = grown * typical("coarse").unwrap_or(1.0).max(0.01);
    let start = (all_ms - iterations_ms).max(0.0);
    let moving = (grown * typical("main").unwrap_or(still)).max(still);
    if moving < WORTH_SHARING * still {
        return Ok(Timing { still, shared: moving - still, per_time: 0.0, start });
    }
    let per_time = (moving * share_per_view(&model, scene, VIEWS, registry)? - still).clamp(0.0, moving - still);
    Ok(Timing { still, shared: moving - still - per_time, per_time, start })
}
