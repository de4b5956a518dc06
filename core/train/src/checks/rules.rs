//! When a run has failed: its scores are compared with the baselines.

use super::Baselines;
use crate::schedule::StageLengths;
use crate::train::Score;
use cc4dgs_core::Stage;

/// A score that is no failure whatever the baselines reach, dB: blurring hardly hurts images with little detail.
pub(super) const GOOD_ENOUGH_DB: f64 = 30.0;
/// A field whose motion gains less than this on moving pixels, against its images of other times, does not follow the motion, dB.
const MOTION_GAIN_DB: f64 = 0.3;
/// What a model must gain on the blurred images where poses or times are in doubt, dB.
const DOUBT_MARGIN_DB: f64 = 3.0;
/// What a model of images that all state one time must reach, dB, whole and blurred. Static scenes that are hardly trained reach 24 with 41 to 42 where they
/// are blurred, because what is missing is detail; of things that move the blurred images differ, too: 23 with 32.
const ONE_TIME_DB: f64 = 26.0;
const ONE_TIME_BLURRED_DB: f64 = 37.0;
/// A run has failed whose scores in the main stage are more than this below the score that the stage began with, dB: rounds of density control cost some.
const MOST_LOSS_DB: f64 = 2.0;
/// A run has failed that ends more than this below its best earlier score, dB.
const MOST_FALL_DB: f64 = 6.0;
/// Shorter runs are not judged, in iterations.
pub(super) const LEAST_ITERATIONS: usize = 300;
/// Shorter runs are judged by fewer rules, at the end only, in iterations.
const LEAST_ITERATIONS_FOR_ALL: usize = 1000;
/// So are runs whose main stage shows each training camera less often.
const LEAST_PASSES: usize = 5;

/// The rules that a run is long enough for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rules {
    /// The mean colour of each image, and the blurred images.
    Baselines,
    /// Doubts about poses and times, and motion, too.
    All,
}

impl Rules {
    /// The rules for a run of so many iterations, whose main stage draws `drawn` views of `cameras` cameras; `None` for one that is too short to be judged.
    pub fn of(iterations: usize, drawn: usize, cameras: usize) -> Option<Self> {
        let long = iterations >= LEAST_ITERATIONS_FOR_ALL && drawn >= LEAST_PASSES * cameras;
        (iterations >= LEAST_ITERATIONS).then_some(if long { Self::All } else { Self::Baselines })
    }
}

/// What looked wrong before training.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Doubts {
    /// Poses or times.
    pub any: bool,
    /// All images state one time.
    pub one_time: bool,
}

/// A rule that all deciding scores break; the words say what is reached and what is not.
#[derive(Debug, PartialEq)]
pub(super) enum Shortfall {
    /// Whole images.
    Images(String),
    /// Pixels that move.
    Motion(String),
    /// Whole images, against those before the main stage.
    Still(String),
}

/// The first of `rules` that every one of `scores` breaks; the last score is the present one. `still_db` is the score before the first iteration of the main
/// stage, when nothing moves yet where the deformer starts as the identity.
pub(super) fn shortfall(scores: &[Score], still_db: Option<f64>, baselines: &Baselines, rules: Rules, doubts: Doubts) -> Option<Shortfall> {
    let now = scores.last()?;
    let always = |below: &dyn Fn(&Score) -> bool| scores.iter().all(below);
    let images = |words: &str, db: f64| Some(Shortfall::Images(format!("training views reach {:.1} dB, {words} ({db:.1} dB)", now.psnr_db)));
    if always(&|s| s.psnr_db < baselines.mean_colour_db) {
        return images("less than the mean colour of each image", baselines.mean_colour_db);
    }
    let weak = always(&|s| s.psnr_db < GOOD_ENOUGH_DB);
    if weak && always(&|s| s.psnr_db < baselines.blur_db) {
        return images("less than the images blurred 16 times", baselines.blur_db);
    }
    if rules != Rules::All {
        return None;
    }
    if weak && doubts.any && now.psnr_db < baselines.blur_db + DOUBT_MARGIN_DB {
        return images("hardly more than the images blurred 16 times", baselines.blur_db);
    }
    if doubts.one_time && always(&|s| s.psnr_db < ONE_TIME_DB && s.blurred_db.is_none_or(|db| db < ONE_TIME_BLURRED_DB)) {
        return images("less than static scenes do", ONE_TIME_DB);
    }
    if let Some(still) = still_db.filter(|still| weak && always(&|s| s.psnr_db < still - MOST_LOSS_DB)) {
        return Some(Shortfall::Still(format!("training views reach {:.1} dB, less than the still scene before the main stage ({still:.1} dB)", now.psnr_db)));
    }
    let mean_image = baselines.mean_image_db?;
    let behind = |s: &Score| match (s.moving_db, s.frozen_db) {
        (Some(moving), Some(frozen)) => moving < mean_image.min(GOOD_ENOUGH_DB) && moving < frozen + MOTION_GAIN_DB,
        _ => false,
    };
    let moving = now.moving_db.filter(|_| always(&behind))?;
    let words = format!("pixels that move reach {moving:.1} dB, less than the mean image over time ({mean_image:.1} dB), and motion does not help");
    Some(Shortfall::Motion(words))
}

