//! The search for the quality: the step factor that uses up an allowed loss or size.

use super::importance::{Importance, budget};
use super::job::{Attempt, Job};
use super::settings::Settings;
use super::tune::{self, Goal, Tuned, Untuned};
use super::{allocate, bytes_of};
use cc4dgs_format::{CodecContext, Error, Event, HostGaussians, RenderModel, Result, Stream, TrainingViews, WeightArray, psnr_on_views};
use std::ops::RangeInclusive;

/// Views that judge ([`CodecContext::judging_views`]) on which the loss is measured, by [`budget`].
const VIEWS: RangeInclusive<usize> = 8..=16;
const WORK: usize = 3_000_000;
/// Attempts of a search, at most.
const ATTEMPTS: usize = 8;
/// Parameters of a Gaussian that are not rounded to zero, for the estimate of the error.
const PARAMETERS: f64 = 20.0;
/// Shares of an allowance that are good enough: before the steps of the columns are corrected, and at the end. A search that ends with less than the first is
/// warned of.
const ROUGH: f64 = 0.8;
const GOOD: f64 = 0.97;
/// The share that attempts aim at.
const AIM: f64 = 0.985;
/// Octaves of the step factor by which attempts differ, at most, and the share of a known interval that they stay away from its ends.
const FARTHEST: f64 = 2.0;
const MARGIN: f64 = 0.08;
/// A loss in dB that is left after fine-tuning, for which the steps of the columns are corrected.
const TUNED: f64 = 0.1;
/// Least share from which a loss is extrapolated: smaller ones are noise.
const LEAST: f64 = 0.05;

/// The root-mean-square error of a value's contribution to images that gives the estimated `psnr_db`.
pub fn estimate(psnr_db: f64, importance: &Importance) -> f64 {
    let error = libm::pow(10.0, -0.1 * psnr_db) * importance.samples;
    (12.0 * error / (PARAMETERS * importance.weights.len().max(1) as f64)).sqrt()
}

/// What attempts use up.
enum Allowance<'a> {
    /// Bytes of the file ([`file_bytes`]). Larger steps use fewer.
    Bytes { limit: f64, context: &'a CodecContext<'a> },
    /// PSNR on the views that judge, in dB below `before`. Larger steps lose more.
    Drop { before: f64, limit: f64, judges: &'a dyn TrainingViews, renderer: &'a dyn RenderModel, chosen: usize },
}

impl Allowance<'_> {
    /// An attempt with what it uses, as a share of what is allowed. It is coded only where bytes are allowed.
    fn tried(&self, job: &Job, quality: f64) -> Result<Tried> {
        match self {
            Self::Bytes { limit, context } => {
                let (attempt, streams) = job.coded(&job.planner, quality, &job.factors)?;
                Ok(Tried { attempt, share: file_bytes(context, &streams, None)? / limit, streams: Some(streams), last: false })
            }
            Self::Drop { before, limit, judges, renderer, chosen } => {
                let (attempt, rounded) = job.attempt(quality)?;
                let share = (before - psnr_on_views(&rounded, *judges, *renderer, *chosen)?) / limit;
                Ok(Tried { attempt, share, streams: None, last: false })
            }
        }
    }
    /// Octaves from the step factor of an attempt with so many Gaussians to the one that is expected to use [`AIM`].
    fn octaves(&self, gaussians: usize, share: f64) -> f64 {
        match self {
            // An octave of all steps is a bit of every value that is not zero.
            Self::Bytes { limit, .. } => (share - AIM) * limit / (PARAMETERS / 8.0 * gaussians.max(1) as f64),
            // Squared errors of images, small beside what a model leaves, add to the loss in proportion.
            Self::Drop { .. } => 0.5 * libm::log2(AIM / share.max(LEAST)),
        }
    }
    /// 1 where larger steps use more, else -1.
    fn direction(&self) -> f64 {
        if matches!(self, Self::Bytes { .. }) { -1.0 } else { 1.0 }
    }
}

