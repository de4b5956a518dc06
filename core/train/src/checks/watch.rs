//! Scores a model on its way and at its end, and decides whether the run has failed.

use super::baselines::{MovingPixels, Yardstick, psnr_db};
use super::verdict::{Evidence, Verdict};
use super::{Finding, Subject};
use crate::sample::spread;
use crate::train::{Context, Record, Score, TrainJob, TrainState};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Error, Event, Result, SAME_TIME, Schedule, Split, Stage};
use cc4dgs_play::Moving;

/// Shorter runs are not judged.
const LEAST_ITERATIONS: usize = 1000;
/// Runs whose main stage shows each training camera less often are not judged.
const LEAST_PASSES: usize = 5;
/// Where the main stage is scored on its way, percent; its end is scored too.
const HALF: usize = 50;
const LATE: usize = 85;
/// A score that is no failure whatever the baselines reach, dB: blurring hardly hurts images with little detail.
const GOOD_ENOUGH_DB: f64 = 30.0;
/// A field whose motion gains less than this on moving pixels, against its images of other times, does not follow the motion, dB.
const MOTION_GAIN_DB: f64 = 0.3;
/// What a model must gain on the blurred images where poses or times are in doubt, dB.
const DOUBT_MARGIN_DB: f64 = 3.0;

/// Follows one run.
pub(crate) struct Watch {
    doubts: Vec<Finding>,
    judged: bool,
    yardstick: Option<Yardstick>,
    scores: Vec<Score>,
}

impl Watch {
    /// Watches the run of `context`, whose scene raised `doubts`, from where `record` ends.
    pub fn new(context: &Context, doubts: Vec<Finding>, record: &Record) -> Self {
        let train = &context.job.config.train;
        let drawn = context.lengths.length(Stage::Main) * train.batch;
        let judged = train.checks && train.iterations >= LEAST_ITERATIONS && drawn >= LEAST_PASSES * context.training_camera.len();
        Self { doubts, judged, yardstick: None, scores: record.scores.clone() }
    }
    /// To be called after every iteration; scores the model at half and at 85 % of the main stage.
    pub fn after_iteration(&mut self, context: &Context, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        if !self.judged || schedule.stage != Stage::Main {
            return Ok(());
        }
        match [HALF, LATE].into_iter().find(|percent| schedule.iteration == schedule.length * percent / 100) {
            Some(percent) => {
                self.score(context, state, percent)?;
                state.record.scores.clone_from(&self.scores);
                Ok(())
            }
            None => Ok(()),
        }
    }
    /// The verdict of a finished run, as an event too; `None` for a run that is too short to be judged.
    ///
    /// # Errors
    /// [`Error::Failed`] for a model that is not better than what can be had without one.
    pub fn conclude(&mut self, context: &Context, state: &mut TrainState) -> Result<Option<Verdict>> {
        if !self.judged {
            return Ok(None);
        }
        self.score(context, state, 100)?;
        let (Some(yardstick), Some(end)) = (&self.yardstick, self.scores.last()) else { return Ok(None) };
        self.refuse_failure(context, state, yardstick)?;
        let cap = context.job.config.density.get("max_gaussians").and_then(toml::Value::as_integer).and_then(|cap| usize::try_from(cap).ok());
        let kept_out = spread(&context.job.scene.split(Split::Validation), context.job.config.train.validation);
        let validation = if kept_out.is_empty() { None } else { Some(scored(context, state, &kept_out, &mut 0.0)?) };
        // A static scene may well state one time for all images; it is no cause of anything while the model is good.
        let mut doubts = self.doubts.clone();
        if let Some(warning) = same_time(context.job).filter(|_| end.psnr_db < GOOD_ENOUGH_DB) {
            doubts.push(Finding::doubt(Subject::Times, warning.clone(), "Give each image its time"));
        }
        let verdict = Evidence {
            train_psnr_db: end.psnr_db,
            late_psnr_db: self.scores.iter().find(|s| s.percent == LATE).map(|s| s.psnr_db),
            validation_psnr_db: validation,
            moving_psnr_db: end.moving_db,
            detail: end.detail,
            gaussians: state.set.len(),
            cap,
            baselines: yardstick.baselines,
            doubts: &doubts,
            warnings: &context.job.scene.warnings,
        }
        .verdict();
        context.job.events.emit(&Event::Note { object: "verdict".into(), message: verdict.sentence.clone() });
        Ok(Some(verdict))
    }
    fn score(&mut self, context: &Context, state: &mut TrainState, percent: usize) -> Result<()> {
        let scene = &context.job.scene;
        let background = context.job.config.background()?;
        if self.yardstick.is_none() {
            self.yardstick = Some(Yardstick::new(scene, context.job.config.train.mask_threshold, background)?);
        }
        let Some(yardstick) = &self.yardstick else { return Ok(()) };
        let mut detail = 0.0;
        let psnr = scored(context, state, &yardstick.views, &mut detail)?;
        // Each moving view at its own time and, for comparison, a third and two thirds of the sequence later.
        let mut sums = [0.0; 3];
        let moving: &[MovingPixels] = if percent == LATE { &[] } else { &yardstick.moving };
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
        self.scores.push(Score { percent, psnr_db: psnr, moving_db: mean(sums[0]), frozen_db: mean(0.5 * (sums[1] + sums[2])), detail });
        Ok(())
    }
    /// Whether all scores that decide (half of the main stage and its end) are below a baseline.
    fn always(&self, below: impl Fn(&Score) -> bool) -> bool {
        self.scores.iter().filter(|s| s.percent != LATE).all(below)
    }
    fn refuse_failure(&self, context: &Context, state: &TrainState, yardstick: &Yardstick) -> Result<()> {
        let baselines = &yardstick.baselines;
        let Some(end) = self.scores.last() else { return Ok(()) };
        let reached = format!("after {} iterations training views reach {:.1} dB", context.job.config.train.iterations, end.psnr_db);
        if self.always(|s| s.psnr_db < baselines.mean_colour_db) {
            return Err(self.failure(context, format!("{reached}, less than the mean colour of each image ({:.1} dB)", baselines.mean_colour_db)));
        }
        let weak = self.always(|s| s.psnr_db < GOOD_ENOUGH_DB);
        if weak && self.always(|s| s.psnr_db < baselines.blur_db) {
            return Err(self.failure(context, format!("{reached}, less than the images blurred 16 times ({:.1} dB)", baselines.blur_db)));
        }
        let doubted = same_time(context.job).is_some() || self.doubts.iter().any(|d| matches!(d.subject, Subject::Poses | Subject::Times));
        if weak && doubted && end.psnr_db < baselines.blur_db + DOUBT_MARGIN_DB {
            let problem = format!("{reached}, hardly more than the images blurred 16 times ({:.1} dB)", baselines.blur_db);
            return Err(self.failure(context, problem));
        }
        let Some(mean_image) = baselines.mean_image_db else { return Ok(()) };
        let behind = |s: &Score| match (s.moving_db, s.frozen_db) {
            (Some(moving), Some(frozen)) => moving < mean_image.min(GOOD_ENOUGH_DB) && moving < frozen + MOTION_GAIN_DB,
            _ => false,
        };
        if !self.always(behind) {
            return Ok(());
        }
        let moving = end.moving_db.unwrap_or(f64::NAN);
        let problem = format!("pixels that move reach {moving:.1} dB, less than the mean image over time ({mean_image:.1} dB), and motion does not help");
        if state.moving == Moving::Nothing || state.deformer.as_ref().is_none_or(|d| d.field.is_static()) {
            let message = format!("{problem}: the scene moves, and this run holds everything still. Choose a deformer and train.dynamic = \"auto\"");
            context.job.events.emit(&Event::Warning { object: "deformer".into(), message });
            return Ok(());
        }
        Err(self.failure(context, format!("{problem}: the deformer does not follow the motion")))
    }
    /// The error of a run that is below a baseline, with the likely cause.
    fn failure(&self, context: &Context, problem: String) -> Error {
        let iterations = context.job.config.train.iterations;
        let scene = &context.job.scene;
        match (self.doubts.first(), scene.warnings.first()) {
            (Some(doubt), _) => Error::failed("training", format!("{problem}. The likely cause: {}", doubt.problem), doubt.remedy.clone()),
            (None, Some(warning)) => {
                let remedy = "Correct the dataset, or train longer (train.iterations). The checkpoint is kept, and train.checks = false accepts such models";
                Error::failed("training", format!("{problem}. The likely cause: {warning}"), remedy)
            }
            (None, None) => {
                let remedy = format!(
                    "Likely causes are wrong poses or axes, wrong times, another background than that of the images (render.background), or too few iterations: \
                     check the first three, then try train.iterations = {}. The checkpoint is kept, and train.checks = false accepts such models",
                    3 * iterations
                );
                Error::failed("training", problem, remedy)
            }
        }
    }
}

