//! The search for the quality that uses up an allowed size, loss or difference of images, with its corrections and fine-tuning.

use super::images::{Images, Recorded};
use super::importance::{Importance, budget};
use super::job::{Attempt, Job};
use super::seek::{Allowance, GOOD, PARAMETERS, ROUGH, Tried, seek};
use super::settings::Settings;
use super::tune::{self, Goal, Tuned, Untuned};
use super::{allocate, bytes_of};
use cc4dgs_format::{CodecContext, Error, Event, HostGaussians, RenderModel, Result, Stream, TrainingViews, WeightArray, psnr_of, psnr_on_views};
use std::ops::RangeInclusive;

/// Views on which the loss is measured, by [`budget`]: those that judge ([`CodecContext::judging_views`]), or all where images before and after are compared.
const VIEWS: RangeInclusive<usize> = 8..=16;
const WORK: usize = 3_000_000;
/// A loss in dB that is left after fine-tuning, for which the steps of the columns are corrected.
const TUNED: f64 = 0.1;

/// The root-mean-square error of a value's contribution to images that gives the estimated `psnr_db`.
pub fn estimate(psnr_db: f64, importance: &Importance) -> f64 {
    let error = libm::pow(10.0, -0.1 * psnr_db) * importance.samples;
    (12.0 * error / (PARAMETERS * importance.weights.len().max(1) as f64)).sqrt()
}