/// An attempt and the share of the allowance that it uses.
struct Tried {
    attempt: Attempt,
    share: f64,
    /// Where it was coded.
    streams: Option<Vec<Stream>>,
    /// Whether no attempt was left when it was chosen, none was good enough, and another might be better: a size may be more than the finest steps fill.
    last: bool,
}

impl Tried {
    fn allowed(&self) -> bool {
        self.share <= 1.0
    }
    fn coded(&mut self, job: &Job) -> Result<Vec<Stream>> {
        self.streams.take().map_or_else(|| job.streams(job.planner.gaussians, &self.attempt.plan), Ok)
    }
}

/// The attempt that uses most of what is allowed, from the step factor `start`; the one that uses least if none is allowed. A share of `good` ends the search.
/// `first` is the attempt at `start`, where it has been made before.
fn seek(job: &Job, start: f64, mut first: Option<Tried>, allowance: &Allowance, good: f64) -> Result<Tried> {
    let direction = allowance.direction();
    // Octaves over `start` in the direction in which more is used.
    let (mut at, mut refused) = (0.0, f64::INFINITY);
    let mut best: Option<(f64, Tried)> = None;
    let mut least = None;
    for _ in 0..ATTEMPTS {
        let tried = first.take().map_or_else(|| allowance.tried(job, start * libm::exp2(direction * at)), Ok)?;
        let step = direction * allowance.octaves(job.planner.gaussians.len(), tried.share);
        if tried.allowed() {
            if tried.share >= good {
                return Ok(tried);
            }
            if best.as_ref().is_none_or(|(known, _)| at > *known) {
                best = Some((at, tried));
            }
        } else {
            refused = refused.min(at);
            least = least.filter(|known: &Tried| known.share <= tried.share).or(Some(tried));
        }
        let next = at + step.clamp(-FARTHEST, FARTHEST);
        at = match &best {
            Some((known, _)) if refused > *known && refused.is_finite() => {
                let margin = MARGIN * (refused - known);
                next.clamp(known + margin, refused - margin)
            }
            Some((known, _)) => next.max(known + MARGIN),
            None => next.min(refused - MARGIN),
        };
    }
    match best.map(|(_, tried)| tried).or(least) {
        Some(tried) => Ok(Tried { last: refused.is_finite() || matches!(allowance, Allowance::Drop { .. }), ..tried }),
        None => Err(Error::backend("codec compact", "no step factor was tried", "Report this")),
    }
}

