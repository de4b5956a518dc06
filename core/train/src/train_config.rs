//! The configuration of the trainer, `[train]`.

use crate::field_box::FieldBox;
use crate::masks::PUBLISHED_SIGMA;
use cc4dgs_core::{Error, Result, Schedule, Stage};
use serde::{Deserialize, Serialize};

/// Bounds of `train.stretch`. What happens at a third of the main stage still lies after its first fifth; a stage never ends before its length is settled.
pub(crate) const LEAST_STRETCH: f64 = 0.7;
pub(crate) const MOST_STRETCH: f64 = 4.0;
/// Iterations of all stages together: `auto` plans no fewer, and no main stage is made so short that fewer are left.
pub(crate) const LEAST_ITERATIONS: usize = 250;

/// The frames that the coarse stage sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CoarseFrames {
    /// The first one (all where no time has several cameras).
    First,
    /// All of them.
    All,
}

/// Which Gaussians may move.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Dynamic {
    /// By dynamic score where a camera has several frames, else all.
    Auto,
    /// By dynamic score, fitted to what changes in the images of fixed cameras, or to what a static reconstruction does not explain where none is fixed.
    Score,
    /// All of them.
    All,
    /// None of them.
    None,
}

/// The three-stage trainer (paper Section V; Swift4D's rules). Counts marked "reference" are iterations of the 28,000-iteration
/// schedule and scale with [`TrainConfig::iterations`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Iterations of all stages together: the one knob that scales every schedule.
    pub iterations: usize,
    /// Shares of coarse, score and main stage.
    pub shares: [f64; 3],
    /// Length of the main stage from its first fifth on, or later where `image_growth` asks for it, as a multiple of its share: runs that `auto` plans for a
    /// time find it when they have timed what is before.
    pub stretch: f64,
    /// The most views of an iteration.
    pub batch: usize,
    /// Views per iteration of the coarse stage, where no spatial pass is shared; 0 is as many as `batch`.
    pub coarse_batch: usize,
    /// Frames the coarse stage sees.
    pub coarse_frames: CoarseFrames,
    /// Share of the main stage over which frames come in one after another, where the coarse stage saw the first frame only; 0 is all at once.
    pub time_ramp: f64,
    /// Share of the coarse and main stage over which images grow from a quarter of their size to all of it; 0 is full size from the start.
    pub image_growth: f64,
    /// Standard deviation, in frames, of noise on the times the field is asked about; it falls to zero by half of the main stage (Deformable 3DGS: 0.1).
    pub time_noise: f64,
    /// Share of the Gaussians that a view is drawn without at the end of the coarse and the main stage, from 0 at their start (DropGaussian, Park et al. 2025:
    /// 0.2).
    pub dropout: f64,
    /// Highest spherical-harmonics degree.
    pub sh_degree: usize,
    /// Reference iterations between two degrees, from the start of the coarse stage, or of the main stage where there is no coarse one.
    pub sh_interval: usize,
    /// Smoothness weight at the end of its ramp (the paper's lambda_r); 0 is off.
    pub lambda_r: f32,
    /// Switch smoothness on only when flicker is measured.
    pub smooth_auto: bool,
    /// Flicker above which `smooth_auto` acts: rms second difference of the motion per frame over its rms amplitude.
    pub flicker_threshold: f32,
    /// Half-width of the smoothness perturbation, normalised units (the paper's delta).
    pub smooth_delta: f32,
    /// Weight of the strain of neighbouring moving Gaussians: s^2 / (1 + s^2) of the change s of their distance as a share of the canonical
    /// one, at the time of one view per iteration; 0 is off.
    pub strain: f32,
    /// Dynamic-score threshold (the paper's zeta).
    pub zeta: f32,
    /// Temporal standard deviation over which a pixel counts as dynamic.
    pub mask_threshold: f32,
    /// Standard deviation in pixels of the Gaussian by which temporal deviations are blurred. Published masks have 5, for images 1,352 pixels wide.
    pub mask_sigma: f32,
    /// At a third and at two thirds of the main stage, but not before `time_ramp`, scored Gaussians that move by less than so many pixels in every training
    /// camera are made static; 0 is off.
    pub settle: f32,
    /// Where several cameras see each frame: every so many frames is a key frame, at which what moves starts with points and lives of its own; 0 is off.
    pub key_frames: usize,
    /// Twice during the main stage, look for compact things that are in training views and not drawn, and add Gaussians with lives along their tracks.
    pub recover: bool,
    /// Which Gaussians may move.
    pub dynamic: Dynamic,
    /// The box in which the features of the deformer lie: `"moving"`, `"all"`, `"points"`, or a number h for a cube of the half width h around the origin of the
    /// dataset, in its units.
    pub field_box: FieldBox,
    /// Judge removals of Gaussians and opacity resets on training views. Without, the plans of the density control are carried out as they are, and the trainer
    /// removes only Gaussians with values that are not finite.
    pub guard: bool,
    /// Go on with the optimizer state of the Gaussians of the coarse stage in the main stage; dynamic scores, deformer, appearance and poses begin anew all the
    /// same. Without, every stage begins with a new optimizer state.
    pub keep_moments: bool,
    /// Step only the Gaussians that a view of the iteration shows.
    pub sparse_adam: bool,
    /// Iterations between two steps of the higher colour coefficients; the others compute no gradient of them.
    pub sh_every: usize,
    /// Learning rates of the Gaussians.
    pub lr: GaussianRates,
    /// Check the scene before training and the result afterwards. A scene that cannot be reconstructed is refused, and a run fails that stays below simple
    /// baselines or falls far below its own earlier scores; without checks both go on. Changes nothing else.
    pub checks: bool,
    /// Views that are kept out of training ([`crate::data::hold_out`]: whole cameras where cameras film) and scored at its end. Test views are never looked at.
    pub validation: usize,
    /// Iterations between two log events.
    pub log_every: usize,
    /// Iterations between two checkpoints; 0 writes only the last one.
    pub checkpoint_every: usize,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            iterations: 28_000,
            shares: [5.0, 3.0, 20.0],
            stretch: 1.0,
            batch: 2,
            coarse_batch: 0,
            coarse_frames: CoarseFrames::First,
            time_ramp: 0.0,
            image_growth: 0.0,
            time_noise: 0.0,
            dropout: 0.0,
            sh_degree: 3,
            sh_interval: 1000,
            lambda_r: 0.05,
            smooth_auto: true,
            flicker_threshold: 0.5,
            smooth_delta: 0.005,
            strain: 0.0,
            zeta: 7.0,
            mask_threshold: 0.02,
            mask_sigma: PUBLISHED_SIGMA,
            settle: 0.0,
            key_frames: 0,
            recover: false,
            dynamic: Dynamic::Auto,
            field_box: FieldBox::Moving,
            guard: true,
            keep_moments: false,
            sparse_adam: true,
            sh_every: 1,
            lr: GaussianRates::default(),
            checks: true,
            validation: 0,
            log_every: 10,
            checkpoint_every: 5000,
        }
    }
}

