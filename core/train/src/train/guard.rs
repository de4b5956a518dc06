//! Keeps density control from destroying what is already fitted, whatever the control.
//!
//! - Gaussians with values that are not finite always go. Of the others:
//! - Nothing is removed before the cameras of the stage had two passes to fit it: not in the first passes of a stage, and no Gaussian that is younger.
//! - One round removes at most a quarter of the Gaussians.
//! - A removal that costs more than 0.3 dB on training views at once is halved, the most opaque Gaussians being kept, and then left out.
//! - After an opacity reset, the PSNR of training views must be back within a stated number of iterations; else the opacities return.

use super::{Context, TrainState};
use crate::sample::spread;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Error, Event, Result, Schedule};

/// Passes over the cameras of a stage before a Gaussian may be removed.
const PATIENCE_PASSES: usize = 2;
/// The largest share of a stage that these passes may take.
const PATIENCE_SHARE: usize = 6;
/// The least iterations a Gaussian is given.
const LEAST_PATIENCE: usize = 50;
/// Largest share of the Gaussians that one round removes.
const MAX_REMOVED: f64 = 0.25;
/// What one round may cost on training views, in dB.
const MAX_COST_DB: f32 = 0.3;
/// Training views that are rendered to find out.
const PROBES: usize = 3;
/// Removals of a smaller share of faint Gaussians are not probed.
const PROBED_SHARE: f64 = 0.01;
/// Opacity below which a Gaussian counts as faint.
const FAINT: f32 = 0.02;
/// Iterations within which the PSNR must be back after an opacity reset, at least; and passes over the cameras.
const RECOVERY: usize = 400;
const RECOVERY_PASSES: usize = 4;
/// An opacity that undoes a removal in a rendered image: the Gaussian is not drawn.
const INVISIBLE_LOGIT: f32 = -30.0;

/// What the guard remembers between iterations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Guard {
    /// Iteration of the stage in which each Gaussian was added; 0 for those it began with `[N]`.
    born: Vec<f32>,
    /// The last opacity reset, until it is judged.
    reset: Option<Reset>,
}

#[derive(Clone, Debug, PartialEq)]
struct Reset {
    iteration: usize,
    psnr_db: f32,
    /// Opacity logits before it `[N]`.
    logits: Vec<f32>,
}

impl Guard {
    /// A stage begins with `count` Gaussians.
    pub fn begin_stage(&mut self, count: usize) {
        *self = Self { born: vec![0.0; count], reset: None };
    }
    /// Arrays for checkpoints, by name.
    pub fn state(&self) -> Vec<(String, Vec<f32>)> {
        let mut arrays = vec![("born".to_string(), self.born.clone())];
        if let Some(reset) = &self.reset {
            arrays.push(("reset".into(), vec![reset.iteration as f32, reset.psnr_db]));
            arrays.push(("logits".into(), reset.logits.clone()));
        }
        arrays
    }
    /// What [`Guard::state`] returned, for `count` Gaussians.
    ///
    /// # Errors
    /// [`Error::Data`] for arrays of another length or name.
    pub fn restore(state: Vec<(String, Vec<f32>)>, count: usize) -> Result<Self> {
        let damaged = |problem: String| Error::data("checkpoint: guard of density control", problem, "Use another checkpoint of the run");
        let (mut born, mut numbers, mut logits) = (None, None, None);
        for (name, values) in state {
            let (slot, length) = match name.as_str() {
                "born" => (&mut born, count),
                "reset" => (&mut numbers, 2),
                "logits" => (&mut logits, count),
                _ => return Err(damaged(format!("there is no array '{name}'"))),
            };
            if values.len() != length || values.iter().any(|v| !v.is_finite()) {
                return Err(damaged(format!("'{name}' has {} values for {count} Gaussians, or some that are not finite", values.len())));
            }
            *slot = Some(values);
        }
        let reset = match (numbers.as_deref(), logits) {
            (Some([iteration, psnr_db]), Some(logits)) => Some(Reset { iteration: iteration.max(0.0) as usize, psnr_db: *psnr_db, logits }),
            (None, None) => None,
            _ => return Err(damaged("half of an opacity reset is missing".into())),
        };
        Ok(Self { born: born.ok_or_else(|| damaged("'born' is missing".into()))?, reset })
    }
    /// The Gaussians are those of `plan` now.
    fn follow(&mut self, plan: &DensityPlan, iteration: usize) {
        let rows = || plan.parents().iter().zip(plan.fresh());
        self.born = rows().map(|(&parent, &fresh)| if fresh { iteration as f32 } else { self.born[parent] }).collect();
        if let Some(reset) = &mut self.reset {
            reset.logits = plan.parents().iter().map(|&parent| reset.logits[parent]).collect();
        }
    }
    /// Divides the rows that a plan removes: those that stay because they are too young or too many, and those that may go, the faintest first. Broken rows
    /// (`is_broken`) are in neither: they go in any case.
    fn divide(&self, removed: &[usize], logits: &[f32], is_broken: impl Fn(usize) -> bool, schedule: &Schedule) -> (Vec<usize>, Vec<usize>) {
        let whole = removed.iter().copied().filter(|&row| !is_broken(row));
        let (mut kept, mut going): (Vec<usize>, Vec<usize>) = whole.partition(|&row| self.is_young(row, schedule));
        going.sort_by(|&a, &b| logits[a].total_cmp(&logits[b]).then(a.cmp(&b)));
        let most = (MAX_REMOVED * logits.len() as f64).ceil() as usize;
        kept.extend(going.split_off(going.len().min(most)));
        (kept, going)
    }
    /// Whether the Gaussian `row` is too young to be judged.
    fn is_young(&self, row: usize, schedule: &Schedule) -> bool {
        let patience = (PATIENCE_PASSES * schedule.pass).min(schedule.length / PATIENCE_SHARE).max(LEAST_PATIENCE);
        schedule.iteration.saturating_sub(self.born[row] as usize) < patience
    }
}

