//! The length of the main stage of a run that has a time to end at: settled once its first fifth has been timed.
//!
//! A plan times a few iterations of Gaussians that have not been trained. Trained ones take between two thirds of that and a fifth more, for reasons that differ
//! from scene to scene: how much they overlap, how many there are, how many move. What was settled is written into the run's settings as `train.stretch`, so that
//! a run from them repeats it without a clock.

use super::folder::write_settings;
use super::{Context, TrainState};
use crate::train_config::{LEAST_STRETCH, MOST_STRETCH};
use cc4dgs_core::{Event, Result, Schedule, Stage};
use std::time::Instant;

/// Share of the timed iterations that are not counted, because what happens once happens in them.
const FIRST: f64 = 0.25;
/// Share of the largest number of Gaussians that a run has on average.
const MEAN_GAUSSIANS: f64 = 0.9;
/// The time of an iteration grows with the number of Gaussians to this power: images have the same number of pixels.
const GROWTH_POWER: f64 = 0.7;
/// Iterations of a run that is not made shorter.
const LEAST_ITERATIONS: usize = 500;

/// How much longer than now an iteration takes on average, when there are `now` Gaussians and will be at most `most`.
pub(crate) fn growth(now: usize, most: usize) -> f64 {
    (MEAN_GAUSSIANS * most as f64 / now.max(1) as f64).max(1.0).powf(GROWTH_POWER)
}

/// Times the first fifth of a main stage.
pub(super) struct Pace {
    ends: Instant,
    began: Option<(usize, Instant)>,
}

impl Pace {
    /// For a stage that begins; `None` where no time was planned or the length is settled.
    pub fn new(context: &Context, stage: Stage, state: &TrainState) -> Option<Self> {
        let config = context.job.config;
        let ends = config.auto.ends.filter(|_| stage == Stage::Main && state.iteration == 0 && config.train.stretch == 1.0)?;
        Some(Self { ends, began: None })
    }
    /// To be called after every iteration: the factor by which the main stage is to be stretched, once it is known.
    pub fn after_iteration(&mut self, context: &Context, schedule: &Schedule, gaussians: usize) -> Option<f64> {
        let (last, iteration) = (context.lengths.settles_at(), schedule.iteration);
        let Some((first, began)) = self.began else {
            if iteration >= (FIRST * last as f64) as usize {
                self.began = Some((iteration, Instant::now()));
            }
            return None;
        };
        if iteration != last || first == last {
            return None;
        }
        let most = context.job.config.density.get("max_gaussians").and_then(toml::Value::as_integer).map_or(gaussians, |most| most.max(1) as usize);
        let seconds = growth(gaussians, most) * began.elapsed().as_secs_f64() / (last - first) as f64;
        let left = self.ends.saturating_duration_since(Instant::now()).as_secs_f64() / seconds;
        let least = if context.lengths.total() <= LEAST_ITERATIONS { 1.0 } else { LEAST_STRETCH };
        Some(((last as f64 + left) / schedule.length as f64).clamp(least, MOST_STRETCH))
    }
}

impl Context<'_> {
    /// Settles the length of the main stage, and writes it into the folder of the run.
    pub(super) fn stretch_main(&mut self, factor: f64) -> Result<()> {
        // Three digits are what a time tells.
        let factor = (1000.0 * factor).round() / 1000.0;
        let planned = self.lengths.length(Stage::Main);
        self.lengths.stretch_main(factor);
        self.settings.train.stretch = factor;
        let message = format!("{} iterations fit into the time, where {planned} were planned: train.stretch = {factor}", self.lengths.length(Stage::Main));
        self.job.events.emit(&Event::Note { object: "main stage".into(), message });
        self.job.out.as_deref().map_or(Ok(()), |out| write_settings(out, &self.settings))
    }
}
