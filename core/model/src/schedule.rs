//! The schedule of a training run: a value that is computed once per iteration and passed to every part of the trainer.

use serde::{Deserialize, Serialize};

/// Iterations of the reference protocol, the unit of windows and intervals (paper Section V: 5,000 + 3,000 + 20,000).
pub const REFERENCE_ITERATIONS: usize = 28_000;

/// The three stages of training (paper Section V).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Static reconstruction with density control.
    Coarse,
    /// Fitting dynamic scores, geometry frozen.
    Score,
    /// Deformer and Gaussians together.
    Main,
}

impl Stage {
    /// All stages in order.
    pub const ALL: [Stage; 3] = [Stage::Coarse, Stage::Score, Stage::Main];
    /// Its name in events and logs.
    pub fn name(self) -> &'static str {
        match self {
            Stage::Coarse => "coarse",
            Stage::Score => "score",
            Stage::Main => "main",
        }
    }
    /// Length of the stage in the reference protocol, in iterations.
    pub fn reference_length(self) -> usize {
        match self {
            Stage::Coarse => 5000,
            Stage::Score => 3000,
            Stage::Main => 20_000,
        }
    }
}

/// How the length of a stage was changed while it ran.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Settled {
    /// The last iteration of the stage before.
    pub after: usize,
    /// Iterations that the stage was to have until then; more than `after`.
    pub planned: usize,
}

/// One iteration of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// The current stage.
    pub stage: Stage,
    /// Iteration within the stage, from 1.
    pub iteration: usize,
    /// Iterations of the stage.
    pub length: usize,
    /// Set where `length` is not what it was when the stage began.
    pub settled: Option<Settled>,
    /// Iterations of all stages together.
    pub total: usize,
    /// Iterations in which every training camera (pose) of the stage is drawn once. At least 1.
    pub pass: usize,
    /// Spherical-harmonics degree that is rendered now.
    pub sh_degree: usize,
    /// Image size over the recorded size, per axis, 0..1.
    pub image_scale: f32,
    /// 1.1 times the largest distance of a training camera from their mean, world units.
    pub extent: f32,
    /// Whether the model is trained already: the deformer gets progress 1, while rates are those of [`Schedule::progress`].
    pub trained: bool,
}

/// Half the length of the stage of [`Schedule::further`]: rates hardly change over its iterations, and each has its own index for random numbers.
const HALF: usize = 1_000_000;

impl Schedule {
    /// The first iteration of a main stage of `length` iterations, for tests and tools.
    pub fn main(length: usize) -> Self {
        Self { stage: Stage::Main, iteration: 1, length, settled: None, total: length, pass: 1, sh_degree: 3, image_scale: 1.0, extent: 1.0, trained: false }
    }
    /// Iteration `iteration`, from 0 to a million, of training a trained model further, as for fine-tuning: rates are those at half of a main stage.
    pub fn further(iteration: usize) -> Self {
        Self { iteration: HALF + iteration, trained: true, ..Self::main(2 * HALF) }
    }
    /// The progress for [`Deformer::set_progress`](crate::Deformer::set_progress), above 0 and at most 1.
    pub fn deformer_progress(&self) -> f64 {
        if self.trained { 1.0 } else { self.progress() }
    }
    /// Share of the stage done after this iteration, above 0 and at most 1. It grows steadily where the length of the stage changes, too.
    pub fn progress(&self) -> f64 {
        let (iteration, length) = (self.iteration as f64, self.length as f64);
        let Some((after, share, planned)) = self.knee() else { return iteration / length };
        // Rounded, both shares together may be 1 + 2.2e-16 after the last iteration.
        if iteration <= after { iteration / planned } else { (share + (1.0 - share) * (iteration - after) / (length - after)).min(1.0) }
    }
    /// The iteration, not rounded, after which `share` of the stage is done: the inverse of [`Schedule::progress`].
    pub fn iteration_at(&self, share: f64) -> f64 {
        let length = self.length as f64;
        let Some((after, known, planned)) = self.knee() else { return share * length };
        if share <= known { share * planned } else { after + (share - known) / (1.0 - known) * (length - after) }
    }
    /// Where the length changed: iteration, progress, and the length before.
    fn knee(&self) -> Option<(f64, f64, f64)> {
        self.settled.map(|s| (s.after as f64, s.after as f64 / s.planned as f64, s.planned as f64))
    }
    /// Iterations left in the stage after this one.
    pub fn left(&self) -> usize {
        self.length.saturating_sub(self.iteration)
    }
    /// Converts `reference` iterations of the stage to iterations of this run.
    pub fn at(&self, reference: usize) -> usize {
        self.iteration_at(reference as f64 / self.stage.reference_length() as f64).round() as usize
    }
    /// An interval of `reference` iterations. It shrinks in short runs, but not below `least`, and does not grow in long ones.
    pub fn interval(&self, reference: usize, least: usize) -> usize {
        let scale = self.total as f64 / REFERENCE_ITERATIONS as f64;
        ((reference as f64 * scale.min(1.0)).round() as usize).max(least.min(reference)).max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn training_further_leaves_rates_alone_and_repeats_no_draw() {
        let seen: std::collections::BTreeSet<u32> = (0..5000).map(|i| (Schedule::further(i).progress() as f32).to_bits()).collect();
        assert_eq!(seen.len(), 5000);
        assert!((Schedule::further(5000).progress() - 0.5).abs() < 0.003);
        assert_eq!((Schedule::further(7).deformer_progress(), Schedule::main(4).deformer_progress()), (1.0, 0.25));
    }

    #[test]
    fn reference_counts_scale_with_the_stage() {
        let full = Schedule { total: 28_000, ..Schedule::main(20_000) };
        assert_eq!((full.at(10_000), full.interval(100, 20)), (10_000, 100));
        let short = Schedule::main(100);
        assert_eq!((short.at(10_000), short.interval(100, 20)), (50, 20));
        assert_eq!(Schedule { iteration: 100, ..short }.left(), 0);
    }

    #[test]
    fn progress_is_steady_where_the_length_changes() {
        for length in [700, 1500, 4000] {
            let at = |iteration| Schedule { iteration, settled: Some(Settled { after: 200, planned: 1000 }), ..Schedule::main(length) };
            assert_eq!((at(100).progress(), at(200).progress(), at(length).progress()), (0.1, 0.2, 1.0));
            for iteration in 1..=length {
                assert!((at(1).iteration_at(at(iteration).progress()) - iteration as f64).abs() < 1e-6);
            }
            let step = 0.8 / (length - 200) as f64;
            assert!((at(201).progress() - 0.2 - step).abs() < 1e-12);
            assert_eq!(at(1).at(3000), 150, "what lies before stays where it was");
        }
    }

    #[test]
    fn progress_is_1_after_the_last_iteration_of_any_length() {
        for (after, planned, length) in [(10, 50, 51), (10, 50, 58), (5383, 26_919, 26_892), (5785, 28_926, 112_754)] {
            let last = Schedule { iteration: length, settled: Some(Settled { after, planned }), ..Schedule::main(length) };
            assert_eq!(last.progress(), 1.0, "{length} iterations where {planned} were planned");
        }
    }
}
