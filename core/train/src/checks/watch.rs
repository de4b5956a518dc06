//! Scores a model on its way and at its end, and decides whether the run has failed.

use super::baselines::{MovingPixels, Yardstick, blurred, psnr_db};
use super::rules::{Doubts, GOOD_ENOUGH_DB, LEAST_ITERATIONS, Rules, Shortfall, collapse, shortfall};
use super::verdict::{Evidence, Verdict};
use super::{Finding, Subject};
use crate::config::TrainConfig;
use crate::sample::spread_views;
use crate::schedule::StageLengths;
use crate::train::{Context, Score, TrainState};
use crate::train_config::MOST_STRETCH;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Error, Event, Result, SAME_TIME, Schedule, Split, Stage, plural};
use cc4dgs_play::Moving;

/// Where the main stage is scored, percent; but for `START`, never before its length is settled, which decides what the rules are. A run stops at `LATE` if it
/// has failed at `HALF` and at `LATE`; the scores at `HALF` and at `END` decide at the end, where it must not be far below any earlier one either. What was
/// there at `START` must not get worse.
const START: usize = 0;
const HALF: usize = 50;
const LATE: usize = 85;
const END: usize = 100;
/// The most views of the reader's own validation split that are scored where `train.validation` asks for none.
const VALIDATION_VIEWS: usize = 24;

/// Follows one run.
pub(crate) struct Watch {
    doubts: Vec<Finding>,
    yardstick: Option<Yardstick>,
    scores: Vec<Score>,
}

