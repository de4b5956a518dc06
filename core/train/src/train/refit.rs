//! Pruning with re-fit: Gaussians of the least contribution are removed in rounds, and what is left is trained further after each (4DGS-1K, Yuan et al. 2025).

use super::log::Log;
use super::sampler::Sampler;
use super::tune::{CHECK_EVERY, TuneJob, Tuner, rate_at};
use super::{RateFactors, TrainState};
use burn::tensor::Device;
use cc4dgs_core::{Error, Event, EventSink, HostGaussians, Limits, Registry, Result, Scene, Schedule, Seed, Split, Stage, TuneModel, TunedModel, plural};
use cc4dgs_play::prune::{PruneReport, at_rows, by_contribution, contributions};
use cc4dgs_play::{Model, load_weights, weights_of};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Views per iteration.
const BATCH: usize = 4;
/// Share of the Gaussians that the first round removes. A round that costs too much is tried again with half of it.
const FIRST_SHARE: f64 = 0.3;
/// Least share that is worth a round.
const LEAST_SHARE: f64 = 0.04;
/// The most rounds.
const ROUNDS: usize = 12;
/// Largest learning rates as shares of those in the middle of a main stage: of the Gaussians, and of the deformer's weights.
const GAUSSIAN_RATE: f64 = 0.5;
const DEFORMER_RATE: f64 = 0.3;

/// Removes Gaussians of `job.model` in rounds, each followed by `iterations` of training, as long as the PSNR stays within `max_drop_db` of what it was, on
/// the views that judge ([`Scene::judging_split`]). Returns the Gaussians and weights of the last round that did, and what it came to; what
/// one re-fit gives by itself, with nothing removed, is measured too. A round that fails is the last, and the ones before are kept where they removed some.
///
/// # Errors
/// [`Error::Parameter`] for a drop that is not positive, a scene without training views, and one without recorded depth where all loss terms compare it (else a
/// warning says that such terms are left out), [`Error::Interrupted`], and what scene and rasterizer report.
pub fn prune_and_refit(model: &mut Model, scene: &Arc<Scene>, max_drop_db: f64, iterations: usize, job: &RefitJob<'_>) -> Result<PruneReport> {
    if !(max_drop_db > 0.0 && max_drop_db.is_finite()) {
        return Err(Error::parameter("prune", format!("a drop of {max_drop_db} dB"), "Allow a positive number of dB, such as 0.1"));
    }
    let (judged_by, before) = (scene.judging_split(), model.gaussians.len());
    let seed = Seed::root(model.provenance.seed).child("refit");
    // By the colours that the model has before anything is removed.
    let targets = job.tuner(model, scene).targets()?.clone();
    let (psnr_before_db, psnr_refit_alone_db) = {
        let tuner = job.tuner(model, scene).with_targets(targets.clone());
        let start = tuner.start(&model.gaussians)?;
        let alone = (before > 0).then(|| refit(&tuner, &model.gaussians, iterations, seed.child("alone"))).transpose()?;
        let alone = alone.map(|found| tuner.psnr(&found.gaussians, &found.weights, None)).transpose()?;
        (tuner.psnr(&start.gaussians, &start.weights, None)?, alone)
    };
    if let Some(alone) = psnr_refit_alone_db {
        let noun = plural(before, "Gaussian", "Gaussians");
        let message = format!("{before} {noun}, {psnr_before_db:.3} dB; {alone:.3} dB after re-fit with nothing removed");
        job.events.emit(&Event::Note { object: "prune".into(), message });
    }
    let (mut share, mut psnr_after_db, mut last_order) = (FIRST_SHARE, psnr_before_db, None);
    for round in 0..ROUNDS {
        let n = model.gaussians.len();
        let removed = (share * n as f64) as usize;
        if share < LEAST_SHARE || removed == 0 || removed == n {
            break;
        }
        // After a round that was undone the model, and with it the order, is the same.
        let order = match last_order.take() {
            Some(order) => order,
            None => by_contribution(&contributions(model, scene, job.registry, job.device, job.events)?),
        };
        let rest = at_rows(&model.gaussians, &order[..n - removed]);
        let tuner = job.tuner(model, scene).with_targets(targets.clone());
        let trained = refit(&tuner, &rest, iterations, seed.index(round as u64));
        let trained = trained.and_then(|found| Ok((tuner.psnr(&found.gaussians, &found.weights, None)?, found)));
        drop(tuner);
        let (psnr, found) = match trained {
            Err(e) if n < before && !matches!(e, Error::Interrupted(_)) => {
                let message = format!("round {} failed, and those before are kept: {e}", round + 1);
                job.events.emit(&Event::Warning { object: "prune".into(), message });
                break;
            }
            done => done?,
        };
        let kept = psnr_before_db - psnr <= max_drop_db;
        let what = if kept { "kept" } else { "too many, the round is undone" };
        let message = format!("round {}: {} of {n} Gaussians, {psnr:.3} dB after re-fit ({what})", round + 1, rest.len());
        job.events.emit(&Event::Note { object: "prune".into(), message });
        if kept {
            if let Some(field) = model.field.as_mut().filter(|_| !found.weights.is_empty()) {
                load_weights("re-fitted weights", field.field.as_mut(), found.weights, job.device)?;
            }
            model.gaussians = found.gaussians;
            model.size = model.float32_size();
            psnr_after_db = psnr;
        } else {
            (share, last_order) = (0.5 * share, Some(order));
        }
    }
    let views = super::tune::judges(scene).len();
    Ok(PruneReport { before, after: model.gaussians.len(), psnr_before_db, psnr_after_db, psnr_refit_alone_db, judged_by, views })
}

