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

/// One iteration of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// The current stage.
    pub stage: Stage,
    /// Iteration within the stage, from 1.
    pub iteration: usize,
    /// Iterations of the stage.
    pub length: usize,
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
}

impl Schedule {
    /// The first iteration of a main stage of `length` iterations, for tests and tools.
    pub fn main(length: usize) -> Self {
        Self { stage: Stage::Main, iteration: 1, length, total: length, pass: 1, sh_degree: 3, image_scale: 1.0, extent: 1.0 }
    }
    /// Share of the stage done after this iteration, above 0 and at most 1.
    pub fn progress(&self) -> f64 {
        self.iteration as f64 / self.length as f64
    }
    /// Iterations left in the stage after this one.
    pub fn left(&self) -> usize {
        self.length.saturating_sub(self.iteration)
    }
    /// Converts `reference` iterations of the stage to iterations of this run.
    pub fn at(&self, reference: usize) -> usize {
        (reference as f64 / self.stage.reference_length() as f64 * self.length as f64).round() as usize
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
    fn reference_counts_scale_with_the_stage() {
        let full = Schedule { total: 28_000, ..Schedule::main(20_000) };
        assert_eq!((full.at(10_000), full.interval(100, 20)), (10_000, 100));
        let short = Schedule::main(100);
        assert_eq!((short.at(10_000), short.interval(100, 20)), (50, 20));
        assert_eq!(Schedule { iteration: 100, ..short }.left(), 0);
    }
}
