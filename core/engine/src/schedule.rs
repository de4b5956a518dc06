//! Schedules in reference iterations of the 28,000-iteration protocol, scaled to the run's length.

use crate::config::TrainConfig;

/// The three stages (paper Section V).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Static reconstruction with densification.
    Coarse,
    /// Fitting dynamic scores, geometry frozen.
    Score,
    /// Field and Gaussians together.
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
    /// Length of the stage in the reference protocol, which windows and intervals are stated in.
    fn reference(self) -> f64 {
        match self {
            Stage::Coarse => 5000.0,
            Stage::Score => 3000.0,
            Stage::Main => 20_000.0,
        }
    }
}

/// Lengths and events of a run's stages.
#[derive(Clone, Debug)]
pub struct Schedule {
    lengths: [usize; 3],
    scale: f64,
}

impl Schedule {
    /// The schedule of `config`; `score` says whether the score stage is needed at all (its share goes to the others).
    pub fn new(config: &TrainConfig, score: bool) -> Self {
        let mut shares = config.shares;
        if !score {
            shares[1] = 0.0;
        }
        let sum: f64 = shares.iter().sum::<f64>().max(1e-9);
        let mut lengths = shares.map(|s| (config.iterations as f64 * s / sum).round() as usize);
        // Rounding goes to the longest stage, so that the stages add up to the knob.
        lengths[2] = config.iterations.saturating_sub(lengths[0] + lengths[1]);
        Self { lengths, scale: config.iterations as f64 / 28_000.0 }
    }
    /// Iterations of `stage`.
    pub fn length(&self, stage: Stage) -> usize {
        self.lengths[stage as usize]
    }
    /// `reference` iterations of a stage's protocol as iterations of this run.
    pub fn at(&self, stage: Stage, reference: usize) -> usize {
        (reference as f64 / stage.reference() * self.length(stage) as f64).round() as usize
    }
    /// An interval of `reference` iterations: shrinks with short runs but not below `least`, and does not grow with long ones.
    pub fn interval(&self, reference: usize, least: usize) -> usize {
        ((reference as f64 * self.scale.min(1.0)).round() as usize).max(least.min(reference)).max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_add_up_and_scale() {
        for iterations in [1, 7, 100, 28_000, 60_000] {
            let schedule = Schedule::new(&TrainConfig { iterations, ..Default::default() }, true);
            assert_eq!(Stage::ALL.iter().map(|&s| schedule.length(s)).sum::<usize>(), iterations);
        }
        let full = Schedule::new(&TrainConfig::default(), true);
        assert_eq!((full.length(Stage::Coarse), full.length(Stage::Score), full.length(Stage::Main)), (5000, 3000, 20_000));
        assert_eq!(full.at(Stage::Main, 10_000), 10_000);
        assert_eq!(full.interval(100, 20), 100);
        assert_eq!(Schedule::new(&TrainConfig { iterations: 100, ..Default::default() }, true).interval(100, 20), 20);
    }
}