/// The reader's warning that all images state one time.
fn same_time<'a>(job: &'a TrainJob) -> Option<&'a String> {
    job.scene.warnings.iter().find(|warning| warning.starts_with(SAME_TIME))
}

/// Mean PSNR in dB of the model on `views`; `detail` becomes the mean slope of its images over that of the true ones.
fn scored(context: &Context, state: &mut TrainState, views: &[usize], detail: &mut f64) -> Result<f64> {
    let scene = &context.job.scene;
    let background = context.job.config.background()?;
    let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
    let (mut sum, mut drawn_slope, mut true_slope) = (0.0, 0.0, 0.0);
    let gaussians = state.set.gaussians()?;
    context.draw(state, &gaussians, &requests, gaussians.sh_degree, |index, image| {
        let image = to_vec(image, "drawn view")?;
        let camera = scene.camera(views[index]);
        let truth = scene.frame(views[index])?.to_planes(background);
        sum += psnr_db(&truth, &image, [camera.width, camera.height], None)?;
        drawn_slope += slope(&image, camera.width as usize);
        true_slope += slope(&truth, camera.width as usize);
        Ok(())
    })?;
    *detail = if true_slope > 0.0 { drawn_slope / true_slope } else { 1.0 };
    Ok(sum / views.len().max(1) as f64)
}

/// Mean absolute difference of neighbours along the rows of planes.
fn slope(planes: &[f32], width: usize) -> f64 {
    let sum: f64 = planes.chunks_exact(width.max(1)).flat_map(|row| row.windows(2)).map(|pair| f64::from((pair[1] - pair[0]).abs())).sum();
    sum / planes.len().max(1) as f64
}
