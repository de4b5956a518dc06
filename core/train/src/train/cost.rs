//! What an iteration costs by the number of its views.

use super::log::Log;
use super::sampler::Sampler;
use super::tune::{TuneJob, Tuner};
use crate::config::RunConfig;
use cc4dgs_core::{Error, Recorder, Registry, Result, Scene, Schedule, Seed, Split, Stage, TuneModel, config, parse_device};
use cc4dgs_play::Model;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Measurements of which the shortest counts, and the iterations of each.
const MEASUREMENTS: usize = 3;
const ITERATIONS: usize = 4;

/// The share of an iteration of `model`'s main stage that its views do not share, 0 to 1: with `v` of it, an iteration of `k` views takes `1 + (k - 1) v` times
/// as long as one of a single view. Found by training for a few iterations with `views` views, or as many as the scene has, and with one; the result is
/// forgotten. 0 where there is only one view.
///
/// # Errors
/// [`Error::Backend`] for what is not finite, and what scene and plug-ins report.
pub(crate) fn share_per_view(model: &Model, scene: &Arc<Scene>, views: usize, registry: &Registry) -> Result<f64> {
    let views = views.min(scene.split(Split::Train).len());
    let stop = AtomicBool::new(false);
    let run = config::parse_section::<RunConfig>("configuration of the model", &model.provenance.config)?;
    let device = parse_device(&run.device)?;
    let events = Recorder::default();
    let tuner = Tuner::new(TuneJob {
        model,
        scene: scene.clone(),
        field_weights: "fp32",
        registry,
        device: &device,
        limits: &run.limits,
        events: &events,
        stop: &stop,
    });
    // Their colours make no difference to the time.
    let tuner = tuner.with_targets(scene.clone());
    let seed = Seed::root(run.seed).child("cost");
    tuner.with_state(&tuner.start(&model.gaussians)?, seed, |context, state| {
        let mut log = Log::new(Stage::Main, usize::MAX, usize::MAX);
        let schedule = Schedule { extent: scene.extent(), sh_degree: model.gaussians.sh_degree, ..Schedule::further(0) };
        let mut shortest = |views: usize| {
            let mut sampler = Sampler::new(scene.split(Split::Train), seed.child("views"), views);
            let mut least = f64::INFINITY;
            // The first measurement holds whatever happens once.
            for measurement in 0..=MEASUREMENTS {
                let began = Instant::now();
                for iteration in 1..=ITERATIONS {
                    let batch = sampler.batch(measurement * ITERATIONS + iteration - 1);
                    // A check waits for the device.
                    if let Some(trouble) = context.photometric_step(&schedule, state, &batch, iteration == ITERATIONS, &mut log)? {
                        return Err(Error::backend("timing an iteration", format!("{} is not finite", trouble.what), "Lower the rates of train.lr"));
                    }
                }
                if measurement > 0 {
                    least = least.min(began.elapsed().as_secs_f64());
                }
            }
            Ok(least)
        };
        let (one, many) = (shortest(1)?, shortest(views)?);
        Ok(share(one, many, views))
    })
}

/// The share where an iteration of one view takes the time `one`, and one of `views` views `many`.
fn share(one: f64, many: f64, views: usize) -> f64 {
    if views < 2 { 0.0 } else { ((many - one) / (views - 1) as f64 / one.max(1e-9)).clamp(0.0, 1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_view_shares_nothing() {
        assert!((share(10.0, 14.0, 3) - 0.2).abs() < 1e-9 && (share(10.0, 14.0, 2) - 0.4).abs() < 1e-9);
        // Two measurements of the same differ by chance.
        assert_eq!(share(10.0, 14.0, 1), 0.0);
    }
}