/// The streams that the settings ask for.
pub fn search(job: &mut Job, settings: &Settings, context: &CodecContext) -> Result<Vec<Stream>> {
    let (gaussians, start) = (job.planner.gaussians, estimate(settings.psnr_db, job.planner.importance));
    let object = "codec compact";
    if context.tuner.is_none() && !gaussians.is_empty() {
        settings.check_without_tuner()?;
    }
    let services = context.views.filter(|v| !v.is_empty()).zip(context.renderer).filter(|_| !gaussians.is_empty());
    if services.is_none() && !gaussians.is_empty() {
        settings.check_without_views()?;
    }
    let by_size = settings.max_size_mb > 0.0;
    if !by_size && (services.is_none() || settings.max_drop_db <= 0.0) {
        return Ok(job.coded(&job.planner, start, &job.factors)?.1);
    }
    // Renderers take `HostGaussians`; this copy is made once.
    let whole = services.map(|_| gaussians.to_host());
    let services = services.zip(whole.as_ref());
    let allowance = match services {
        Some(((views, renderer), whole)) if !by_size => {
            let judges = context.judging_views().unwrap_or(views);
            let chosen = judges.len().min(budget(WORK, gaussians.len(), VIEWS));
            let before = psnr_on_views(whole, judges, renderer, chosen)?;
            Allowance::Drop { before, limit: settings.max_drop_db, judges, renderer, chosen }
        }
        _ => Allowance::Bytes { limit: bytes_of_file(settings, context)?, context },
    };
    let tuner = context.tuner.filter(|_| settings.finetune > 0 && services.is_some());
    let caution = tuner.filter(|_| !settings.finetune_wanted).map(|t| t.caution()).transpose()?.flatten();
    if let Some(why) = &caution {
        let message = format!("the model is not fine-tuned: {why}. --set finetune={} does it all the same", settings.finetune);
        context.events.emit(&Event::Warning { object: object.into(), message });
    }
    let tuner = tuner.filter(|_| caution.is_none());
    let directions = job.directions;
    if tuner.is_some() {
        // Training learns which coefficients matter, and starts from steps of coefficients by themselves.
        job.directions = None;
    }
    let corrected = services.filter(|_| settings.allocate);
    let mut found = seek(job, start, None, &allowance, if corrected.is_some() { ROUGH } else { GOOD })?;
    let mut streams = found.coded(job)?;
    if let Some(((views, renderer), whole)) = corrected {
        let plain = job.factors;
        // Where a size is allowed, more is lost before fine-tuning than after it.
        let fewer = tuner.is_some() && matches!(allowance, Allowance::Bytes { .. });
        let judges = context.judging_views().unwrap_or(views);
        let quality = found.attempt.quality * if fewer { fine(job, &found.attempt, whole, judges, renderer)? } else { 1.0 };
        let known = job.repeats(&found.attempt, quality, &[1.0; 6]).then(|| (&found.attempt.plan, bytes_of(&streams)));
        job.factors = allocate::allocate(job, quality, known, whole, views, renderer)?;
        note(context, format!("steps of means, log-scales, quaternions, opacities, degree 0 and higher degrees times {:.2?}", job.factors));
        let mut second = seek(job, found.attempt.quality, None, &allowance, GOOD)?;
        let coded = second.coded(job)?;
        // The corrections may be worth nothing in small models.
        let worse = matches!(allowance, Allowance::Drop { .. }) && bytes_of(&coded) >= bytes_of(&streams);
        if found.allowed() && (worse || !second.allowed()) {
            job.factors = plain;
            // It was good enough to be corrected.
            if found.share < GOOD {
                let start = found.attempt.quality;
                let first = Some(Tried { streams: Some(streams), ..found }).filter(|found| job.repeats(&found.attempt, start, &plain));
                found = seek(job, start, first, &allowance, GOOD)?;
                streams = found.coded(job)?;
            }
        } else {
            (found, streams) = (second, coded);
        }
    }
    let goal = match &allowance {
        Allowance::Bytes { limit, .. } => Goal::Bytes(*limit),
        Allowance::Drop { limit, .. } => Goal::Drop(*limit),
    };
    if let Some(tuner) = tuner {
        let untuned = Untuned { attempt: &found.attempt, streams: &streams, allowed: found.allowed() };
        match tune::tune(job, &untuned, &goal, settings, tuner, context)? {
            Tuned::Better(streams) => return Ok(streams),
            Tuned::Nearest { streams: tuned, used } => (found.share, streams) = (used / goal.limit(), tuned),
            Tuned::Nothing { lost } => {
                // It was measured on more views, and with the deformer's weights as they are stored.
                if let Goal::Drop(limit) = goal {
                    found.share = found.share.max(lost / limit);
                }
                // Training was what colours were rounded apart for.
                if directions.is_some() {
                    job.directions = directions;
                    let mut joint = seek(job, found.attempt.quality, None, &allowance, GOOD)?;
                    let coded = joint.coded(job)?;
                    if let Goal::Drop(limit) = goal {
                        let rounded = job.restored(gaussians, &joint.attempt.plan);
                        joint.share = joint.share.max(tune::loss(tuner, gaussians, &rounded)? / limit);
                    }
                    let better = match (joint.allowed(), found.allowed()) {
                        // In the same bytes, colours that are rounded together are nearer.
                        (true, true) => matches!(goal, Goal::Bytes(_)) || bytes_of(&coded) < bytes_of(&streams),
                        (false, false) => joint.share < found.share,
                        (fits, _) => fits,
                    };
                    if better {
                        (found, streams) = (joint, coded);
                    }
                }
            }
        }
    }
    report(&found, bytes_of(&streams), &allowance, start, settings, context)?;
    Ok(streams)
}

