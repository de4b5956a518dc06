//! Lengths of the stages of one run, and the [`Schedule`] of every iteration.

use crate::config::TrainConfig;
use cc4dgs_core::{Schedule, Settled, Stage};

/// Sizes per axis that images have before they have their full one, ascending; each for an equal part of the time.
pub const IMAGE_SCALES: [f32; 3] = [0.25, 0.354, 0.5];

/// The share of the main stage after which its length is settled ([`TrainConfig::stretch`]), or later where images are small for longer.
const SETTLED: f64 = 0.2;
/// The share of the main stage that is timed before that, with images of full size unless they are small until [`LAST_SETTLED`].
const TIMED: f64 = 0.1;
/// The largest share after which the length is settled.
const LAST_SETTLED: f64 = 0.9;

/// Iterations of a run's stages.
#[derive(Clone, Debug)]
pub struct StageLengths {
    /// By the shares alone.
    lengths: [usize; 3],
    /// The main stage once its length is settled.
    settled: usize,
    total: usize,
    passes: [usize; 3],
    sh_degree: usize,
    sh_interval: usize,
    extent: f32,
    image_growth: f64,
}

impl StageLengths {
    /// The lengths of `config`; `score` says whether the score stage is needed at all (its share goes to the others). `extent` is that of the cameras in the
    /// normalised frame.
    pub fn new(config: &TrainConfig, score: bool, extent: f32) -> Self {
        let mut shares = config.shares;
        if !score {
            shares[1] = 0.0;
        }
        let sum: f64 = shares.iter().sum::<f64>().max(1e-9);
        let mut lengths = shares.map(|s| (config.iterations as f64 * s / sum).round() as usize);
        // The stages add up to the number asked for: what rounding leaves or takes is in the main stage, or in the score stage where there is no main one.
        lengths[1] = lengths[1].min(config.iterations.saturating_sub(lengths[0]));
        lengths[2] = config.iterations.saturating_sub(lengths[0] + lengths[1]);
        let mut all = Self {
            lengths,
            settled: lengths[2],
            total: config.iterations,
            passes: [1; 3],
            sh_degree: config.sh_degree,
            sh_interval: config.sh_interval,
            extent,
            image_growth: config.image_growth,
        };
        all.stretch_main(config.stretch);
        all
    }
    /// Iterations of `stage`.
    pub fn length(&self, stage: Stage) -> usize {
        if stage == Stage::Main { self.settled } else { self.lengths[stage as usize] }
    }
    /// Iterations of the main stage before its length is settled.
    pub fn planned(&self) -> usize {
        self.lengths[Stage::Main as usize]
    }
    /// Iterations of all stages.
    pub fn total(&self) -> usize {
        self.total - self.lengths[2] + self.settled
    }
    /// The last iteration of the main stage whose schedule does not know the settled length.
    pub fn settles_at(&self) -> usize {
        let main = self.lengths[2] as f64;
        self.planned_growth().clamp(SETTLED * main, LAST_SETTLED * main) as usize
    }
    /// The iteration of the main stage, by its planned length, until which images have had their full size for [`TIMED`] of it; may lie outside the stage.
    fn planned_growth(&self) -> f64 {
        let [coarse, _, main] = self.lengths.map(|length| length as f64);
        self.image_growth * (coarse + main) - coarse + TIMED * main
    }
    /// The iteration of the main stage after which images have had their full size for a tenth of it, and its length is settled; beyond its end where they have
    /// it for less.
    pub fn grown_at(&self) -> usize {
        let (growth, main) = (self.planned_growth(), self.lengths[2] as f64);
        if growth <= LAST_SETTLED * main {
            return self.settles_at();
        }
        self.schedule(Stage::Main, self.settled).iteration_at(growth / main) as usize
    }
    /// The iteration of the main stage after which the model is scored that has `percent` of it behind it: not before the length is settled, so that a score is
    /// made once.
    pub fn scored_at(&self, percent: usize) -> usize {
        (self.settled * percent / 100).max(self.settles_at())
    }
    /// The iteration of the main stage after which iterations are timed to settle its length.
    pub fn timed_after(&self) -> usize {
        self.settles_at().saturating_sub((TIMED * self.lengths[2] as f64) as usize)
    }
    /// Makes the main stage `factor` times as long as its share, from [`StageLengths::settles_at`] on; it is longer than that in any case.
    pub fn stretch_main(&mut self, factor: f64) {
        let least = (self.settles_at() + 1).min(self.lengths[2]);
        self.settled = ((factor * self.lengths[2] as f64).round() as usize).max(least);
    }
    /// States in how many iterations every camera of `stage` is drawn once.
    pub fn set_pass(&mut self, stage: Stage, iterations: usize) {
        self.passes[stage as usize] = iterations.max(1);
    }
    /// Size per axis of the images of an iteration, as a share of their full one, where `before` is the iteration before. Scores are always fitted to full
    /// ones.
    fn image_scale(&self, before: Schedule) -> f32 {
        let (stage, [coarse, _, main]) = (before.stage, self.lengths);
        let done = if stage == Stage::Main { coarse as f64 + main as f64 * before.progress() } else { before.iteration as f64 };
        let share = done / (self.image_growth * (coarse + main) as f64);
        if stage == Stage::Score || share.is_nan() || share >= 1.0 { 1.0 } else { IMAGE_SCALES[(share * IMAGE_SCALES.len() as f64) as usize] }
    }
    /// Where iteration `iteration` (from 1) of `stage` stands.
    pub fn schedule(&self, stage: Stage, iteration: usize) -> Schedule {
        let settled = stage == Stage::Main && iteration > self.settles_at();
        let (length, total) = if settled { (self.settled, self.total()) } else { (self.lengths[stage as usize], self.total) };
        let mut schedule = Schedule {
            stage,
            iteration,
            length,
            settled: (settled && self.settled != self.planned()).then(|| Settled { after: self.settles_at(), planned: self.planned() }),
            total,
            pass: self.passes[stage as usize],
            sh_degree: self.sh_degree,
            image_scale: 1.0,
            extent: self.extent,
            trained: false,
        };
        schedule.image_scale = self.image_scale(Schedule { iteration: iteration.saturating_sub(1), ..schedule });
        // Degrees are added from the start of the coarse stage on, or of the main stage without one; a length that is settled later takes none away.
        if stage == if self.lengths[0] > 0 { Stage::Coarse } else { Stage::Main } {
            let interval = Schedule { total: self.total, ..schedule }.interval(self.sh_interval, 100);
            schedule.sh_degree = (iteration.saturating_sub(1) / interval).min(self.sh_degree);
        }
        schedule
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stretched_main_stage_is_longer_from_its_first_fifth_on() {
        let plain = StageLengths::new(&TrainConfig { iterations: 2800, ..Default::default() }, true, 1.0);
        let mut lengths = StageLengths::new(&TrainConfig { iterations: 2800, stretch: 1.31, ..Default::default() }, true, 1.0);
        assert_eq!((lengths.settles_at(), lengths.length(Stage::Main), lengths.length(Stage::Coarse), lengths.total()), (400, 2620, 500, 3420));
        for (stage, iteration) in [(Stage::Coarse, 500), (Stage::Score, 7), (Stage::Main, 400)] {
            assert_eq!(lengths.schedule(stage, iteration), plain.schedule(stage, iteration));
        }
        let after = lengths.schedule(Stage::Main, 401);
        assert_eq!((after.length, after.total), (2620, 3420));
        assert!((after.progress() - 0.2).abs() < 1e-3 && lengths.schedule(Stage::Main, 2620).progress() == 1.0);
        lengths.stretch_main(1.0);
        assert_eq!(lengths.schedule(Stage::Main, 401), plain.schedule(Stage::Main, 401));
    }

    #[test]
    fn a_length_is_settled_when_images_have_their_full_size() {
        let of = |image_growth, stretch| StageLengths::new(&TrainConfig { iterations: 2800, image_growth, stretch, ..Default::default() }, true, 1.0);
        assert_eq!((of(0.0, 1.0).timed_after(), of(0.1, 1.0).settles_at()), (200, 400));
        let growing = of(0.5, 1.4);
        assert_eq!((growing.timed_after(), growing.settles_at(), growing.length(Stage::Main)), (750, 950, 2800));
        let scale = |iteration| growing.schedule(Stage::Main, iteration).image_scale;
        assert_eq!((scale(750), scale(751), scale(951), scale(2800)), (0.5, 1.0, 1.0, 1.0));
        assert_eq!((of(1.0, 1.0).settles_at(), of(1.0, 0.7).length(Stage::Main)), (1800, 1801), "never shorter than what was done");
    }

    #[test]
    fn scores_wait_until_the_length_is_settled() {
        let of = |image_growth, stretch| StageLengths::new(&TrainConfig { iterations: 2800, image_growth, stretch, ..Default::default() }, true, 1.0);
        // When a run is scored that plans 2,000 iterations and finds `stretch` at its settling.
        let scored = |image_growth, stretch| {
            let (mut lengths, mut found) = (of(image_growth, 1.0), Vec::new());
            for iteration in 1..=8000 {
                if iteration == lengths.settles_at() {
                    lengths.stretch_main(stretch);
                }
                if iteration <= lengths.length(Stage::Main) {
                    found.extend([85, 50].into_iter().find(|&percent| iteration == lengths.scored_at(percent)).map(|percent| (percent, iteration)));
                }
            }
            found
        };
        assert_eq!(scored(0.0, 1.0), [(50, 1000), (85, 1700)]);
        assert_eq!(scored(0.0, 1.31), [(50, 1310), (85, 2227)]);
        // The length is settled after 1,200 iterations, then after 1,700: none is scored for half of a length that changes.
        assert_eq!(scored(0.6, 2.0), [(50, 2000), (85, 3400)]);
        assert_eq!((scored(0.6, 1.0), scored(0.6, 0.7)), (vec![(50, 1200), (85, 1700)], vec![(85, 1200)]));
        assert_eq!((scored(0.8, 4.0), scored(0.8, 1.0)), (vec![(50, 4000), (85, 6800)], vec![(85, 1700)]));
    }

    #[test]
    fn images_that_grow_late_have_their_full_size_for_a_tenth() {
        let of = |image_growth, stretch| StageLengths::new(&TrainConfig { iterations: 2800, image_growth, stretch, ..Default::default() }, true, 1.0);
        for growth in [0.0, 0.5, 0.8] {
            assert_eq!(of(growth, 2.0).grown_at(), of(growth, 2.0).settles_at());
            assert!(of(growth, 1.0).grown_at() <= of(growth, 1.0).scored_at(85));
        }
        // Full size from 1,650 of 2,000 on: not yet a tenth when the score is due, unless the stage gets longer.
        assert_eq!((of(0.86, 1.0).settles_at(), of(0.86, 1.0).scored_at(85)), (1800, 1800));
        assert!(of(0.86, 1.0).grown_at() > 1800 && of(0.86, 2.0).grown_at() < of(0.86, 2.0).scored_at(85));
        assert!(of(1.0, 1.0).grown_at() > 2000 && of(1.0, 4.0).grown_at() > 8000);
    }

    #[test]
    fn stages_add_up() {
        for shares in [TrainConfig::default().shares, [1.0, 1.0, 0.0], [1.0, 1.0, 1e-9], [0.0, 1.0, 1.0]] {
            for iterations in [1, 7, 100, 28_000, 60_000] {
                let lengths = StageLengths::new(&TrainConfig { iterations, shares, ..Default::default() }, true, 1.0);
                assert_eq!(Stage::ALL.iter().map(|&s| lengths.length(s)).sum::<usize>(), iterations, "shares {shares:?}");
            }
        }
        let full = StageLengths::new(&TrainConfig::default(), true, 1.0);
        assert_eq!((full.length(Stage::Coarse), full.length(Stage::Score), full.length(Stage::Main)), (5000, 3000, 20_000));
        let degrees: Vec<usize> = [1, 1000, 1001, 5000].iter().map(|&i| full.schedule(Stage::Coarse, i).sh_degree).collect();
        // A run without a coarse stage begins without harmonics, too; degrees stay when its main stage becomes longer.
        for stretch in [1.0, 1.5, 4.0] {
            let alone = StageLengths::new(&TrainConfig { shares: [0.0, 0.0, 1.0], stretch, iterations: 14_000, ..Default::default() }, true, 1.0);
            let degrees: Vec<usize> = (1..=alone.total()).map(|i| alone.schedule(Stage::Main, i).sh_degree).collect();
            assert_eq!([500, 501, 1001, 1501].map(|i| degrees[i - 1]), [0, 1, 2, 3]);
            assert!(degrees.is_sorted(), "{stretch}");
        }
        assert_eq!(full.schedule(Stage::Coarse, 1).image_scale, 1.0);
        let growing = StageLengths::new(&TrainConfig { image_growth: 0.5, ..Default::default() }, true, 1.0);
        let scale = |stage, iteration| growing.schedule(stage, iteration).image_scale;
        assert_eq!((scale(Stage::Coarse, 1), scale(Stage::Score, 1), scale(Stage::Main, 7499), scale(Stage::Main, 7501)), (0.25, 1.0, 0.5, 1.0));
        assert_eq!((degrees, full.schedule(Stage::Main, 1).sh_degree), (vec![0, 0, 1, 3], 3));
    }
}