impl Watch {
    /// Watches the run of `context`, whose scene raised `doubts`, from `state` on.
    ///
    /// # Errors
    /// [`Error::Failed`] again, where `state` comes from the checkpoint of a run that stopped because it had failed.
    pub fn new(context: &Context, doubts: Vec<Finding>, state: &TrainState) -> Result<Self> {
        let mut watch = Self { doubts, yardstick: None, scores: state.record.scores.clone() };
        if rules(context) == Some(Rules::All) && state.stage == Stage::Main && state.iteration == context.lengths.scored_at(LATE) && watch.at(LATE).is_some() {
            watch.measure_baselines(context)?;
            if let Some(failure) = watch.failure_at(LATE, context, state) {
                return Err(failure);
            }
        }
        Ok(watch)
    }
    /// To be called before the first iteration of the main stage; scores the model that it begins with, where the stage has or may get the length for it.
    pub fn before_main(&mut self, context: &Context, state: &mut TrainState) -> Result<()> {
        let mut longest = context.lengths.clone();
        if context.ends.is_some() {
            longest.stretch_main(MOST_STRETCH);
        }
        if rules_of(&context.job.config.train, &longest, context.training_camera.len()) == Some(Rules::All) {
            self.score(context, state, START)?;
            state.record.scores.clone_from(&self.scores);
        }
        Ok(())
    }
    /// To be called after every iteration; scores the model at half and at 85 % of the main stage, once its length is settled. Returns the error of a run that
    /// has failed at both: it is to be stopped.
    pub fn after_iteration(&mut self, context: &Context, state: &mut TrainState, schedule: &Schedule) -> Result<Option<Error>> {
        if schedule.stage != Stage::Main || !context.job.config.train.checks {
            return Ok(None);
        }
        let rules = rules(context);
        if schedule.iteration == context.lengths.settles_at() && rules != Some(Rules::All) {
            // The stage did not get the length that this score is for.
            self.scores.retain(|score| score.percent != START);
            state.record.scores.clone_from(&self.scores);
        }
        if rules.is_none() {
            return Ok(None);
        }
        // Both are due where the length is settled late and gets shorter.
        let due = |percent: &usize| schedule.iteration == context.lengths.scored_at(*percent);
        let Some(percent) = [LATE, HALF].into_iter().find(due) else { return Ok(None) };
        self.score(context, state, percent)?;
        state.record.scores.clone_from(&self.scores);
        Ok(if percent == LATE { self.failure_at(LATE, context, state) } else { None })
    }
    /// The verdict of a finished run, as an event too; `None` for a run that is too short to be judged, and an event that says so.
    ///
    /// # Errors
    /// [`Error::Failed`] for a model that is not better than what can be had without one, and for one that was far better before.
    pub fn conclude(&mut self, context: &Context, state: &mut TrainState) -> Result<Option<Verdict>> {
        let train = &context.job.config.train;
        let note = |message: String| context.job.events.emit(&Event::Note { object: "verdict".into(), message });
        if rules(context).is_none() {
            if train.checks {
                let total = context.lengths.total();
                let are = plural(total, "iteration is", "iterations are");
                note(format!("none: {total} {are} too few to be judged, which needs at least {LEAST_ITERATIONS}"));
            }
            return Ok(None);
        }
        self.score(context, state, END)?;
        let (Some(yardstick), Some(end)) = (&self.yardstick, self.at(END)) else { return Ok(None) };
        // Before the baselines: poses and times are no likely causes where the model was good.
        if let Some(problem) = collapse(&self.scores, complete_at(&context.lengths, train.time_ramp), &context.lengths, &yardstick.baselines) {
            note(format!("fell apart: {problem}"));
            let remedy = format!(
                "It fell apart: try lower learning rates (train.lr, those of the deformer), rates that fall to 0 at the end (train.lr.cooldown = 0.2), or \
                 density.kind = \"none\" to see whether density control is the cause. {} = false accepts such models",
                kept(context)
            );
            return Err(Error::failed("training", problem, remedy));
        }
        if let Some(failure) = self.failure_at(END, context, state) {
            return Err(failure);
        }
        let cap = context.job.config.density.get("max_gaussians").and_then(toml::Value::as_integer).and_then(|cap| usize::try_from(cap).ok());
        // A static scene may well state one time for all images; it is no cause of anything while the model is good.
        let mut doubts = self.doubts.clone();
        if let Some(warning) = same_time(&context.job.scene.warnings).filter(|_| end.psnr_db < GOOD_ENOUGH_DB) {
            doubts.push(Finding::doubt(Subject::Times, warning.clone(), "Give each image its time"));
        }
        let verdict = Evidence {
            train_psnr_db: end.psnr_db,
            late_psnr_db: self.at(LATE).map(|s| s.psnr_db),
            validation_psnr_db: validation_psnr_db(context, state)?,
            moving_psnr_db: end.moving_db,
            detail: end.detail,
            gaussians: state.set.len(),
            cap,
            baselines: yardstick.baselines,
            doubts: &doubts,
            warnings: &context.job.scene.warnings,
        }
        .verdict();
        note(verdict.sentence.clone());
        Ok(Some(verdict))
    }
    fn at(&self, percent: usize) -> Option<&Score> {
        self.scores.iter().find(|s| s.percent == percent)
    }
    fn measure_baselines(&mut self, context: &Context) -> Result<()> {
        if self.yardstick.is_none() {
            let config = context.job.config;
            self.yardstick = Some(Yardstick::new(&context.job.scene, config.train.mask_threshold, config.background()?)?);
        }
        Ok(())
    }
    fn score(&mut self, context: &Context, state: &mut TrainState, percent: usize) -> Result<()> {
        let scene = &context.job.scene;
        let background = context.job.config.background()?;
        self.measure_baselines(context)?;
        let Some(yardstick) = &self.yardstick else { return Ok(()) };
        let whole = scored(context, state, &yardstick.views)?;
        // Each moving view at its own time and, for comparison, a third and two thirds of the sequence later.
        let mut sums = [0.0; 3];
        let moving = &yardstick.moving;
        for (shift, sum) in [0.0, 1.0 / 3.0, 2.0 / 3.0].into_iter().zip(&mut sums) {
            let time = |view: usize| if shift == 0.0 { scene.views[view].time_norm } else { (scene.views[view].time_norm + shift).fract() };
            let requests: Vec<(usize, f32)> = moving.iter().map(|m| (m.view, time(m.view))).collect();
            let gaussians = state.set.gaussians()?;
            context.draw(state, &gaussians, &requests, gaussians.sh_degree, |index, image| {
                let image = to_vec(image, "drawn view")?;
                let MovingPixels { view, mask } = &moving[index];
                let camera = scene.camera(*view);
                let truth = scene.frame(*view)?.to_planes(background);
                *sum += psnr_db(&truth, &image, [camera.width, camera.height], Some(mask))?;
                Ok(())
            })?;
        }
        let mean = |sum: f64| (!moving.is_empty()).then(|| sum / moving.len() as f64);
        // Iterations that the watchdog repeats are scored again.
        self.scores.retain(|s| s.percent != percent);
        self.scores.push(Score {
            percent,
            psnr_db: whole.psnr_db,
            moving_db: mean(sums[0]),
            frozen_db: mean(0.5 * (sums[1] + sums[2])),
            detail: whole.detail,
            blurred_db: Some(whole.blurred_db),
        });
        Ok(())
    }
    /// The error of a run that has failed at `percent`, of which the baselines are measured. A deformer that is static by choice is warned of, at the end.
    fn failure_at(&self, percent: usize, context: &Context, state: &TrainState) -> Option<Error> {
        let (rules, yardstick, now) = (rules(context)?, self.yardstick.as_ref()?, self.at(percent)?);
        let deciding: Vec<Score> = match (self.at(HALF), rules, percent) {
            (Some(half), Rules::All, END) => vec![*half, *now],
            (Some(half), Rules::All, _) if !grows_late(context) => vec![*half, *now],
            (_, _, END) => vec![*now],
            _ => return None,
        };
        let one_time = same_time(&context.job.scene.warnings).is_some();
        // On the way only by clear margins: learning rates that fall at the end gain a decibel.
        let doubts = match percent {
            END => Doubts { any: one_time || self.doubts.iter().any(|d| matches!(d.subject, Subject::Poses | Subject::Times)), one_time },
            _ => Doubts::default(),
        };
        let when = match percent {
            END => format!("after {} iterations", context.lengths.total()),
            _ => format!("stopped at iteration {} of {} of the main stage, where", state.iteration, context.lengths.length(Stage::Main)),
        };
        let problem = match shortfall(&deciding, self.at(START).map(|s| s.psnr_db), &yardstick.baselines, rules, doubts)? {
            Shortfall::Images(words) => format!("{when} {words}"),
            Shortfall::Still(words) => {
                let remedy = format!(
                    "The main stage makes the scene worse: try lower learning rates (those of the deformer, train.lr), more iterations, or another deformer. {} = false \
                     accepts such models",
                    kept(context)
                );
                return Some(Error::failed("training", format!("{when} {words}"), remedy));
            }
            Shortfall::Motion(words) if state.moving == Moving::Nothing || state.deformer.as_ref().is_none_or(|d| d.field.is_static()) => {
                if percent == END {
                    let remedy = "the scene moves, and this run holds everything still. Choose a deformer and train.dynamic = \"auto\"";
                    context.job.events.emit(&Event::Warning { object: "deformer".into(), message: format!("{when} {words}: {remedy}") });
                }
                return None;
            }
            Shortfall::Motion(words) => format!("{when} {words}: the deformer does not follow the motion"),
        };
        Some(self.failure(context, problem))
    }
    /// The error of a run that is below a baseline, with the likely cause.
    fn failure(&self, context: &Context, problem: String) -> Error {
        let iterations = context.job.config.train.iterations;
        let kept = kept(context);
        match (self.doubts.first(), suspicion(&context.job.scene.warnings)) {
            (Some(doubt), _) => Error::failed("training", format!("{problem}. The likely cause: {}", doubt.problem), doubt.remedy.clone()),
            (None, Some(suspicion)) => {
                let remedy = format!("Correct the dataset, or train longer (train.iterations). {kept} = false accepts such models");
                Error::failed("training", format!("{problem}. {suspicion}"), remedy)
            }
            (None, None) => {
                let remedy = format!(
                    "Likely causes are wrong poses or axes, wrong times, another background than that of the images (render.background), or too few iterations: \
                     check the first three, then try train.iterations = {}. {kept} = false accepts such models",
                    3 * iterations
                );
                Error::failed("training", problem, remedy)
            }
        }
    }
}

