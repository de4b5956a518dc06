//! Fine-tuning: rounds of training with rounded values, each in the steps that those before suggest.
//!
//! Training makes up for what rounding costs, so larger steps keep the same PSNR. Each round chooses steps, trains with them and measures what is lost. The best
//! file that keeps what is allowed is taken; if there is none, the one that needed no training.

use super::encode::canonical;
use super::forecast::Forecast;
use super::plan::Planner;
use super::rounding::Rounder;
use super::search::{file_bytes, note};
use super::settings::Settings;
use super::{Attempt, Job, bytes_of};
use cc4dgs_format::{CodecContext, Result, Stream, TuneModel, TunedModel, Tuning, WeightArray};

/// Rounds of training.
const ROUNDS: usize = 5;
/// The most octaves by which the steps of the first round are larger than those that need no training, where a loss is allowed.
const FIRST: f64 = 2.0;
/// Octaves by which the steps of two rounds differ, at most.
const FARTHEST: f64 = 1.0;
/// Standard deviations by which a round may lose more than expected: of all but the last, of the last if fine-tuning has a file that keeps what is allowed, and if it
/// has none.
const CAUTION: [f64; 3] = [0.5, 0.5, 1.0];
/// The share of an allowed size that rounds aim at.
const SIZE_AIM: f64 = 0.99;
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
    let first_bytes = bytes_of(found.streams) + weight_bytes(tuner, &model.weights, 1.0)?;
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
    let of_weights = weight_octaves(tuner, &model, (before, untuned), per_octave)?;
    let mut octaves = match goal {
        Goal::Drop(limit) => planned(&forecast, *limit, 0, false).clamp(0.0, FIRST),
        Goal::Bytes(limit) => {
            let (weights, saved) = weights_and_saved(tuner, &model.weights, libm::exp2(of_weights))?;
            let file = file_bytes(context, found.streams, None)? - weight_bytes(tuner, &model.weights, 1.0)? as f64 + weights;
            ((file - SIZE_AIM * limit) / (per_octave + saved)).clamp(-FIRST, FIRST)
        }
    };
    for (round, &iterations) in shares.iter().enumerate() {
        let quality = found.attempt.quality * libm::exp2(octaves);
        let weight_steps = libm::exp2(octaves + of_weights);
        let planner = job.planner.of(&model.gaussians);
        let plan = job.attempt_with(&planner, quality, &job.factors)?.plan;
        let per_octave = saved_by_doubling(job, &planner, quality, bytes_of(&job.streams(&model.gaussians, &plan)?))?;
        let bits_per_octave = 8.0 * per_octave;
        let rounding = &Rounder { plan: &plan, free: &job.free, classes: job.planner.classes };
        let of = (shares[..round].iter().sum(), settings.finetune);
        let seed = context.seed.child("fine-tuning").index(round as u64);
        model = tuner.tune(&model, &Tuning { rounding, weight_steps, iterations, of, seed, size_weight: settings.size_weight, bits_per_octave })?;
        model.gaussians = canonical(&model.gaussians, &job.free);
        let streams = job.streams(&model.gaussians, &plan)?;
        let drop = before - tuner.psnr(&job.rounded(&model.gaussians, &plan), &model.weights, Some(weight_steps))?;
        let bytes = bytes_of(&streams) + weight_bytes(tuner, &model.weights, weight_steps)?;
        let (number, steps, gaussians) = (round + 1, libm::exp2(octaves), megabytes(bytes_of(&streams)));
        note(
            context,
            format!(
                "fine-tuning {number}: steps {steps:.2} times larger, of weights {weight_steps:.2}, {gaussians:.4} MB of Gaussians, {:.4} MB in all, PSNR {drop:.3} dB lower",
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
            Goal::Bytes(limit) => octaves + (file - SIZE_AIM * limit) / (per_octave + weights_and_saved(tuner, &model.weights, weight_steps)?.1),
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

/// The bytes that steps twice as large save where those of `quality` give `bytes`.
fn saved_by_doubling(job: &Job, planner: &Planner, quality: f64, bytes: usize) -> Result<f64> {
    let coarser = job.attempt_with(planner, 2.0 * quality, &job.factors)?.plan;
    Ok(bytes.saturating_sub(bytes_of(&job.streams(planner.gaussians, &coarser)?)).max(1) as f64)
}

/// Bytes of weights in such steps.
fn weight_bytes(tuner: &dyn TuneModel, weights: &[WeightArray], steps: f64) -> Result<usize> {
    Ok(bytes_of(&tuner.encoded_weights(weights, steps)?.0))
}

/// Bytes of weights in such steps, and those that steps twice as large save.
fn weights_and_saved(tuner: &dyn TuneModel, weights: &[WeightArray], steps: f64) -> Result<(f64, f64)> {
    let bytes = weight_bytes(tuner, weights, steps)? as f64;
    Ok((bytes, (bytes - weight_bytes(tuner, weights, 2.0 * steps)? as f64).max(0.0)))
}

/// By how many octaves the steps of the weights should grow more than those of the Gaussians, so that a byte more of either is worth the same. Losses grow with squared
/// steps, so the losses of the two are then in proportion to the bytes that doubled steps of each save. Given are the PSNR of the model, what it loses where all is
/// rounded, and the bytes that doubled steps of the Gaussians save.
fn weight_octaves(tuner: &dyn TuneModel, model: &TunedModel, (psnr, untuned): (f64, f64), per_octave: f64) -> Result<f64> {
    let saved = weights_and_saved(tuner, &model.weights, 1.0)?.1;
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
mod tests {
    use super::super::encode::classify;
    use super::super::{Choices, Motion, importance, layers};
    use super::*;
    use cc4dgs_format::{EncodedWeights, HostGaussians, Seed, Silent};
    use std::cell::{Cell, RefCell};
    use std::collections::BTreeMap;

    /// A trainer whose PSNR falls with the mean squared error of the colours of degree 0 and rises with each iteration; its weight counts these.
    struct Trainer {
        colors: Vec<f32>,
        cost: f64,
        gain: f64,
        /// What was measured after so many iterations, and after how many those were that were adopted.
        measured: RefCell<BTreeMap<u32, f64>>,
        adopted: Cell<u32>,
    }

    impl TuneModel for Trainer {
        fn caution(&self) -> Result<Option<String>> {
            Ok(None)
        }
        fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel> {
            Ok(TunedModel { gaussians: gaussians.clone(), weights: vec![WeightArray { name: "iterations".into(), shape: vec![1], values: vec![0.0] }] })
        }
        fn tune(&self, from: &TunedModel, tuning: &Tuning) -> Result<TunedModel> {
            let mut out = from.clone();
            out.weights[0].values[0] += tuning.iterations as f32;
            Ok(out)
        }
        fn psnr(&self, gaussians: &HostGaussians, weights: &[WeightArray], _: Option<f64>) -> Result<f64> {
            // Scores are the indices of the rows, whose order may change.
            let rows = gaussians.dynamic_scores.iter().zip(gaussians.sh_dc.chunks_exact(3));
            let squares = rows.flat_map(|(&row, found)| found.iter().zip(&self.colors[3 * row as usize..])).map(|(a, b)| f64::from(a - b).powi(2));
            // Training makes up for most of what rounding costs.
            let cost = self.cost * if weights[0].values[0] > 0.0 { 0.3 } else { 1.0 };
            let psnr = 40.0 - cost * squares.sum::<f64>() / self.colors.len() as f64 + self.gain * f64::from(weights[0].values[0]);
            self.measured.borrow_mut().insert(weights[0].values[0] as u32, psnr);
            Ok(psnr)
        }
        fn encoded_weights(&self, _: &[WeightArray], _: f64) -> Result<EncodedWeights> {
            Ok(EncodedWeights::default())
        }
        fn adopt(&self, weights: Vec<WeightArray>, _: f64) {
            self.adopted.set(weights[0].values[0] as u32);
        }
        fn adopted(&self) -> Result<Option<EncodedWeights>> {
            Ok(None)
        }
    }

    #[test]
    fn what_is_allowed_is_used_whatever_training_gains() {
        let n = 500;
        let draw = |k: usize, column: u64| (Seed::root(column).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
        let mut g = HostGaussians { opacity_logits: vec![0.0; n], ..Default::default() };
        for (column, (_, width, values)) in g.columns_mut().into_iter().enumerate() {
            *values = (0..n * width).map(|k| draw(k, column as u64)).collect();
        }
        g.dynamic_scores = (0..n).map(|row| row as f32).collect();
        let context = CodecContext::new(Seed::root(1), Default::default(), &Silent);
        let importance = importance::estimate(&g, &context);
        let classes = classify(&importance.weights, &importance.shapes, false);
        let planner = Planner::new(&g, &importance, &classes, Choices { transform: true, rate_weight: 0.0 });
        let layers = layers::assign(&importance.weights, 1);
        let motion = Motion { free: 0, moving: None, levels: [0.0; 2] };
        let job = Job { planner, free: vec![false; n], directions: None, layers, motion, factors: [1.0; 6], joint: Cell::new(true) };
        let attempt = job.attempt(0.01).unwrap();
        let streams = job.streams(&g, &attempt.plan).unwrap();
        for (limit, gain) in [(0.05, 0.0), (0.05, 3e-4), (0.05, 1.5e-3), (0.3, 5e-4), (0.05, -1e-5)] {
            let mut trainer = Trainer { colors: g.sh_dc.clone(), cost: 1.0, gain, measured: Default::default(), adopted: Cell::new(0) };
            // What needs no training loses almost what is allowed.
            trainer.cost = 0.99 * limit / (40.0 - trainer.psnr(&attempt.rounded, &trainer.start(&g).unwrap().weights, None).unwrap());
            let found = Untuned { attempt: &attempt, streams: &streams, allowed: true };
            let tuned = tune(&job, &found, &Goal::Drop(limit), &Settings::default(), &trainer, &context).unwrap();
            let Tuned::Better(better) = tuned else { panic!("nothing better for {limit} dB and a gain of {gain}") };
            assert!(bytes_of(&better) < bytes_of(&streams));
            let lost = 40.0 - trainer.measured.borrow()[&trainer.adopted.get()];
            assert!((0.2 * limit..=limit).contains(&lost), "{limit} dB, a gain of {gain}: {:?}", trainer.measured);
        }
    }

    #[test]
    fn rounds_add_up() {
        for iterations in [0, 1, 4, 5, 999, 1000] {
            let rounds = rounds(iterations);
            assert_eq!(rounds.iter().sum::<usize>(), iterations);
            assert!(rounds.iter().all(|r| *r > 0) && rounds.len() <= ROUNDS, "{rounds:?}");
        }
    }
}
