//! Fine-tuning: rounds of training with rounded values, each in the steps that the one before suggests.
//!
//! Training makes up for what rounding costs, so larger steps keep the same PSNR. Each round chooses steps, trains with them and measures what is lost. The best
//! file that keeps what is allowed is taken; if there is none, the one that needed no training.

use super::encode::canonical;
use super::forecast::Forecast;
use super::plan::{Plan, Planner};
use super::rounding::Rounder;
use super::search::{file_bytes, note};
use super::settings::Settings;
use super::{Attempt, Job, bytes_of};
use cc4dgs_format::{CodecContext, Result, Stream, TuneModel, TunedModel, Tuning};

/// Rounds of training.
const ROUNDS: usize = 5;
/// The most octaves by which the steps of the first round are larger than those that need no training, where a loss is allowed.
const FIRST: f64 = 2.0;
/// Octaves by which the steps of two rounds differ, at most.
const FARTHEST: f64 = 1.0;
/// The share of what is allowed that rounds aim at, and what is left for the difference of a round from what is expected, in dB: of all but the last, of the last if
/// there is a file that keeps what is allowed, and if there is none.
const AIM: f64 = 0.95;
const SPREADS: [f64; 3] = [0.01, 0.02, 0.03];
const SIZE_AIM: f64 = 0.99;
/// Octaves by which steps of the deformer's weights grow to measure what they cost, by which they may be larger or smaller than those chosen without training
/// beside those of the Gaussians, and the least loss in dB that counts.
const PROBED: f64 = 2.0;
const WEIGHTS_FARTHEST: f64 = 3.0;
const SMALLEST: f64 = 1e-5;

/// What is allowed.
pub enum Goal {
    /// A loss of PSNR in dB; the fewest bytes are best.
    Drop(f64),
    /// Bytes of the file; the highest PSNR is best.
    Bytes(f64),
}

/// What training came to.
pub enum Tuned {
    /// Streams that are better than those without training.
    Better(Vec<Stream>),
    /// Nothing better: those without training lose `lost` dB of PSNR.
    Nothing { lost: f64 },
}

/// What needed no training.
pub struct Untuned<'a> {
    pub attempt: &'a Attempt,
    pub streams: &'a [Stream],
    /// Whether it uses no more than what is allowed.
    pub allowed: bool,
}

/// What a round came to.
struct Outcome {
    streams: Vec<Stream>,
    model: TunedModel,
    weight_steps: f64,
    /// Bytes with the deformer's weights, and of the whole file where it is known.
    bytes: usize,
    file: f64,
    /// PSNR in dB below that of the model before compression.
    drop: f64,
}

impl Goal {
    fn is_better(&self, outcome: &Outcome, bytes: usize, drop: f64) -> bool {
        match self {
            Self::Drop(limit) => outcome.drop <= *limit && outcome.bytes < bytes,
            Self::Bytes(limit) => outcome.file <= *limit && outcome.drop < drop,
        }
    }
}