impl Context<'_> {
    /// Weakens what `plan` removes, and remembers what it resets. Call before the plan is carried out.
    pub(crate) fn guard_plan(&self, plan: &mut DensityPlan, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let count = state.set.len();
        let removed = plan.removed(count);
        if !removed.is_empty() {
            let logits = to_vec(state.set.get("opacity_logits")?.clone(), "opacity_logits")?;
            let kept = self.kept_after_all(&removed, &logits, state, schedule)?;
            plan.restore(&kept);
        }
        if plan.restarted().iter().any(|name| name == "opacity_logits") {
            self.judge_reset(state, schedule)?;
            let gaussians = state.set.gaussians()?;
            let psnr_db = self.mean_psnr(state, &gaussians, &self.probes(schedule), schedule.sh_degree)?;
            let logits = to_vec(gaussians.opacity_logits.clone(), "opacity_logits")?;
            state.guard.reset = Some(Reset { iteration: schedule.iteration, psnr_db, logits });
        }
        state.guard.follow(plan, schedule.iteration);
        Ok(())
    }

    /// Those of the rows `removed` that stay.
    fn kept_after_all(&self, removed: &[usize], logits: &[f32], state: &mut TrainState, schedule: &Schedule) -> Result<Vec<usize>> {
        let broken = broken_rows(state)?;
        let (mut kept, mut going) = state.guard.divide(removed, logits, |row| broken[row], schedule);
        let faint = (FAINT / (1.0 - FAINT)).ln();
        let harmless = (going.len() as f64) < PROBED_SHARE * logits.len() as f64 && going.iter().all(|&row| logits[row] < faint);
        if !harmless {
            let probes = self.probes(schedule);
            let gaussians = state.set.gaussians()?;
            let before = self.mean_psnr(state, &gaussians, &probes, schedule.sh_degree)?;
            while !going.is_empty() {
                let mut without = logits.to_vec();
                going.iter().for_each(|&row| without[row] = INVISIBLE_LOGIT);
                let mut gaussians = gaussians.clone();
                gaussians.opacity_logits = Tensor::from_data(TensorData::new(without, [logits.len()]), &self.device);
                let cost = before - self.mean_psnr(state, &gaussians, &probes, schedule.sh_degree)?;
                if cost <= MAX_COST_DB {
                    break;
                }
                let message = format!("removing {} of {} Gaussians would cost {cost:.1} dB on training views: half of them stay", going.len(), logits.len());
                self.job.events.emit(&Event::Note { object: "density control".into(), message });
                kept.extend(going.split_off(going.len() / 2));
            }
        }
        kept.sort_unstable();
        Ok(kept)
    }

    /// Judges the last opacity reset once its time is over; at the end of the stage in any case.
    pub(crate) fn guard_reset(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let Some(reset) = &state.guard.reset else { return Ok(()) };
        let due = reset.iteration + RECOVERY.max(RECOVERY_PASSES * schedule.pass);
        if schedule.iteration >= due || schedule.left() == 0 { self.judge_reset(state, schedule) } else { Ok(()) }
    }

    fn judge_reset(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let Some(reset) = state.guard.reset.take() else { return Ok(()) };
        let gaussians = state.set.gaussians()?;
        let now = self.mean_psnr(state, &gaussians, &self.probes(schedule), schedule.sh_degree)?;
        if now >= reset.psnr_db - MAX_COST_DB {
            return Ok(());
        }
        let message = format!(
            "{:.1} dB on training views {} iterations after the opacity reset, {:.1} dB before it: the opacities return",
            now,
            schedule.iteration - reset.iteration,
            reset.psnr_db
        );
        self.job.events.emit(&Event::Note { object: "density control".into(), message });
        let logits = to_vec(gaussians.opacity_logits, "opacity_logits")?;
        let count = logits.len();
        let higher: Vec<f32> = logits.iter().zip(&reset.logits).map(|(now, before)| now.max(*before)).collect();
        state.set.set("opacity_logits", Tensor::from_data(TensorData::new(higher, [count, 1]), &self.device))?;
        state.optimizer.restart("gaussians/opacity_logits");
        Ok(())
    }

    fn probes(&self, schedule: &Schedule) -> Vec<usize> {
        spread(&self.stage_views(schedule.stage), PROBES)
    }
}

