//! The length of the main stage of a run that has a time to end at: settled after its first fifth, or once images have had their full size for a while, by the
//! time of the last iterations until then. Earlier ones tell less: Gaussians that have just begun to learn cover more pixels.
//!
//! A plan times a few iterations of Gaussians that have not been trained. Trained ones take between two thirds of that and a fifth more, for reasons that
//! differ from scene to scene: how much they overlap, how many there are, how many move. What was settled is written into the run's settings as
//! `train.stretch`, so that a run from them repeats it without a clock.

use super::folder::write_settings;
use super::{Context, TrainState};
use crate::schedule::StageLengths;
use crate::train_config::{LEAST_ITERATIONS, LEAST_STRETCH, MOST_STRETCH};
use cc4dgs_core::{Event, Result, Schedule, Stage};
use std::time::Instant;

/// The most iterations that are timed together: a graphics card works on several at a time.
const TOGETHER: usize = 10;
/// What takes so many times the median of its stage happens once, and is not counted.
const ONCE: f64 = 3.0;
/// Share of the largest number of Gaussians that a run has on average.
const MEAN_GAUSSIANS: f64 = 0.9;
/// The time of an iteration grows with the number of Gaussians to this power: images have the same number of pixels.
const GROWTH_POWER: f64 = 0.7;
/// What a later iteration takes, as a share of one of those that are timed. Without it, runs of two to ten minutes ended after 85 to 94 % of their time; a few
/// captures get dearer instead and take up to a sixth too long.
const LATER: f64 = 0.94;

/// How much longer than now an iteration takes on average, when there are `now` Gaussians and will be at most `most`.
pub(crate) fn growth(now: usize, most: usize) -> f64 {
    (MEAN_GAUSSIANS * most as f64 / now.max(1) as f64).max(1.0).powf(GROWTH_POWER)
}

/// How many iterations are timed together, so few that some fit between those with smaller images and the one that settles the length.
fn timed_together(lengths: &StageLengths) -> usize {
    (lengths.settles_at().saturating_sub(lengths.timed_after()) / 3).clamp(1, TOGETHER)
}

/// The least factor by which a main stage of `main` iterations may be stretched, in a run of `total`.
fn least_stretch(total: usize, main: usize) -> f64 {
    let others = total.saturating_sub(main);
    (LEAST_ITERATIONS.saturating_sub(others) as f64 / main.max(1) as f64).clamp(LEAST_STRETCH, 1.0)
}

/// Times a main stage until its length is settled.
pub(super) struct Pace {
    ends: Instant,
    since: Option<Instant>,
    /// Seconds of so many iterations each as are timed together.
    seconds: Vec<f64>,
}

impl Pace {
    /// For a stage that begins or goes on; `None` where no time was planned or the length is settled.
    pub fn new(context: &Context, stage: Stage, state: &TrainState) -> Option<Self> {
        let ends = context.ends.filter(|_| stage == Stage::Main && state.iteration < context.lengths.settles_at())?;
        Some(Self { ends, since: None, seconds: Vec::new() })
    }
    /// To be called after every iteration: the factor by which the main stage is to be stretched, once it is known.
    pub fn after_iteration(&mut self, context: &Context, schedule: &Schedule, gaussians: usize) -> Option<f64> {
        let (last, iteration) = (context.lengths.settles_at(), schedule.iteration);
        let together = timed_together(&context.lengths);
        if iteration.is_multiple_of(together) && iteration <= last {
            let now = Instant::now();
            if let Some(since) = self.since.replace(now).filter(|_| iteration >= context.lengths.timed_after() + together) {
                self.seconds.push(now.duration_since(since).as_secs_f64());
            }
        }
        let each = usual(&self.seconds).filter(|_| iteration == last)? / together as f64;
        let most = context.job.config.density.get("max_gaussians").and_then(toml::Value::as_integer).map_or(gaussians, |most| most.max(1) as usize);
        let left = self.ends.saturating_duration_since(Instant::now()).as_secs_f64() / (LATER * growth(gaussians, most) * each);
        let least = least_stretch(context.lengths.total(), context.lengths.planned());
        Some(((last as f64 + left) / schedule.length as f64).clamp(least, MOST_STRETCH))
    }
}

/// The mean of `values` without those that are far over the median; `None` for no values.
fn usual(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let most = ONCE * sorted.get(sorted.len() / 2)?;
    sorted.retain(|value| *value <= most);
    Some(sorted.iter().sum::<f64>() / sorted.len().max(1) as f64).filter(|mean| *mean > 0.0)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::TrainConfig;

    #[test]
    fn what_happens_once_is_not_counted() {
        assert_eq!(usual(&[]), None);
        assert_eq!(usual(&[2.0, 1.0, 3.0]), Some(2.0));
        assert_eq!(usual(&[1.0, 1.0, 40.0, 1.0, 1.0]), Some(1.0));
    }

    #[test]
    fn short_runs_are_shortened_to_the_fewest_iterations_at_most() {
        assert_eq!((least_stretch(28_000, 20_000), least_stretch(500, 450)), (LEAST_STRETCH, LEAST_STRETCH));
        assert_eq!((least_stretch(60, 43), least_stretch(LEAST_ITERATIONS, 225)), (1.0, 1.0));
        assert!((30.0 + 270.0 * least_stretch(300, 270) - LEAST_ITERATIONS as f64).abs() < 1e-9);
        assert_eq!(least_stretch(500, 0), LEAST_STRETCH);
    }

    #[test]
    fn every_run_times_iterations_before_its_length_is_settled() {
        for (shares, image_growth) in [([5.0, 3.0, 20.0], 0.5), ([5.0, 3.0, 20.0], 0.0), ([2.0, 0.0, 18.0], 0.5), ([1.0, 0.0, 4.0], 0.0)] {
            for iterations in 250..3000 {
                let lengths = StageLengths::new(&TrainConfig { iterations, shares, image_growth, ..Default::default() }, true, 1.0);
                let (last, together) = (lengths.settles_at(), timed_together(&lengths));
                let latest = last / together * together;
                assert!(latest >= lengths.timed_after() + together, "{iterations} iterations, shares {shares:?}, growth {image_growth}");
            }
        }
    }

    #[test]
    fn more_gaussians_take_longer_and_fewer_never_less() {
        assert_eq!(growth(1000, 500), 1.0);
        assert!(growth(500, 1000) > 1.4 && growth(0, 10).is_finite());
    }
}