/// The streams that the settings ask for.
pub fn search(job: &mut Job, settings: &Settings, context: &CodecContext) -> Result<Vec<Stream>> {
    let (gaussians, start) = (job.planner.gaussians, estimate(settings.psnr_db, job.planner.importance));
    let object = "codec compact";
    if context.tuner.is_none() && !gaussians.is_empty() {
        settings.check_without_tuner()?;
    }
    let services = context.views.filter(|v| !v.is_empty()).zip(context.renderer).filter(|_| !gaussians.is_empty());
    let has_images = services.is_some() && context.judging_views().is_some_and(TrainingViews::has_images);
    if !has_images && !gaussians.is_empty() {
        settings.check_without_views()?;
    }
    let by_size = settings.max_size_mb > 0.0;
    if !by_size && services.is_none() {
        return Ok(job.coded(&job.planner, start, &job.factors)?.1);
    }
    // Renderers take `HostGaussians`; this copy is made once.
    let whole = services.map(|_| gaussians.to_host());
    let services = services.zip(whole.as_ref());
    let allowance = match services {
        Some(((views, renderer), whole)) if !by_size => {
            let judges = context.judging_views().unwrap_or(views);
            let by_drop = settings.max_drop_db > 0.0 && has_images;
            let of = if by_drop { judges } else { views };
            let chosen = of.len().min(budget(WORK, gaussians.len(), VIEWS));
            if by_drop {
                let recorded = Recorded::of(judges, renderer, chosen)?;
                Allowance::Drop { before: recorded.psnr(whole.clone())?, limit: settings.max_drop_db, recorded }
            } else {
                let images = Images::of(whole, views, renderer, chosen)?;
                if images.show_nothing(renderer.background()) {
                    let problem = format!("{chosen} {} views show nothing but the background, so no difference between images can be measured", views.kind());
                    return Err(Error::parameter(object, problem, "Leave --orbit or --scene out, or bound the size: compact:max-size=5MB"));
                }
                Allowance::Difference { limit: libm::pow(10.0, -0.1 * settings.psnr_db), images, kind: views.kind() }
            }
        }
        _ => Allowance::Bytes { limit: allowed_bytes(settings, context)?, context },
    };
    let tunes = settings.finetune > 0 && has_images && !matches!(allowance, Allowance::Difference { .. });
    let tuner = context.tuner.filter(|_| tunes);
    let caution = tuner.filter(|_| !settings.finetune_wanted).map(|t| t.caution()).transpose()?.flatten();
    if let Some(why) = &caution {
        let message = format!("the model is not fine-tuned: {why}. --set finetune={} does it all the same", settings.finetune);
        context.events.emit(&Event::Warning { object: object.into(), message });
    }
    let tuner = tuner.filter(|_| caution.is_none());
    let directions = job.directions;
    if tuner.is_some() {
        // Training learns which coefficients matter, and starts from independently rounded coefficients.
        job.directions = None;
    }
    let corrected = services.filter(|_| settings.allocate);
    let mut found = seek(job, start, None, &allowance, if corrected.is_some() { ROUGH } else { GOOD })?;
    let mut streams = found.coded(job)?;
    if let Some(((views, renderer), whole)) = corrected {
        let plain = job.factors;
        // For a bounded size, the loss before fine-tuning is larger than after it.
        let fewer = tuner.is_some() && allowance.is_of_bytes();
        let judges = context.judging_views().unwrap_or(views);
        let quality = found.attempt.quality * if fewer { fine(job, &found.attempt, whole, judges, renderer)? } else { 1.0 };
        let known = job.repeats(&found.attempt, quality, &[1.0; 6]).then(|| (&found.attempt.plan, bytes_of(&streams)));
        job.factors = allocate::allocate(job, quality, known, whole, views, renderer)?;
        note(context, format!("steps of means, log-scales, quaternions, opacities, degree 0 and higher degrees times {:.2?}", job.factors));
        let mut second = seek(job, found.attempt.quality, None, &allowance, GOOD)?;
        let coded = second.coded(job)?;
        // In small models the corrections may save nothing.
        let saves = allowance.is_of_bytes() || bytes_of(&coded) < bytes_of(&streams);
        if plain_is_better(found.share, second.share, saves) {
            job.factors = plain;
            // The first search ended at `ROUGH`; without corrections it goes on to `GOOD`.
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
        Allowance::Bytes { limit, .. } => Some(Goal::Bytes(*limit)),
        Allowance::Drop { limit, .. } => Some(Goal::Drop(*limit)),
        Allowance::Difference { .. } => None,
    };
    if let Some((tuner, goal)) = tuner.zip(goal) {
        let untuned = Untuned { attempt: &found.attempt, streams: &streams, allowed: found.allowed() };
        match tune::tune(job, &untuned, &goal, settings, tuner, context)? {
            Tuned::Better(streams) => return Ok(streams),
            Tuned::Nearest { streams: tuned, used } => (found.share, streams) = (used / goal.limit(), tuned),
            Tuned::Nothing { lost } => {
                // The loss without training, measured on more views and with the deformer's weights as they are stored.
                if let Goal::Drop(limit) = goal {
                    found.share = found.share.max(lost / limit);
                }
                // Colours were rounded independently for training only.
                if directions.is_some() {
                    job.directions = directions;
                    let mut joint = seek(job, found.attempt.quality, None, &allowance, GOOD)?;
                    let coded = joint.coded(job)?;
                    if let Goal::Drop(limit) = goal {
                        let rounded = job.restored(gaussians, &joint.attempt.plan);
                        joint.share = joint.share.max(tune::loss(tuner, gaussians, &rounded)? / limit);
                    }
                    let better = match (joint.allowed(), found.allowed()) {
                        // In the same number of bytes, joint rounding has smaller errors.
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

/// Whether the best attempt without corrections of the columns is better than the best one with them. `plain` and `corrected` are the shares of the allowance
/// that they use. `saves` says whether the corrections save bytes; it is true where bytes are bounded. If both use too much, the smaller share is better.
fn plain_is_better(plain: f64, corrected: f64, saves: bool) -> bool {
    match (plain <= 1.0, corrected <= 1.0) {
        (true, fits) => !(fits && saves),
        (false, true) => false,
        (false, false) => plain <= corrected,
    }
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

/// The allowed bytes of the file; an error where header and weights alone have as many.
fn allowed_bytes(settings: &Settings, context: &CodecContext) -> Result<f64> {
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
    let ended = found.ended.map(|attempts| format!("; the search ended after {attempts} attempts")).unwrap_or_default();
    if let Some(attempts) = found.ended.filter(|_| found.allowed() && found.share < ROUGH) {
        let used = format!("the search ended after {attempts} attempts and uses {:.0} % of what is allowed", 100.0 * found.share.max(0.0));
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
        Allowance::Drop { limit, recorded, .. } => {
            let (drop, kind, chosen) = (found.share * limit, recorded.kind, recorded.len());
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
        Allowance::Difference { limit, images, kind } => {
            let (reached, wanted, views) = (psnr_of(found.share * limit), psnr_of(*limit), images.len());
            if !found.allowed() {
                let problem = format!("the images of the best of all attempts have {reached:.2} dB against those before, {wanted:.2} dB are wanted");
                if settings.psnr_wanted {
                    return Err(Error::parameter(object, problem, "Choose a lower PSNR, such as compact:psnr=45dB, or the codec raw"));
                }
                context.events.emit(&Event::Warning { object: object.into(), message: problem });
            }
            let weights = if context.deformer.is_some() { ", the deformer's weights not counted" } else { "" };
            let between = format!("PSNR {reached:.2} dB between images before and after on {views} {kind} views ({wanted:.2} dB wanted{weights})");
            note(context, format!("{megabytes:.4} MB of Gaussians, {between}, steps {steps:.3} times the estimated ones{ended}"));
        }
    }
    Ok(())
}

pub fn note(context: &CodecContext, message: String) {
    context.events.emit(&Event::Note { object: "codec compact".into(), message });
}

#[cfg(test)]
mod tests {
    use super::plain_is_better;

    #[test]
    fn of_two_that_use_too_much_the_nearer_is_taken() {
        for (plain, corrected, saves, taken) in [
            (0.9, 0.99, true, false),
            (0.9, 0.99, false, true),
            (0.9, 1.1, true, true),
            (1.1, 0.9, false, false),
            (1.05, 1.5, true, true),
            (1.5, 1.05, false, false),
            (f64::NAN, 1.5, true, false),
        ] {
            assert_eq!(plain_is_better(plain, corrected, saves), taken, "{plain} and {corrected}");
        }
    }
}
