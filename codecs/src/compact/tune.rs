//! Fine-tuning: rounds of training with rounded values, each in the steps that the one before suggests.
//!
//! Training makes up for what rounding costs, so larger steps keep the same PSNR. Each round chooses steps, trains with them and measures what is lost. The best
//! file that keeps what is allowed is taken; if there is none, the one that needed no training.

use super::encode::{Plan, canonical};
use super::rounding::Rounder;
use super::search::{file_bytes, note};
use super::settings::Settings;
use super::{Attempt, Job, bytes_of};
use cc4dgs_format::{CodecContext, Result, Stream, TuneModel, TunedModel, Tuning};

/// Rounds of training.
const ROUNDS: usize = 5;
/// Share of the loss by rounding that training leaves. With steps k times those that need no training, rounding costs k² times what is allowed.
const REMAINS: f64 = 0.3;
/// What further training gains in dB in the first round, whatever is rounded; models that were trained for a few minutes gain more.
const GAIN: f64 = 0.15;
/// The most octaves by which the steps of the first round are larger than those that need no training, where a loss is allowed.
const FIRST: f64 = 2.0;
/// Octaves by which the steps of two rounds differ, at most.
const FARTHEST: f64 = 1.0;
/// The share of what is allowed that rounds aim at, and the last one, less what a round differs from what is expected, in dB.
const AIM: f64 = 0.95;
const LAST_AIM: f64 = 0.8;
const SIZE_AIM: f64 = 0.99;
const SPREAD: f64 = 0.03;

/// What is allowed.
pub enum Goal {
    /// A loss of PSNR in dB; the fewest bytes are best.
    Drop(f64),
    /// Bytes of the file; the highest PSNR is best. Weights of the deformer keep their steps.
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
    /// Bytes of its streams.
    pub bytes: usize,
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
    /// Octaves by which the steps of the first round are larger than those that need no training.
    fn first(&self) -> f64 {
        match self {
            Self::Drop(limit) => (0.5 * libm::log2((AIM + GAIN / limit.max(1e-9)) / REMAINS)).min(FIRST),
            Self::Bytes(_) => 0.0,
        }
    }
    /// By how many octaves the next steps should be larger; `aim` is a share.
    fn octaves(&self, outcome: &Outcome, aim: f64, octaves: f64, bits_per_octave: f64) -> f64 {
        let more = match self {
            Self::Drop(limit) => {
                // Rounding costs in proportion to squared steps; training gains what it gains.
                let cost = REMAINS * limit * libm::exp2(2.0 * octaves);
                0.5 * libm::log2(((cost + aim * limit - SPREAD - outcome.drop) / cost).max(1e-3))
            }
            Self::Bytes(limit) => 8.0 * (outcome.file - SIZE_AIM * limit) / bits_per_octave,
        };
        more.clamp(-FARTHEST, FARTHEST)
    }
}

/// The best streams that `goal` allows, after training; `found` is what there is without.
pub fn tune(job: &Job, found: &Untuned, goal: &Goal, settings: &Settings, tuner: &dyn TuneModel, context: &CodecContext) -> Result<Tuned> {
    let megabytes = |bytes: usize| bytes as f64 / 1e6;
    let mut model = tuner.start(job.planner.gaussians)?;
    let before = tuner.psnr(&model.gaussians, &model.weights, None)?;
    let untuned = before - tuner.psnr(&found.attempt.rounded, &model.weights, Some(1.0))?;
    let first_bytes = found.bytes + tuner.weight_bytes(&model.weights, 1.0)?;
    note(context, format!("without fine-tuning {:.4} MB with the deformer's weights, PSNR {untuned:.3} dB lower", megabytes(first_bytes)));
    // Weights are rounded too, and the loss was measured on fewer views before.
    let allowed = match goal {
        Goal::Drop(limit) => found.allowed && untuned <= *limit,
        Goal::Bytes(_) => found.allowed,
    };
    let mut best: Option<Outcome> = None;
    let mut octaves = goal.first();
    let shares = rounds(settings.finetune);
    for (round, &iterations) in shares.iter().enumerate() {
        let quality = found.attempt.quality * libm::exp2(octaves);
        let weight_steps = if matches!(goal, Goal::Drop(_)) { libm::exp2(octaves) } else { 1.0 };
        let planner = job.planner.of(&model.gaussians);
        let plan_of = |quality: f64| Ok(job.attempt_with(&planner, quality, &job.factors)?.plan);
        let bytes = |plan: &Plan| Ok(bytes_of(&job.streams(&model.gaussians, plan)?));
        let plan: Plan = plan_of(quality)?;
        let bits_per_octave = 8.0 * bytes(&plan)?.saturating_sub(bytes(&plan_of(2.0 * quality)?)?).max(1) as f64;
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
        let outcome = Outcome { streams, model: model.clone(), weight_steps, bytes, file, drop };
        let aim = if round + 2 == shares.len() { LAST_AIM } else { AIM };
        octaves += goal.octaves(&outcome, aim, octaves, bits_per_octave);
        let (bytes, drop) = best.as_ref().map_or(if allowed { (first_bytes, untuned) } else { (usize::MAX, f64::INFINITY) }, |b| (b.bytes, b.drop));
        if goal.is_better(&outcome, bytes, drop) {
            best = Some(outcome);
        }
    }
    let Some(best) = best else {
        note(context, "fine-tuning found nothing better".into());
        return Ok(Tuned::Nothing { lost: untuned });
    };
    note(context, format!("fine-tuned: {:.4} MB with the deformer's weights, PSNR {:.3} dB lower", megabytes(best.bytes), best.drop));
    tuner.adopt(best.model.weights, best.weight_steps);
    Ok(Tuned::Better(best.streams))
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
