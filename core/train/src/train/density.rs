//! Carries out what the density control plans.

use super::guard::broken_rows;
use super::{Context, TrainState};
use crate::gaussian_set::GaussianSet;
use burn::tensor::Tensor;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Error, Event, Result, Schedule};
use cc4dgs_play::Moving;

const SCORES: &str = "dynamic_scores";
/// Gaussians that key frames and recovery may add in any case, as a share of those there are.
const LEAST_SHARE: f64 = 0.25;

/// How many Gaussians key frames or recovery may add in any case, where there are `now`.
pub(super) fn least_added(now: usize) -> usize {
    (LEAST_SHARE * now as f64) as usize
}

/// Puts the rows of `plan` that move first, in their order, and the others behind them. What moves is then one piece of every array, and an iteration gathers
/// nothing.
pub(super) fn moving_first(plan: &mut DensityPlan, state: &TrainState) -> Result<()> {
    let Moving::Scored { .. } = state.moving else { return Ok(()) };
    let old = to_vec(state.set.get(SCORES)?.clone(), SCORES)?;
    let mut scores: Vec<f32> = plan.parents().iter().map(|&parent| old[parent]).collect();
    for set in plan.values().iter().filter(|set| set.attribute == SCORES) {
        set.rows.iter().zip(&set.values).for_each(|(&row, &score)| scores[row] = score);
    }
    let Some(mut order) = state.moving.rows(&scores) else { return Ok(()) };
    let mut still = vec![true; scores.len()];
    order.iter().for_each(|&row| still[row] = false);
    order.extend((0..still.len()).filter(|&row| still[row]));
    if order.iter().enumerate().any(|(k, &row)| k != row) {
        plan.reorder(&order);
    }
    Ok(())
}

/// Refuses `values` of the attribute `name` that the density control `kind` returned from `after_step`, where they do not fit the Gaussians.
fn check_step(kind: &str, set: &GaussianSet, name: &str, values: &Tensor<2>) -> Result<()> {
    let problem = match set.get(name).map(|old| old.dims()) {
        Ok(dims) if dims == values.dims() => return Ok(()),
        Ok(dims) => format!("after_step returned '{name}' of shape {:?}, and the Gaussians have {dims:?}", values.dims()),
        Err(_) => format!("after_step returned '{name}', which the Gaussians do not have"),
    };
    Err(Error::backend(format!("density control {kind}"), problem, "Correct the control, or choose another"))
}