/// Adam's learning rates per attribute (Inria's, as Swift4D uses them).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GaussianRates {
    /// Every rate of the coarse and the main stage, those of plug-ins included, is multiplied by the number of views of the iteration to this power: 0 leaves
    /// them as they are, 0.5 takes the root. Where there are fewer views than `batch` says, these count.
    pub batch_power: f64,
    /// Share of the main stage, at its end, over which every rate falls to 0 as a cosine; 0 is off.
    pub cooldown: f64,
    /// Positions at the first iteration of a stage, times the extent of the cameras in the normalised frame ([`cc4dgs_core::Scene::extent`]).
    pub means: f64,
    /// Positions at the last iteration of a stage, times the same extent.
    pub means_end: f64,
    /// Share of the way from the first rate of positions to the last one that the coarse stage goes: 1 is all of it, 0.25 that of the published 5,000 of 20,000
    /// iterations.
    pub coarse_decay: f64,
    /// Share of that way at which the main stage begins: 0 is anew, as many as `coarse_decay` goes on from where the coarse stage ends.
    pub main_decay: f64,
    /// Share of the main stage after which positions have their last rate.
    pub main_until: f64,
    /// Log-scales.
    pub log_scales: f64,
    /// Quaternions.
    pub quaternions: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// Degree-0 colour.
    pub sh_dc: f64,
    /// Higher colour coefficients.
    pub sh_rest: f64,
    /// Dynamic scores at the first iteration of their stage.
    pub score: f64,
    /// Attributes without a rate of their own. Every deformer states one for each of its attributes, so that this has no effect on them.
    pub extra: f64,
}

