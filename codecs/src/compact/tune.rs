//! Fine-tuning: rounds of training with rounded values, each in the steps that those before suggest.
//!
//! Training compensates for rounding errors, so larger steps keep the same PSNR. Each round chooses steps, trains with them and measures what is lost. The
//! best file that keeps what is allowed is taken; if there is none, the one that needed no training.

use super::bytes_of;
use super::columns::Columns;
use super::encode::make_canonical;
use super::forecast::Forecast;
use super::job::{Attempt, Job};
use super::plan::Planner;
use super::rounding::Rounder;
use super::search::{file_bytes, note};
use super::settings::Settings;
use cc4dgs_format::{CodecContext, Error, Event, HostGaussians, Result, Stream, TuneModel, TunedModel, Tuning, WeightArray};

/// Rounds of training, and how many follow at most while the last one has not kept what is allowed.
const ROUNDS: usize = 5;
const FURTHER: usize = 2;
/// The most octaves by which the steps of the first round are larger than those that need no training, where a loss is allowed.
const FIRST: f64 = 2.0;
/// Octaves by which the steps of two rounds differ, at most.
const FARTHEST: f64 = 1.0;
/// Standard deviations by which a round may lose more than expected: of all but the last, of the last if fine-tuning has a file that keeps what is allowed, and
/// if it has none.
const CAUTION: [f64; 3] = [0.5, 0.5, 1.0];
/// The share of an allowed size that rounds aim at, and that of an allowed loss that those which follow the planned ones do.
const SIZE_AIM: f64 = 0.99;
const DROP_AIM: f64 = 0.8;
/// Octaves by which steps of the deformer's weights grow to measure what they cost, and the least loss in dB that counts then: smaller ones are noise.
const PROBED: f64 = 2.0;
const LEAST_PROBED: f64 = 0.01;
/// The most of [`weight_octaves`], up and down.
const WEIGHTS_FARTHEST: f64 = 2.0;

/// What is allowed.
pub enum Goal {
    /// A loss of PSNR in dB; the fewest bytes are best.
    Drop(f64),
    /// Bytes of the file; the highest PSNR is best.
    Bytes(f64),
}

/// The result of fine-tuning.
pub enum Tuned {
    /// Streams that are better than those without training.
    Better(Vec<Stream>),
    /// No streams keep what is allowed, with or without training. These use least of what is bounded.
    Nearest { streams: Vec<Stream>, used: f64 },
    /// Nothing better: those without training lose `lost` dB of PSNR.
    Nothing { lost: f64 },
}

/// The result without training.
pub struct Untuned<'a> {
    pub attempt: &'a Attempt,
    pub streams: &'a [Stream],
    /// Whether it uses no more than what is allowed.
    pub allowed: bool,
}

/// The result of a round.
struct Outcome {
    streams: Vec<Stream>,
    model: TunedModel,
    weight_steps: f64,
    /// Bytes with the deformer's weights.
    bytes: usize,
    /// PSNR in dB below that of the model before compression.
    drop: f64,
    /// What it uses of what the goal bounds: dB or bytes of the whole file.
    used: f64,
}

impl Goal {
    /// The dB or bytes that are allowed.
    pub fn limit(&self) -> f64 {
        let (Self::Drop(limit) | Self::Bytes(limit)) = self;
        *limit
    }
    fn is_better(&self, outcome: &Outcome, bytes: usize, drop: f64) -> bool {
        let better = match self {
            Self::Drop(_) => outcome.bytes < bytes,
            Self::Bytes(_) => outcome.drop < drop,
        };
        better && outcome.used <= self.limit()
    }
}