/// The rules for the run of `context`, by the length that its main stage has now; `None` for runs that are not judged.
fn rules(context: &Context) -> Option<Rules> {
    rules_of(&context.job.config.train, &context.lengths, context.training_camera.len())
}

/// The rules for a run of so many cameras with stages of these `lengths`.
fn rules_of(train: &TrainConfig, lengths: &StageLengths, cameras: usize) -> Option<Rules> {
    Rules::of(lengths.total(), lengths.length(Stage::Main) * train.batch, cameras).filter(|_| train.checks)
}

/// Whether frames or pixels are still added at the score on the way, or were until shortly before it.
fn grows_late(context: &Context) -> bool {
    complete_at(&context.lengths, context.job.config.train.time_ramp) > context.lengths.scored_at(LATE)
}

/// The iteration of the main stage from which scores can be compared with later ones: all frames are there, which takes the share `time_ramp`, and images have
/// had their full size for a tenth of the stage.
fn complete_at(lengths: &StageLengths, time_ramp: f64) -> usize {
    let all_frames = lengths.schedule(Stage::Main, lengths.length(Stage::Main)).iteration_at(time_ramp) as usize;
    all_frames.max(lengths.grown_at())
}

/// How the sentence begins that says how to accept a model that has failed.
fn kept(context: &Context) -> &'static str {
    if context.checkpoint.is_some() { "The checkpoint is kept, and train.checks" } else { "train.checks" }
}