impl Context<'_> {
    /// How many Gaussians key frames or recovery may add where there are `now`: as many as `density.max_gaussians` leaves, or [`least_added`] if that is more.
    /// `None` for density controls without such a bound.
    pub(super) fn most_added(&self, now: usize) -> Option<usize> {
        let most = self.job.config.density.get("max_gaussians").and_then(toml::Value::as_integer)?;
        Some((most.max(0) as usize).saturating_sub(now).max(least_added(now)))
    }

    /// What the density control wants after an optimizer step: new values of all rows, then a plan for the rows themselves.
    pub(crate) fn control_density(&self, schedule: &Schedule, state: &mut TrainState) -> Result<()> {
        let kind = self.job.config.density.get("kind").and_then(|k| k.as_str()).unwrap_or_default();
        let seed = self.seed.child(schedule.stage.name());
        let index = schedule.iteration as u64;
        let gaussians = state.set.gaussians()?;
        for (name, values) in state.density.after_step(&gaussians, schedule, seed.child("density noise").index(index))? {
            check_step(kind, &state.set, &name, &values)?;
            state.set.set(&name, values)?;
            if name == SCORES {
                state.invalidate_rows();
            }
        }
        // The values may have changed.
        let gaussians = state.set.gaussians()?;
        state.density.hold(state.guard.held());
        if let Some(mut plan) = state.density.plan(&gaussians, schedule, seed.child("densify").index(index))? {
            plan.check(kind, &gaussians)?;
            drop(gaussians);
            self.guard_plan(&mut plan, state, schedule)?;
            self.carry_out(&plan, state, schedule)?;
            state.density.executed(&plan, &self.device)?;
        }
        self.guard_reset(state, schedule)
    }

    /// Puts what moves first, where a stage begins with new statistics. The optimizer state follows: [`TrainState::begin_stage`] may keep it.
    pub(super) fn order_rows(&self, state: &mut TrainState) -> Result<()> {
        let mut plan = DensityPlan::unchanged(state.set.len());
        moving_first(&mut plan, state)?;
        if !plan.keeps_all(state.set.len()) {
            state.set = GaussianSet::from_gaussians(&plan.apply(&state.set.gaussians()?)?);
            state.optimizer.select_rows("gaussians/", plan.parents(), plan.fresh())?;
            state.invalidate_rows();
        }
        Ok(())
    }

    /// Removes the Gaussians with a value that is not finite, which are not drawn and cannot be stored: after the last round of a density control nobody else
    /// does.
    pub(crate) fn remove_broken(&self, state: &mut TrainState) -> Result<()> {
        let broken = broken_rows(state)?;
        let count = broken.iter().filter(|broken| **broken).count();
        if count == 0 || count == broken.len() {
            return Ok(());
        }
        if !state.guard.counts(broken.len()) {
            // No stage had an iteration before this one: guard and control know of no Gaussian yet.
            state.begin_stage(self.job.config.train.keep_moments, &self.device)?;
        }
        let mut plan = DensityPlan::new();
        (0..broken.len()).filter(|&row| !broken[row]).for_each(|row| {
            plan.keep(row);
        });
        plan.report.removed = count;
        let schedule = self.lengths.schedule(state.stage, state.iteration);
        self.guard_plan(&mut plan, state, &schedule)?;
        self.carry_out(&plan, state, &schedule)?;
        state.density.executed(&plan, &self.device)
    }

    /// Makes the Gaussians those of `plan`, with their optimizer state.
    pub(crate) fn carry_out(&self, plan: &DensityPlan, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let gaussians = state.set.gaussians()?;
        let keeps_all = plan.keeps_all(gaussians.len());
        state.set = GaussianSet::from_gaussians(&plan.apply(&gaussians)?);
        if !keeps_all {
            state.optimizer.select_rows("gaussians/", plan.parents(), plan.fresh())?;
        }
        for attribute in plan.restarted() {
            state.optimizer.restart(&format!("gaussians/{attribute}"));
        }
        if !keeps_all || plan.values().iter().any(|set| set.attribute == SCORES) {
            state.invalidate_rows();
        }
        if keeps_all {
            return Ok(());
        }
        let report = plan.report;
        let gaussians = state.set.len();
        self.job.events.emit(&Event::Densified {
            iteration: schedule.iteration,
            cloned: report.cloned,
            split: report.split,
            moved: report.moved,
            pruned: report.removed,
            gaussians,
        });
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::HostGaussians;

    #[test]
    fn values_that_do_not_fit_name_the_control() {
        let device = Device::flex();
        let mut host = HostGaussians { opacity_logits: vec![0.0; 2], ..Default::default() };
        host.columns_mut().into_iter().for_each(|(_, width, values)| values.resize(2 * width, 0.0));
        let set = GaussianSet::new(&host, &device);
        let check = |name: &str, shape: [usize; 2]| check_step("mine", &set, name, &Tensor::zeros(shape, &device)).map_err(|e| e.to_string());
        assert_eq!(check("means", [2, 3]), Ok(()));
        for (name, shape, expected) in [
            ("means", [3, 3], "'means' of shape [3, 3], and the Gaussians have [2, 3]"),
            ("means", [2, 1], "'means' of shape [2, 1], and the Gaussians have [2, 3]"),
            ("opacities", [2, 1], "'opacities', which the Gaussians do not have"),
        ] {
            let message = check(name, shape).unwrap_err();
            assert!(message.starts_with("density control mine: after_step returned ") && message.contains(expected), "{message}");
        }
    }
}