/// How far a run has fallen whose last score is more than 6 dB below its best earlier one, in words. All scores are of the same views at their full size.
/// Scores before `complete` do not count: the iteration of the main stage after which no frames and pixels are added.
pub(super) fn collapse(scores: &[Score], complete: usize, lengths: &StageLengths, baselines: &Baselines) -> Option<String> {
    let (end, earlier) = scores.split_last()?;
    let counts = |score: &&Score| score.percent > 0 && lengths.scored_at(score.percent) >= complete;
    let best = earlier.iter().filter(counts).max_by(|a, b| a.psnr_db.total_cmp(&b.psnr_db))?;
    if best.psnr_db - end.psnr_db <= MOST_FALL_DB {
        return None;
    }
    let blurred = match end.psnr_db < baselines.blur_db {
        true => format!(", less than the images blurred 16 times ({:.1} dB)", baselines.blur_db),
        false => String::new(),
    };
    let (at, length) = (lengths.scored_at(best.percent), lengths.length(Stage::Main));
    let (from, to) = (best.psnr_db, end.psnr_db);
    Some(format!("training views fell from {from:.1} dB at iteration {at} of {length} of the main stage to {to:.1} dB at its end{blurred}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::TrainConfig;

    #[test]
    fn a_run_that_ends_far_below_its_best_score_has_collapsed() {
        let baselines = Baselines { mean_colour_db: 12.0, blur_db: 20.0, mean_image_db: None };
        // 800 iterations of the main stage.
        let lengths = StageLengths::new(&TrainConfig { iterations: 1120, ..Default::default() }, true, 1.0);
        let of = |complete: usize, scores: [f64; 3]| {
            let score = |(percent, psnr_db)| Score { percent, psnr_db, moving_db: None, frozen_db: None, detail: 1.0, blurred_db: None };
            collapse(&[50, 85, 100].into_iter().zip(scores).map(score).collect::<Vec<_>>(), complete, &lengths, &baselines)
        };
        let fell = of(0, [27.0, 30.0, 11.0]).unwrap();
        assert!(fell.starts_with("training views fell from 30.0 dB at iteration 680 of 800 of the main stage to 11.0 dB at its end"), "{fell}");
        assert!(fell.ends_with(", less than the images blurred 16 times (20.0 dB)"), "{fell}");
        // One that fell before the second score, and one that is still above the blurred images.
        assert!(of(0, [29.0, 12.0, 13.0]).unwrap().contains("fell from 29.0 dB at iteration 400 of 800"));
        assert!(of(0, [27.0, 30.0, 23.5]).unwrap().ends_with("to 23.5 dB at its end"));
        // Six decibels are not more than six; rounds of density control and rates that fall cost less.
        assert_eq!((of(0, [27.0, 30.0, 24.0]), of(0, [31.0, 30.0, 30.5]), of(0, [20.0, 26.0, 30.0])), (None, None, None));
        // Early frames alone may be drawn better than all of them, and small images better than whole ones.
        assert_eq!((of(480, [30.0, 24.0, 23.0]), of(681, [30.0, 31.0, 23.0])), (None, None));
        assert!(of(400, [30.0, 24.0, 23.0]).is_some() && of(680, [20.0, 30.0, 23.0]).is_some());
        // A resumed run whose checkpoint has no scores.
        assert_eq!(collapse(&[], 0, &lengths, &baselines), None);
    }

    #[test]
    fn longer_runs_have_more_rules() {
        let rules = |iterations, drawn| Rules::of(iterations, drawn, 10);
        assert_eq!((rules(299, 9000), rules(300, 9000), rules(999, 9000)), (None, Some(Rules::Baselines), Some(Rules::Baselines)));
        assert_eq!((rules(1000, 49), rules(1000, 50)), (Some(Rules::Baselines), Some(Rules::All)));
    }

    #[test]
    fn every_deciding_score_must_break_the_rule() {
        let baselines = Baselines { mean_colour_db: 12.0, blur_db: 20.0, mean_image_db: Some(18.0) };
        let score = |psnr_db, [moving, frozen]: [f64; 2]| Score {
            percent: 0,
            psnr_db,
            moving_db: Some(moving),
            frozen_db: Some(frozen),
            detail: 1.0,
            blurred_db: None,
        };
        let (follows, still) = ([24.0, 17.0], [16.0, 15.9]);
        let of = |rules, any, scores: &[(f64, [f64; 2])]| {
            let scores: Vec<Score> = scores.iter().map(|&(psnr, moving)| score(psnr, moving)).collect();
            shortfall(&scores, None, &baselines, rules, Doubts { any, one_time: false })
        };
        let images = |found: Option<Shortfall>, words: &str| matches!(&found, Some(Shortfall::Images(said)) if said.contains(words));
        assert!(images(of(Rules::Baselines, false, &[(11.0, still)]), "reach 11.0 dB, less than the mean colour of each image (12.0 dB)"));
        assert!(images(of(Rules::Baselines, false, &[(19.0, follows)]), "blurred 16 times (20.0 dB)"));
        // One score above the baseline is enough.
        assert!(images(of(Rules::All, false, &[(11.0, still), (11.5, still)]), "reach 11.5 dB"));
        assert_eq!(of(Rules::All, false, &[(19.0, follows), (21.0, follows)]), None);
        assert_eq!(of(Rules::All, false, &[(21.0, follows), (19.0, follows)]), None);
        assert!(images(of(Rules::All, true, &[(19.0, follows), (22.9, follows)]), "hardly more"));
        assert_eq!((of(Rules::All, true, &[(19.0, follows), (23.1, follows)]), of(Rules::Baselines, true, &[(22.9, follows)])), (None, None));
        assert!(matches!(of(Rules::All, false, &[(25.0, still), (26.0, still)]), Some(Shortfall::Motion(said)) if said.contains("reach 16.0 dB")));
        assert_eq!((of(Rules::All, false, &[(25.0, still), (26.0, follows)]), of(Rules::Baselines, false, &[(26.0, still)])), (None, None));
        // Scores of older checkpoints have no moving pixels at 85 %.
        let unknown = Score { moving_db: None, frozen_db: None, ..score(26.0, still) };
        assert_eq!(shortfall(&[score(25.0, still), unknown], None, &baselines, Rules::All, Doubts::default()), None);
        let one_time = Doubts { any: true, one_time: true };
        let at_one_time = |rules, last| shortfall(&[score(24.0, follows), score(last, follows)], None, &baselines, rules, one_time);
        assert!(images(at_one_time(Rules::All, 25.0), "reach 25.0 dB, less than static scenes do (26.0 dB)"));
        assert_eq!((at_one_time(Rules::All, 26.5), at_one_time(Rules::Baselines, 25.0)), (None, None));
        let lacks_detail = Score { blurred_db: Some(41.0), ..score(25.0, follows) };
        let moved = Score { blurred_db: Some(32.0), ..lacks_detail };
        assert_eq!(shortfall(&[lacks_detail, lacks_detail], None, &baselines, Rules::All, one_time), None);
        assert!(images(shortfall(&[moved, moved], None, &baselines, Rules::All, one_time), "less than static scenes do"));
        // A main stage that makes the still scene worse.
        let after = |still, rules, scores: [f64; 2]| shortfall(&scores.map(|psnr| score(psnr, follows)), Some(still), &baselines, rules, Doubts::default());
        assert!(matches!(after(25.4, Rules::All, [21.0, 21.5]), Some(Shortfall::Still(said)) if said.contains("reach 21.5 dB") && said.contains("(25.4 dB)")));
        assert_eq!(
            (after(25.4, Rules::All, [21.0, 23.5]), after(25.4, Rules::Baselines, [21.0, 21.5]), after(40.0, Rules::All, [31.0, 31.0])),
            (None, None, None)
        );
        // Images without detail: the blurred ones are better than anything.
        let smooth = Baselines { blur_db: 40.0, ..baselines };
        assert_eq!(shortfall(&[score(31.0, follows)], None, &smooth, Rules::All, one_time), None);
    }
}