/// The best streams that `goal` allows, after training; `found` is the result without. A round that fails is the last; the results of earlier rounds are kept.
pub fn tune(job: &Job, found: &Untuned, goal: &Goal, settings: &Settings, tuner: &dyn TuneModel, context: &CodecContext) -> Result<Tuned> {
    let megabytes = |bytes: usize| bytes as f64 / 1e6;
    let gaussians = job.planner.gaussians;
    let mut model = tuner.start(&gaussians.to_host())?;
    let before = tuner.psnr(&model.gaussians, &model.weights, None)?;
    let untuned = before - tuner.psnr(&job.restored(gaussians, &found.attempt.plan), &model.weights, Some(1.0))?;
    let first_weights = weight_bytes(tuner, &model.weights, 1.0)?;
    let first_bytes = bytes_of(found.streams) + first_weights;
    note(context, format!("without fine-tuning {:.4} MB with the deformer's weights, PSNR {untuned:.3} dB lower", megabytes(first_bytes)));
    // Weights are rounded too, and the loss was measured on fewer views before.
    let (allowed, first_used) = match goal {
        Goal::Drop(limit) => (found.allowed && untuned <= *limit, untuned),
        Goal::Bytes(_) => (found.allowed, file_bytes(context, found.streams, None)?),
    };
    let shares = rounds(settings.finetune);
    let count = shares.len();
    let per_round = settings.finetune as f64 / count.max(1) as f64;
    // Rounded weights may make the loss larger than what is allowed.
    let mut forecast = Forecast::new(untuned.max(if let Goal::Drop(limit) = goal { *limit } else { 0.0 }), per_round);
    // Steps are planned for the last round but one, whose file is safe, and then for the last.
    let planned = |forecast: &Forecast, limit: f64, done: usize, kept: bool| {
        let (last, caution) = match (done + 1 < count, kept) {
            (true, _) => (count - 1, CAUTION[0]),
            (false, kept) => (count, CAUTION[if kept { 1 } else { 2 }]),
        };
        forecast.octaves(last, limit, caution)
    };
    let per_octave = saved_by_doubling(job, &job.planner, found.attempt.quality, bytes_of(found.streams))?;
    let saved = saved_weights(tuner, &model.weights, 1.0, first_weights)?;
    let of_weights = weight_octaves(tuner, &model, (before, untuned), (per_octave, saved))?;
    let mut octaves = match goal {
        Goal::Drop(limit) => planned(&forecast, *limit, 0, false).clamp(0.0, FIRST),
        Goal::Bytes(limit) => {
            let steps = libm::exp2(of_weights);
            let weights = weight_bytes(tuner, &model.weights, steps)?;
            let file = first_used - first_weights as f64 + weights as f64;
            ((file - SIZE_AIM * limit) / (per_octave + saved_weights(tuner, &model.weights, steps, weights)?)).clamp(-FIRST, FIRST)
        }
    };
    // The result of a round, and the bytes that an octave of its steps saves.
    let train = |model: &TunedModel, round: usize, octaves: f64| -> Result<(Outcome, f64)> {
        let quality = found.attempt.quality * libm::exp2(octaves);
        let weight_steps = libm::exp2(octaves + of_weights);
        let planner = job.planner.of(Columns::from(&model.gaussians));
        let (Attempt { plan, .. }, untrained) = job.coded(&planner, quality, &job.factors)?;
        let per_octave = saved_by_doubling(job, &planner, quality, bytes_of(&untrained))?;
        let bits_per_octave = 8.0 * per_octave;
        let rounding = &Rounder { plan: &plan, free: &job.free, classes: job.planner.classes };
        // Rounds beyond the planned ones are as long as the last planned one.
        let share = |round: usize| shares[round.min(count - 1)];
        let (iterations, done) = (share(round), (0..round).map(share).sum::<usize>());
        let of = (done, settings.finetune.max(done + iterations));
        let seed = context.seed.child("fine-tuning").index(round as u64);
        let mut model = tuner.tune(model, &Tuning { rounding, weight_steps, iterations, of, seed, size_weight: settings.size_weight, bits_per_octave })?;
        make_canonical(&mut model.gaussians.log_scales, &mut model.gaussians.quaternions, &job.free);
        let (streams, rounded) = job.stored(Columns::from(&model.gaussians), &plan)?;
        let drop = before - tuner.psnr(&rounded, &model.weights, Some(weight_steps))?;
        let weights = weight_bytes(tuner, &model.weights, weight_steps)?;
        let bytes = bytes_of(&streams) + weights;
        let (number, steps, gaussians) = (round + 1, libm::exp2(octaves), megabytes(bytes_of(&streams)));
        note(
            context,
            format!(
                "fine-tuning {number}: steps {steps:.2} times larger, of weights {weight_steps:.2}, {gaussians:.4} MB of Gaussians, {:.4} MB in all, PSNR {drop:.3} dB lower",
                megabytes(bytes)
            ),
        );
        let (used, saved) = match goal {
            Goal::Drop(_) => (drop, 0.0),
            Goal::Bytes(_) => {
                let file = file_bytes(context, &streams, Some((&model.weights, weight_steps)))?;
                // Only another round needs the saved bytes.
                let goes_on = number < count || (file > goal.limit() && number < count + FURTHER);
                (file, if goes_on { saved_weights(tuner, &model.weights, weight_steps, weights)? } else { 0.0 })
            }
        };
        Ok((Outcome { streams, model, weight_steps, bytes, drop, used }, per_octave + saved))
    };
    let (mut best, mut nearest): (Option<Outcome>, Option<Outcome>) = (None, None);
    let mut missed = true;
    for round in 0..count + FURTHER {
        if round >= count && !missed {
            break;
        }
        let (outcome, per_octave) = match train(&model, round, octaves) {
            Err(e) if !matches!(e, Error::Interrupted(_)) => {
                let of = count.max(round + 1);
                let message = format!("fine-tuning ended in round {} of {of}, and what was reached before is kept: {e}", round + 1);
                context.events.emit(&Event::Warning { object: "codec compact".into(), message });
                break;
            }
            done => done?,
        };
        model = outcome.model.clone();
        let (drop, used) = (outcome.drop, outcome.used);
        missed = used > goal.limit();
        let (bytes, least) = best.as_ref().map_or(if allowed { (first_bytes, untuned) } else { (usize::MAX, f64::INFINITY) }, |b| (b.bytes, b.drop));
        if goal.is_better(&outcome, bytes, least) {
            best = Some(outcome);
        } else if nearest.as_ref().is_none_or(|n| used < n.used) {
            nearest = Some(outcome);
        }
        let next = match goal {
            Goal::Drop(limit) => {
                forecast.add(round + 1, octaves, drop);
                if round + 1 < count { planned(&forecast, *limit, round + 1, best.is_some()) } else { forecast.octaves_after(octaves, drop, DROP_AIM * limit) }
            }
            Goal::Bytes(limit) => octaves + (used - SIZE_AIM * limit) / per_octave,
        };
        octaves = next.clamp(octaves - FARTHEST, octaves + FARTHEST);
    }
    let nearest = nearest.filter(|n| best.is_none() && !allowed && n.used < first_used);
    let told = |outcome: &Outcome| format!("{:.4} MB with the deformer's weights, PSNR {:.3} dB lower", megabytes(outcome.bytes), outcome.drop);
    if let Some(best) = best {
        note(context, format!("fine-tuned: {}", told(&best)));
        tuner.adopt(best.model.weights, best.weight_steps);
        return Ok(Tuned::Better(best.streams));
    }
    if let Some(nearest) = nearest {
        note(context, format!("fine-tuning found nothing that is allowed; the nearest has {}", told(&nearest)));
        tuner.adopt(nearest.model.weights, nearest.weight_steps);
        return Ok(Tuned::Nearest { streams: nearest.streams, used: nearest.used });
    }
    note(context, "fine-tuning found nothing better".into());
    Ok(Tuned::Nothing { lost: untuned })
}