/// The Gaussians with a value that is not finite `[N]`.
fn broken_rows(state: &TrainState) -> Result<Vec<bool>> {
    let mut broken = vec![false; state.set.len()];
    for (name, values) in state.set.iter() {
        let width = values.dims()[1].max(1);
        for (row, values) in broken.iter_mut().zip(to_vec(values.clone(), name)?.chunks_exact(width)) {
            *row |= values.iter().any(|v| !v.is_finite());
        }
    }
    Ok(broken)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_young_are_spared_and_rows_are_followed() {
        let mut guard = Guard::default();
        guard.begin_stage(3);
        let at = |iteration| Schedule { iteration, pass: 100, ..Schedule::main(6000) };
        assert!(guard.is_young(0, &at(199)) && !guard.is_young(0, &at(200)));
        let mut plan = DensityPlan::new();
        plan.keep(2);
        plan.copy(1);
        guard.reset = Some(Reset { iteration: 250, psnr_db: 20.0, logits: vec![0.0, 1.0, 2.0] });
        guard.follow(&plan, 300);
        assert!(!guard.is_young(0, &at(320)) && guard.is_young(1, &at(320)));
        assert_eq!(guard.reset.as_ref().unwrap().logits, [2.0, 1.0]);
        assert_eq!(Guard::restore(guard.state(), 2).unwrap(), guard);
        assert!(Guard::restore(guard.state(), 3).is_err());
        let half: Vec<_> = guard.state().into_iter().filter(|(name, _)| name != "logits").collect();
        assert!(Guard::restore(half, 2).is_err());
    }

    #[test]
    fn the_faintest_go_and_broken_ones_are_never_kept() {
        let mut guard = Guard::default();
        guard.begin_stage(8);
        let at = |iteration| Schedule { iteration, pass: 1, ..Schedule::main(6000) };
        let logits = [0.0, -1.0, -2.0, -3.0, f32::NAN, 1.0, 2.0, 3.0];
        // Two of eight may go; row 4 goes whatever its age.
        let divided = guard.divide(&[0, 1, 2, 3, 4], &logits, |row| row == 4, &at(5000));
        assert_eq!(divided, (vec![1, 0], vec![3, 2]));
        assert_eq!(guard.divide(&[0, 4], &logits, |row| row == 4, &at(1)), (vec![0], vec![]));
    }

    #[test]
    fn short_stages_are_not_all_patience() {
        let mut guard = Guard::default();
        guard.begin_stage(1);
        let at = |iteration| Schedule { iteration, pass: 810, ..Schedule::main(600) };
        assert!(guard.is_young(0, &at(99)) && !guard.is_young(0, &at(100)));
    }
}