/// What a [`prune_and_refit`] works with; see [`TuneJob`].
pub struct RefitJob<'a> {
    /// Where plug-ins are found.
    pub registry: &'a Registry,
    /// The device of the model's deformer.
    pub device: &'a Device,
    /// What readers may believe.
    pub limits: &'a Limits,
    /// Where events go.
    pub events: &'a dyn EventSink,
    /// Set to stop.
    pub stop: &'a AtomicBool,
}

impl<'a> RefitJob<'a> {
    fn tuner<'b>(&'b self, model: &'b Model, scene: &Arc<Scene>) -> Tuner<'b> {
        let Self { registry, device, limits, events, stop } = *self;
        Tuner::new(TuneJob { model, scene: scene.clone(), field_weights: "fp32", registry, device, limits, events, stop })
    }
}

/// Trains `gaussians` and the weights of the tuner's model for `iterations`, at rates that rise and fall.
fn refit(tuner: &Tuner<'_>, gaussians: &HostGaussians, iterations: usize, seed: Seed) -> Result<TunedModel> {
    let from = tuner.start(gaussians)?;
    let (scene, events, stop) = (&tuner.job.scene, tuner.job.events, tuner.job.stop);
    tuner.with_state(&from, seed, |context, state: &mut TrainState| {
        let mut sampler = Sampler::new(scene.split(Split::Train), seed.child("views"), BATCH);
        // Nothing is logged.
        let mut log = Log::new(Stage::Main, usize::MAX, usize::MAX);
        let extent = scene.extent();
        let names: Vec<String> = state.set.iter().map(|(name, _)| format!("gaussians/{name}")).collect();
        for iteration in 1..=iterations {
            if stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted("in re-fitting; nothing was written".into()));
            }
            let share = rate_at((iteration as f64 - 0.5) / iterations as f64);
            let of_gaussians = names.iter().map(|name| (name.clone(), GAUSSIAN_RATE * share));
            state.rates = RateFactors(of_gaussians.chain([("deformer".into(), DEFORMER_RATE * share)]).collect());
            let check = iteration.is_multiple_of(CHECK_EVERY);
            let schedule = Schedule { extent, sh_degree: gaussians.sh_degree, ..Schedule::further(iteration) };
            if let Some(trouble) = context.photometric_step(&schedule, state, &sampler.batch(iteration - 1), check, &mut log)? {
                return Err(Error::backend("re-fitting", format!("{} is not finite", trouble.what), "Prune with --refit 0"));
            }
            if check || iteration == iterations {
                events.emit(&Event::Progress { task: "re-fitting".into(), done: iteration as u64, total: iterations as u64 });
            }
        }
        let gaussians = Tuner::columns_of(gaussians, state, tuner.job.limits, "Gaussians of re-fitting")?;
        let weights = state.deformer.as_ref().map(|d| weights_of(d.field.as_ref())).transpose()?.unwrap_or_default();
        Ok(TunedModel { gaussians, weights })
    })
}