/// The reader's warning that all images state one time.
fn same_time(warnings: &[String]) -> Option<&String> {
    warnings.iter().find(|warning| warning.starts_with(SAME_TIME))
}

/// What the reader's warnings say about the cause of a failure: one time for all images is likely to be it, any other may be.
fn suspicion(warnings: &[String]) -> Option<String> {
    match same_time(warnings) {
        Some(warning) => Some(format!("The likely cause: {warning}")),
        None if warnings.is_empty() => None,
        None => Some(format!("The cause may be among what the reader warned of: {}", warnings.join("; "))),
    }
}

/// PSNR in dB of the validation views: those of `train.validation`, or else some of the reader's own. An image of the latter that cannot be read is a warning,
/// because nobody asked for it.
fn validation_psnr_db(context: &Context, state: &mut TrainState) -> Result<Option<f64>> {
    let asked = context.job.config.train.validation;
    let scene = &context.job.scene;
    let views = spread_views(scene, &scene.split(Split::Validation), if asked == 0 { VALIDATION_VIEWS } else { asked });
    if views.is_empty() {
        return Ok(None);
    }
    match scored(context, state, &views) {
        Err(error @ (Error::Data { .. } | Error::Io { .. })) if asked == 0 => {
            context.job.events.emit(&Event::Warning { object: "validation views".into(), message: format!("not scored: {error}") });
            Ok(None)
        }
        scored => scored.map(|s| Some(s.psnr_db)),
    }
}

/// Whole images of a model, means over views.
struct Whole {
    psnr_db: f64,
    /// Mean slope of the drawn images over that of the true ones.
    detail: f64,
    /// PSNR between the blurred images and the blurred truth.
    blurred_db: f64,
}