/// The best streams that `goal` allows, after training; `found` is what there is without.
pub fn tune(job: &Job, found: &Untuned, goal: &Goal, settings: &Settings, tuner: &dyn TuneModel, context: &CodecContext) -> Result<Tuned> {
    let megabytes = |bytes: usize| bytes as f64 / 1e6;
    let mut model = tuner.start(job.planner.gaussians)?;
    let before = tuner.psnr(&model.gaussians, &model.weights, None)?;
    let untuned = before - tuner.psnr(&found.attempt.rounded, &model.weights, Some(1.0))?;
    let first_bytes = bytes_of(found.streams) + tuner.weight_bytes(&model.weights, 1.0)?;
    note(context, format!("without fine-tuning {:.4} MB with the deformer's weights, PSNR {untuned:.3} dB lower", megabytes(first_bytes)));
    // Weights are rounded too, and the loss was measured on fewer views before.
    let allowed = match goal {
        Goal::Drop(limit) => found.allowed && untuned <= *limit,
        Goal::Bytes(_) => found.allowed,
    };
    let mut best: Option<Outcome> = None;
    let shares = rounds(settings.finetune);
    let count = shares.len();
    let per_round = settings.finetune as f64 / count.max(1) as f64;
    // Where the loss is bounded, steps are planned for the last round but one, whose file is safe, and then for the last.
    let mut forecast = Forecast::new(if let Goal::Drop(limit) = goal { *limit } else { 0.0 }, per_round);
    let planned = |forecast: &Forecast, limit: f64, done: usize, kept: bool| {
        let (last, spread) = match (done + 1 < count, kept) {
            (true, _) => (count - 1, SPREADS[0]),
            (false, kept) => (count, SPREADS[if kept { 1 } else { 2 }]),
        };
        forecast.octaves(last, AIM * limit - spread)
    };
    let (_, per_octave) = planned_with(job, &job.planner, found.attempt.quality)?;
    let of_weights = {
        // A byte more of the weights is to be worth as much as one more of the Gaussians. Losses grow with squared steps.
        let probed = before - tuner.psnr(&model.gaussians, &model.weights, Some(libm::exp2(PROBED)))?;
        let lost = (probed * libm::exp2(-2.0 * PROBED)).max(SMALLEST);
        let saved = tuner.weight_bytes(&model.weights, 1.0)?.saturating_sub(tuner.weight_bytes(&model.weights, 2.0)?) as f64;
        let octaves = 0.5 * libm::log2((untuned - lost).max(SMALLEST) * saved / (lost * per_octave));
        if octaves.is_finite() { octaves.clamp(-WEIGHTS_FARTHEST, WEIGHTS_FARTHEST) } else { 0.0 }
    };
    let mut octaves = match goal {
        Goal::Drop(limit) => planned(&forecast, *limit, 0, false).clamp(0.0, FIRST),
        Goal::Bytes(limit) => {
            let weights = tuner.weight_bytes(&model.weights, libm::exp2(of_weights))? as f64 - tuner.weight_bytes(&model.weights, 1.0)? as f64;
            ((file_bytes(context, found.streams, None)? + weights - SIZE_AIM * limit) / per_octave).clamp(-FIRST, FIRST)
        }
    };
    note(context, format!("steps of the deformer's weights {:.2} times larger than those of the Gaussians", libm::exp2(of_weights)));
    for (round, &iterations) in shares.iter().enumerate() {
        let quality = found.attempt.quality * libm::exp2(octaves);
        let weight_steps = libm::exp2(octaves + of_weights);
        let planner = job.planner.of(&model.gaussians);
        let (plan, per_octave) = planned_with(job, &planner, quality)?;
        let bits_per_octave = 8.0 * per_octave;
        let rounding = &Rounder { plan: &plan, free: &job.free, classes: job.planner.classes };
        let of = (shares[..round].iter().sum(), settings.finetune);
        let seed = context.seed.child("fine-tuning").index(round as u64);
        model = tuner.tune(&model, &Tuning { rounding, weight_steps, iterations, of, seed, size_weight: settings.size_weight, bits_per_octave })?;
        model.gaussians = canonical(&model.gaussians, &job.free);
        let streams = job.streams(&model.gaussians, &plan)?;
        let drop = before - tuner.psnr(&job.rounded(&model.gaussians, &plan), &model.weights, Some(weight_steps))?;
        let bytes = bytes_of(&streams) + tuner.weight_bytes(&model.weights, weight_steps)?;
        let (number, steps, gaussians) = (round + 1, libm::exp2(octaves), megabytes(bytes_of(&streams)));
        note(
            context,
            format!(
                "fine-tuning {number}: steps {steps:.2} times larger, {gaussians:.4} MB of Gaussians, {:.4} MB in all, PSNR {drop:.3} dB lower",
                megabytes(bytes)
            ),
        );
        let file = file_bytes(context, &streams, Some((&model.weights, weight_steps)))?;
        let (outcome, lost) = (Outcome { streams, model: model.clone(), weight_steps, bytes, file, drop }, drop);
        let (bytes, drop) = best.as_ref().map_or(if allowed { (first_bytes, untuned) } else { (usize::MAX, f64::INFINITY) }, |b| (b.bytes, b.drop));
        if goal.is_better(&outcome, bytes, drop) {
            best = Some(outcome);
        }
        let next = match goal {
            Goal::Drop(limit) => {
                forecast.add(round + 1, octaves, lost);
                planned(&forecast, *limit, round + 1, best.is_some())
            }
            Goal::Bytes(limit) => octaves + (file - SIZE_AIM * limit) / per_octave,
        };
        octaves = next.clamp(octaves - FARTHEST, octaves + FARTHEST);
    }
    let Some(best) = best else {
        note(context, "fine-tuning found nothing better".into());
        return Ok(Tuned::Nothing { lost: untuned });
    };
    note(context, format!("fine-tuned: {:.4} MB with the deformer's weights, PSNR {:.3} dB lower", megabytes(best.bytes), best.drop));
    tuner.adopt(best.model.weights, best.weight_steps);
    Ok(Tuned::Better(best.streams))
}

/// The plan of a quality, and the bytes that steps twice as large save.
fn planned_with(job: &Job, planner: &Planner, quality: f64) -> Result<(Plan, f64)> {
    let bytes = |quality: f64| {
        let plan = job.attempt_with(planner, quality, &job.factors)?.plan;
        Ok((bytes_of(&job.streams(planner.gaussians, &plan)?), plan))
    };
    let (own, plan) = bytes(quality)?;
    let (coarser, _) = bytes(2.0 * quality)?;
    Ok((plan, own.saturating_sub(coarser).max(1) as f64))
}

/// Iterations of each round, which add up to `iterations`.
fn rounds(iterations: usize) -> Vec<usize> {
    let count = ROUNDS.min(iterations);
    (0..count).map(|k| (k + 1) * iterations / count - k * iterations / count).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_add_up() {
        for iterations in [0, 1, 4, 5, 999, 1000] {
            let rounds = rounds(iterations);
            assert_eq!(rounds.iter().sum::<usize>(), iterations);
            assert!(rounds.iter().all(|r| *r > 0) && rounds.len() <= ROUNDS, "{rounds:?}");
        }
    }
}