/// A factor of the steps of `attempt` with which about [`TUNED`] is lost; 1 if less is lost already.
fn fine(job: &Job, attempt: &Attempt, whole: &HostGaussians, judges: &dyn TrainingViews, renderer: &dyn RenderModel) -> Result<f64> {
    let chosen = judges.len().min(budget(WORK, whole.len(), VIEWS));
    let rounded = job.restored(job.planner.gaussians, &attempt.plan);
    let lost = psnr_on_views(whole, judges, renderer, chosen)? - psnr_on_views(&rounded, judges, renderer, chosen)?;
    Ok(if lost > TUNED { (TUNED / lost).sqrt() } else { 1.0 })
}

/// The bytes of the file with `streams`, and with other weights of the deformer where they are given; of the streams alone where nothing else is known.
pub fn file_bytes(context: &CodecContext, streams: &[Stream], weights: Option<(&[WeightArray], f64)>) -> Result<f64> {
    Ok(context.file_bytes.map_or(Ok(bytes_of(streams) as u64), |of| of(streams, weights))? as f64)
}

/// The allowed bytes of the file, if there is room for Gaussians.
fn bytes_of_file(settings: &Settings, context: &CodecContext) -> Result<f64> {
    let limit = 1e6 * settings.max_size_mb;
    let rest = context.file_bytes.map_or(Ok(0), |of| of(&[], None))? as f64;
    if rest < limit {
        return Ok(limit);
    }
    let problem = format!("{} MB are allowed, and header and weights of the deformer take {:.4} MB", settings.max_size_mb, rest / 1e6);
    Err(Error::parameter("codec compact.max_size_mb", problem, "Allow more, or store the weights in fewer bits, such as --field-weights compact:bits=6"))
}

/// Says what was chosen, whose Gaussians take so many `bytes`, and whether attempts were left; a loss or size over what the user allowed is an error.
fn report(found: &Tried, bytes: usize, allowance: &Allowance, start: f64, settings: &Settings, context: &CodecContext) -> Result<()> {
    let object = "codec compact";
    let (megabytes, steps) = (bytes as f64 / 1e6, found.attempt.quality / start);
    let ended = if found.last { format!("; the search ended after {ATTEMPTS} attempts") } else { String::new() };
    if found.last && found.allowed() && found.share < ROUGH {
        let used = format!("the search ended after {ATTEMPTS} attempts and uses {:.0} % of what is allowed", 100.0 * found.share.max(0.0));
        let message = format!("{used}: there may be a better file, which a bound that is a little different may find");
        context.events.emit(&Event::Warning { object: object.into(), message });
    }
    match allowance {
        Allowance::Bytes { limit, .. } if !found.allowed() => {
            let problem = format!("the smallest file it reached has {:.0} bytes, {bytes} of them of Gaussians", found.share * limit);
            return Err(Error::parameter(object, problem, "Allow more, or remove Gaussians with `cc4dgs prune`"));
        }
        Allowance::Bytes { limit, .. } => {
            let file = found.share * limit / 1e6;
            let allowed = settings.max_size_mb;
            note(
                context,
                format!("{megabytes:.4} MB of Gaussians, {file:.4} MB in all ({allowed} MB allowed), steps {steps:.3} times the estimated ones{ended}"),
            );
        }
        Allowance::Drop { limit, judges, chosen, .. } => {
            let (drop, kind) = (found.share * limit, judges.kind());
            if !found.allowed() {
                let problem = format!("the best of all attempts loses {drop:.3} dB on {kind} views, {limit} dB are allowed");
                if settings.drop_wanted {
                    let remedy = "Allow more, store the deformer's weights in more bits, give more iterations of fine-tuning, or choose compact:psnr=70dB";
                    return Err(Error::parameter(object, problem, remedy));
                }
                context.events.emit(&Event::Warning { object: object.into(), message: problem });
            }
            note(
                context,
                format!(
                    "{megabytes:.4} MB of Gaussians, PSNR {drop:.3} dB lower on {chosen} {kind} views ({limit} dB allowed), steps {steps:.3} times the estimated ones{ended}"
                ),
            );
        }
    }
    Ok(())
}

pub fn note(context: &CodecContext, message: String) {
    context.events.emit(&Event::Note { object: "codec compact".into(), message });
}