fn scored(context: &Context, state: &mut TrainState, views: &[usize]) -> Result<Whole> {
    let scene = &context.job.scene;
    let background = context.job.config.background()?;
    let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
    let (mut sum, mut sum_blurred, mut drawn_slope, mut true_slope) = (0.0, 0.0, 0.0, 0.0);
    let gaussians = state.set.gaussians()?;
    context.draw(state, &gaussians, &requests, gaussians.sh_degree, |index, image| {
        let image = to_vec(image, "drawn view")?;
        let camera = scene.camera(views[index]);
        let size = [camera.width, camera.height];
        let truth = scene.frame(views[index])?.to_planes(background);
        sum += psnr_db(&truth, &image, size, None)?;
        sum_blurred += psnr_db(&blurred(&truth, size), &blurred(&image, size), size, None)?;
        drawn_slope += slope(&image, camera.width as usize);
        true_slope += slope(&truth, camera.width as usize);
        Ok(())
    })?;
    let n = views.len().max(1) as f64;
    Ok(Whole { psnr_db: sum / n, detail: if true_slope > 0.0 { drawn_slope / true_slope } else { 1.0 }, blurred_db: sum_blurred / n })
}

/// Mean absolute difference of neighbours along the rows of planes.
fn slope(planes: &[f32], width: usize) -> f64 {
    let sum: f64 = planes.chunks_exact(width.max(1)).flat_map(|row| row.windows(2)).map(|pair| f64::from((pair[1] - pair[0]).abs())).sum();
    sum / planes.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_length_that_a_main_stage_has_decides_the_rules() {
        let rules = |iterations, stretch| {
            let train = TrainConfig { iterations, stretch, ..Default::default() };
            rules_of(&train, &StageLengths::new(&train, true, 1.0), 10)
        };
        assert_eq!((rules(280, 1.0), rules(280, 4.0), rules(330, 4.0)), (None, Some(Rules::Baselines), Some(Rules::All)));
        assert_eq!((rules(330, 0.7), rules(1120, 0.7), rules(1120, 1.0)), (None, Some(Rules::Baselines), Some(Rules::All)));
        let unchecked = TrainConfig { checks: false, ..Default::default() };
        assert_eq!(rules_of(&unchecked, &StageLengths::new(&unchecked, true, 1.0), 10), None);
    }

    #[test]
    fn no_warning_is_the_likely_cause_for_its_place_in_the_alphabet() {
        let of = |warnings: &[&str]| suspicion(&warnings.iter().map(ToString::to_string).collect::<Vec<_>>());
        let (missing, times) = ("3 of 9 images are missing", format!("{SAME_TIME}, 0"));
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[missing, "times are even"]).unwrap(), format!("The cause may be among what the reader warned of: {missing}; times are even"));
        assert_eq!(of(&[missing, &times]).unwrap(), format!("The likely cause: {times}"));
    }

    #[test]
    fn scores_count_once_frames_and_pixels_are_there() {
        // 2,000 iterations of the main stage are planned.
        let of = |image_growth, stretch| StageLengths::new(&TrainConfig { iterations: 2800, image_growth, stretch, ..Default::default() }, true, 1.0);
        let counts = |lengths: &StageLengths, percent, time_ramp| lengths.scored_at(percent) >= complete_at(lengths, time_ramp);
        assert!(counts(&of(0.0, 1.0), HALF, 0.5) && !counts(&of(0.0, 1.0), HALF, 0.6) && counts(&of(0.0, 1.0), LATE, 0.85));
        // A shorter stage has 83 % of its progress after 85 % of its iterations.
        assert!(!counts(&of(0.0, 0.7), LATE, 0.85) && counts(&of(0.0, 0.7), LATE, 0.83));
        for growth in [0.8, 0.82, 0.84, 1.0] {
            let (plain, longer) = (of(growth, 1.0), of(growth, 4.0));
            assert_eq!((counts(&plain, LATE, 0.0), counts(&longer, LATE, 0.0)), (growth < 1.0, growth < 1.0), "{growth}");
            assert!(plain.scored_at(LATE) >= plain.settles_at() && longer.scored_at(LATE) == 6800);
        }
        // Full size for a twentieth of the planned stage: too little, unless the stage is longer.
        assert!(!counts(&of(0.86, 1.0), LATE, 0.0) && counts(&of(0.86, 2.0), LATE, 0.0));
    }
}