impl Default for GaussianRates {
    fn default() -> Self {
        Self {
            batch_power: 0.0,
            cooldown: 0.0,
            means: 1.6e-4,
            means_end: 1.6e-6,
            coarse_decay: 1.0,
            main_decay: 0.0,
            main_until: 1.0,
            log_scales: 5e-3,
            quaternions: 1e-3,
            opacity: 0.05,
            sh_dc: 2.5e-3,
            sh_rest: 1.25e-4,
            score: 0.05,
            extra: 2.5e-3,
        }
    }
}

impl GaussianRates {
    /// The rates with their keys.
    fn rates(&self) -> [(&'static str, f64); 9] {
        let Self { means, means_end, log_scales, quaternions, opacity, sh_dc, sh_rest, score, extra, .. } = *self;
        [
            ("means", means),
            ("means_end", means_end),
            ("log_scales", log_scales),
            ("quaternions", quaternions),
            ("opacity", opacity),
            ("sh_dc", sh_dc),
            ("sh_rest", sh_rest),
            ("score", score),
            ("extra", extra),
        ]
    }
}

impl TrainConfig {
    /// Refuses values out of range.
    pub(crate) fn validate(&self) -> Result<()> {
        let t = self;
        let bad = |key: &str, problem: String, remedy: &str| Err(Error::parameter(format!("train.{key}"), problem, remedy));
        if t.iterations == 0 || t.iterations > 10_000_000 {
            return bad("iterations", format!("{} is not in 1..10,000,000", t.iterations), "Choose the number of training iterations");
        }
        if t.batch == 0 || t.batch > 64 {
            return bad("batch", format!("{} is not in 1..64", t.batch), "Choose the number of views per iteration");
        }
        if !(LEAST_STRETCH..=MOST_STRETCH).contains(&t.stretch) {
            return bad("stretch", format!("{} is not in {LEAST_STRETCH}..{MOST_STRETCH}", t.stretch), "1 is the share; train.iterations scales all stages");
        }
        if t.coarse_batch > 64 {
            return bad("coarse_batch", format!("{} is over 64", t.coarse_batch), "Choose the number of views per iteration; 0 is as many as train.batch");
        }
        if t.sh_every == 0 || t.sh_every > 1000 {
            return bad("sh_every", format!("{} is not in 1..1,000", t.sh_every), "Choose the iterations between two steps of the higher colour coefficients");
        }
        if t.sh_degree > 4 {
            return bad("sh_degree", format!("{} is over 4", t.sh_degree), "Choose a degree of 0 to 4");
        }
        if t.shares.iter().any(|s| !s.is_finite() || *s < 0.0) || t.shares.iter().sum::<f64>() <= 0.0 {
            return bad("shares", format!("{:?} are not shares", t.shares), "Give three numbers of which one is positive");
        }
        if !(t.settle >= 0.0 && t.settle.is_finite() && t.strain >= 0.0 && t.strain.is_finite()) {
            return bad("settle, train.strain", format!("{} and {}", t.settle, t.strain), "Give finite numbers of 0 or more");
        }
        if !(t.lambda_r >= 0.0 && t.lambda_r.is_finite()) {
            return bad("lambda_r", t.lambda_r.to_string(), "Give a finite number of 0 or more; 0 is off");
        }
        if !(0.0..=1.0).contains(&t.smooth_delta) {
            return bad("smooth_delta", format!("{} is not in 0..1", t.smooth_delta), "It is a share of the box and of the sequence; 0.005 is usual");
        }
        if let FieldBox::Cube(half) = t.field_box
            && !(half > 0.0 && half.is_finite())
        {
            return bad("field_box", format!("{half} is not the half width of a cube"), "Give a positive number, \"moving\", \"all\" or \"points\"");
        }
        if !(0.1..=100.0).contains(&t.mask_sigma) {
            return bad("mask_sigma", format!("{} pixels", t.mask_sigma), "Give 0.1 to 100 pixels");
        }
        if !(0.0..1.0).contains(&t.time_ramp) {
            return bad(
                "time_ramp",
                format!("{} is not in 0..1, without 1", t.time_ramp),
                "It is the share of the main stage after which the last frame is trained on",
            );
        }
        if let Some((key, rate)) = t.lr.rates().into_iter().find(|(_, rate)| !(*rate >= 0.0 && rate.is_finite())) {
            return bad(&format!("lr.{key}"), rate.to_string(), "Give a learning rate of 0 or more");
        }
        for (key, value) in [("mask_threshold", t.mask_threshold), ("flicker_threshold", t.flicker_threshold), ("zeta", t.zeta)] {
            if !(value >= 0.0 && value.is_finite()) {
                return bad(key, value.to_string(), "Give a finite number of 0 or more");
            }
        }
        if !(0.0..=1.0).contains(&t.lr.batch_power) {
            return bad(
                "lr.batch_power",
                format!("{} is not in 0..1", t.lr.batch_power),
                "0 leaves learning rates as they are, 0.5 takes the root of the number of views",
            );
        }
        if !(0.0..=1.0).contains(&t.lr.cooldown) {
            return bad("lr.cooldown", format!("{} is not in 0..1", t.lr.cooldown), "It is a share of the main stage; 0.1 is usual");
        }
        for (key, share) in [("lr.coarse_decay", t.lr.coarse_decay), ("lr.main_decay", t.lr.main_decay)] {
            if !(0.0..=1.0).contains(&share) {
                return bad(key, format!("{share} is not in 0..1"), "It is a share of the way from lr.means to lr.means_end");
            }
        }
        if !(0.01..=1.0).contains(&t.lr.main_until) {
            return bad("lr.main_until", format!("{} is not in 0.01..1", t.lr.main_until), "It is a share of the main stage; 1 is all of it");
        }
        if !(0.0..=1.0).contains(&t.image_growth) {
            return bad("image_growth", format!("{} is not in 0..1", t.image_growth), "It is a share of the coarse and main stage");
        }
        if !(0.0..=10.0).contains(&t.time_noise) {
            return bad("time_noise", format!("{} frames", t.time_noise), "Give 0 to 10 frames");
        }
        if !(0.0..=0.9).contains(&t.dropout) {
            return bad("dropout", format!("{} is not in 0..0.9", t.dropout), "It is a share of the Gaussians; 0.2 is usual");
        }
        Ok(())
    }
    /// The most views of an iteration of `stage`: there are fewer where the scene, or what `time_ramp` has opened of it, has fewer.
    pub fn views_per_iteration(&self, stage: Stage) -> usize {
        if stage == Stage::Coarse && self.coarse_batch > 0 { self.coarse_batch } else { self.batch }
    }
    /// The factor of every learning rate of an iteration whose loss is the mean over this number of `views`. Where a trained model is trained further, the
    /// number of views that its configuration states counts.
    pub fn rate_scale(&self, schedule: &Schedule, views: usize) -> f64 {
        let views = if schedule.trained { self.views_per_iteration(schedule.stage) } else { views };
        let of_batch = (views as f64).powf(self.lr.batch_power);
        let begin = 1.0 - self.lr.cooldown;
        if schedule.stage != Stage::Main || schedule.progress() <= begin {
            return of_batch;
        }
        of_batch * (0.5 + 0.5 * (std::f64::consts::PI * (schedule.progress() - begin) / self.lr.cooldown).cos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Settled;

    #[test]
    fn rates_fall_at_the_end_of_the_main_stage_alone() {
        let train = TrainConfig { batch: 4, lr: GaussianRates { batch_power: 0.5, cooldown: 0.25, ..Default::default() }, ..Default::default() };
        let at = |stage: Stage, iteration: usize| train.rate_scale(&Schedule { stage, iteration, ..Schedule::main(1000) }, 4);
        assert_eq!([1, 500, 750].map(|iteration| at(Stage::Main, iteration)), [2.0; 3]);
        assert!((at(Stage::Main, 875) - 1.0).abs() < 1e-9 && at(Stage::Main, 1000).abs() < 1e-9);
        assert_eq!(at(Stage::Coarse, 1000), 2.0);
        let without = TrainConfig { lr: GaussianRates::default(), ..train.clone() };
        assert_eq!(without.rate_scale(&Schedule { iteration: 1000, ..Schedule::main(1000) }, 4), 1.0);
        // The length was changed after a fifth of the stage.
        let settled = Some(Settled { after: 10, planned: 50 });
        assert_eq!(without.rate_scale(&Schedule { iteration: 51, settled, ..Schedule::main(51) }, 4), 1.0);
    }

    #[test]
    fn rates_follow_the_views_of_an_iteration() {
        let train = TrainConfig { batch: 9, lr: GaussianRates { batch_power: 0.5, ..Default::default() }, ..Default::default() };
        assert_eq!([1, 4, 9].map(|views| train.rate_scale(&Schedule::main(1000), views)), [1.0, 2.0, 3.0]);
        assert_eq!(train.rate_scale(&Schedule::further(1), 4), 3.0, "further training has shares of the rates of the training");
    }
}