/// What `rounded` loses of the PSNR of `gaussians` in dB, with the deformer's weights as they are stored without training.
pub fn loss(tuner: &dyn TuneModel, gaussians: Columns, rounded: &HostGaussians) -> Result<f64> {
    let model = tuner.start(&gaussians.to_host())?;
    Ok(tuner.psnr(&model.gaussians, &model.weights, None)? - tuner.psnr(rounded, &model.weights, Some(1.0))?)
}

/// The bytes that steps twice as large save where those of `quality` give `bytes`.
fn saved_by_doubling(job: &Job, planner: &Planner, quality: f64, bytes: usize) -> Result<f64> {
    let (_, coarser) = job.coded(planner, 2.0 * quality, &job.factors)?;
    Ok(bytes.saturating_sub(bytes_of(&coarser)).max(1) as f64)
}

/// Bytes of weights in such steps.
fn weight_bytes(tuner: &dyn TuneModel, weights: &[WeightArray], steps: f64) -> Result<usize> {
    Ok(bytes_of(&tuner.encoded_weights(weights, steps)?.0))
}

/// The bytes that steps of the weights twice as large as such, which give `bytes`, save.
fn saved_weights(tuner: &dyn TuneModel, weights: &[WeightArray], steps: f64, bytes: usize) -> Result<f64> {
    Ok((bytes as f64 - weight_bytes(tuner, weights, 2.0 * steps)? as f64).max(0.0))
}

/// By how many octaves the steps of the weights should grow more than those of the Gaussians, so that a byte more of either is worth the same. Losses grow with
/// squared steps, so the losses of the two are then in proportion to the bytes that doubled steps of each save. Given are the PSNR of the model, what it loses
/// where all is rounded, and the bytes that doubled steps of the Gaussians and of the weights save.
fn weight_octaves(tuner: &dyn TuneModel, model: &TunedModel, (psnr, untuned): (f64, f64), (per_octave, saved): (f64, f64)) -> Result<f64> {
    if saved == 0.0 {
        return Ok(0.0);
    }
    let probed = psnr - tuner.psnr(&model.gaussians, &model.weights, Some(libm::exp2(PROBED)))?;
    let lost = probed.max(LEAST_PROBED) * libm::exp2(-2.0 * PROBED);
    let of_gaussians = (untuned - lost).max(0.1 * untuned).max(lost);
    let octaves = 0.5 * libm::log2(of_gaussians * saved / (lost * per_octave));
    Ok(if octaves.is_finite() { octaves.clamp(-WEIGHTS_FARTHEST, WEIGHTS_FARTHEST) } else { 0.0 })
}

/// Iterations of each round, which add up to `iterations`.
fn rounds(iterations: usize) -> Vec<usize> {
    let count = ROUNDS.min(iterations);
    (0..count).map(|k| (k + 1) * iterations / count - k * iterations / count).collect()
}

#[cfg(test)]
mod tests;
