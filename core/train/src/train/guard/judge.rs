//! Judges plans by what they cost on training views.

use super::super::density::moving_first;
use super::super::pyramid::Pyramid;
use super::super::sampler::Sampler;
use super::super::{Context, TrainState};
use super::{MAX_COST_DB, Removal, Reset, Standing, recovery};
use crate::sample::spread_views;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Event, Gaussians, Result, Scene, Schedule, plural};
use std::sync::Arc;

/// Training views that are rendered to find out.
const PROBES: usize = 3;
/// Removals of a smaller share of faint Gaussians are not probed.
const PROBED_SHARE: f64 = 0.01;
/// Opacity below which a Gaussian counts as faint.
const FAINT: f32 = 0.02;
/// An opacity that undoes a removal in a rendered image: the Gaussian is not drawn.
const INVISIBLE_LOGIT: f32 = -30.0;
/// The attribute that a reset sets.
pub(super) const OPACITIES: &str = "opacity_logits";

/// The images that say what a removal costs: of the size and of the frames that training sees at the time.
struct Probes {
    scene: Arc<Scene>,
    views: Vec<usize>,
}

impl Probes {
    /// Those of the iteration of `schedule`, whose views are drawn by `sampler` from a scene of `pyramid`.
    fn new(pyramid: &Pyramid, sampler: &Sampler, schedule: &Schedule) -> Self {
        let scene = pyramid.at(schedule.image_scale).clone();
        let mut open = sampler.open(schedule.iteration.saturating_sub(1)).to_vec();
        open.sort_unstable();
        Self { views: spread_views(&scene, &open, PROBES), scene }
    }
    /// Whether scores on these can be compared with scores on `other`.
    fn same_as(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.scene, &other.scene) && self.views == other.views
    }
}

impl Context<'_> {
    /// Weakens what `plan` removes and remembers what it resets, unless `train.guard` is off, and puts what moves first. Call before the plan is carried out.
    pub(crate) fn guard_plan(&self, plan: &mut DensityPlan, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        state.guard.read_views()?;
        if self.job.config.train.guard {
            self.judge_plan(plan, state, schedule)?;
        }
        moving_first(plan, state)?;
        state.guard.follow(plan, schedule.iteration);
        Ok(())
    }

    /// Weakens what `plan` removes and remembers what it resets.
    fn judge_plan(&self, plan: &mut DensityPlan, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let (count, own) = (state.set.len(), plan.len());
        let removed = plan.removed(count);
        if !removed.is_empty() || state.guard.held > 0 {
            let logits = to_vec(state.set.get(OPACITIES)?.clone(), OPACITIES)?;
            let (kept, measured) = self.kept_after_all(&removed, &logits, state, schedule)?;
            plan.restore(&kept);
            if measured {
                state.guard.held += count.saturating_sub(plan.len());
            }
        }
        if plan.restarted().iter().any(|name| name == OPACITIES) {
            if self.begin_reset(state, schedule)? {
                lower_restored(plan, own, &to_vec(state.set.get(OPACITIES)?.clone(), OPACITIES)?);
            } else {
                *plan = without_reset(plan);
            }
        }
        Ok(())
    }

    /// Those of the rows `removed` that stay, and whether it was measured what the removal of the others costs. Also looks whether an earlier removal is back.
    fn kept_after_all(&self, removed: &[usize], logits: &[f32], state: &mut TrainState, schedule: &Schedule) -> Result<(Vec<usize>, bool)> {
        let broken = broken_rows(state)?;
        let (mut kept, mut going) = state.guard.divide(removed, logits, |row| broken[row], schedule);
        let probes = self.probes(schedule);
        // A score on smaller images, or on fewer frames, does not tell what has been lost since.
        if state.guard.removal.as_ref().is_some_and(|last| !self.probes(&self.lengths.schedule(schedule.stage, last.iteration)).same_as(&probes)) {
            state.guard.removal = None;
        }
        let faint = (FAINT / (1.0 - FAINT)).ln();
        let harmless = (going.len() as f64) < PROBED_SHARE * logits.len() as f64 && going.iter().all(|&row| logits[row] < faint);
        // Nothing whose cost has to be measured.
        let cheap = going.is_empty() || (harmless && state.guard.removal.is_none());
        if cheap && state.guard.held == 0 {
            kept.sort_unstable();
            return Ok((kept, false));
        }
        let Probes { scene, views } = probes;
        let gaussians = state.set.gaussians()?;
        let psnr_db = self.mean_psnr(&scene, state, &gaussians, &views, schedule.sh_degree)?;
        let standing = state.guard.standing(psnr_db, schedule);
        state.guard.release(&standing, schedule);
        let mut measured = false;
        match standing {
            _ if cheap => {}
            Standing::Back(from) if harmless => state.guard.removal = Some(from).filter(|from| from.iteration < schedule.iteration),
            Standing::Back(from) => {
                while !going.is_empty() {
                    let mut without = logits.to_vec();
                    going.iter().for_each(|&row| without[row] = INVISIBLE_LOGIT);
                    let mut gaussians = gaussians.clone();
                    gaussians.opacity_logits = Tensor::from_data(TensorData::new(without, [logits.len()]), &self.device);
                    let cost = from.psnr_db - self.mean_psnr(&scene, state, &gaussians, &views, schedule.sh_degree)?;
                    if cost <= MAX_COST_DB {
                        break;
                    }
                    let message =
                        format!("removing {} of {} Gaussians would cost {cost:.1} dB on training views: half of them stay", going.len(), logits.len());
                    self.note(message);
                    kept.extend(going.split_off(going.len() / 2));
                }
                if !going.is_empty() {
                    state.guard.removal = Some(from);
                    measured = true;
                }
            }
            Standing::Waiting => kept.append(&mut going),
            Standing::Overdue(last) => {
                let since = schedule.iteration - last.iteration;
                self.note(format!(
                    "{psnr_db:.1} dB on training views {since} {} after Gaussians were removed, {:.1} dB before: removals are put off",
                    plural(since, "iteration", "iterations"),
                    last.psnr_db
                ));
                state.guard.removal = Some(Removal { reported: true, ..last });
                kept.append(&mut going);
            }
        }
        kept.sort_unstable();
        Ok((kept, measured))
    }

    /// Remembers what an opacity reset must come back to. False where it is to be left out: one of the stage was undone, the last one is not back, training
    /// views have no PSNR, or the time is too short to judge it.
    fn begin_reset(&self, state: &mut TrainState, schedule: &Schedule) -> Result<bool> {
        if state.guard.resets_off || schedule.left() < recovery(schedule) {
            return Ok(false);
        }
        let gaussians = state.set.gaussians()?;
        let psnr_db = self.psnr_of_stage(state, &gaussians, schedule)?;
        if !psnr_db.is_finite() || state.guard.reset.as_ref().is_some_and(|last| psnr_db < last.psnr_db - MAX_COST_DB) {
            return Ok(false);
        }
        let logits = to_vec(gaussians.opacity_logits.clone(), OPACITIES)?;
        state.guard.reset = Some(Reset::new(schedule.iteration, psnr_db, logits));
        // What the reset costs is no loss by removals, and has its own time to come back.
        (state.guard.removal, state.guard.held) = (None, 0);
        Ok(true)
    }

    fn note(&self, message: String) {
        self.job.events.emit(&Event::Note { object: "density control".into(), message });
    }

    /// Judges the last opacity reset once its time is over; at the end of the stage in any case. Without `train.guard` there is none to judge.
    pub(crate) fn guard_reset(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let Some(reset) = &state.guard.reset else { return Ok(()) };
        let due = reset.iteration + recovery(schedule);
        if schedule.iteration >= due || schedule.left() == 0 { self.judge_reset(state, schedule) } else { Ok(()) }
    }

    fn judge_reset(&self, state: &mut TrainState, schedule: &Schedule) -> Result<()> {
        let Some(reset) = state.guard.reset.take() else { return Ok(()) };
        let gaussians = state.set.gaussians()?;
        let now = self.psnr_of_stage(state, &gaussians, schedule)?;
        if now >= reset.psnr_db - MAX_COST_DB {
            return Ok(());
        }
        let since = schedule.iteration - reset.iteration;
        let message = format!(
            "{now:.1} dB on training views {since} {} after the opacity reset, {:.1} dB before it: the opacities return, and the stage has no more resets",
            plural(since, "iteration", "iterations"),
            reset.psnr_db
        );
        self.note(message);
        state.guard.resets_off = true;
        let logits = to_vec(gaussians.opacity_logits, OPACITIES)?;
        let count = logits.len();
        let higher: Vec<f32> = logits.iter().zip(&reset.logits).map(|(now, before)| now.max(*before)).collect();
        state.set.set(OPACITIES, Tensor::from_data(TensorData::new(higher, [count, 1]), &self.device))?;
        state.optimizer.restart("gaussians/opacity_logits");
        Ok(())
    }

    /// PSNR in dB on full images of all frames of the stage: more of them may be trained on by the time that a reset is judged.
    fn psnr_of_stage(&self, state: &mut TrainState, gaussians: &Gaussians, schedule: &Schedule) -> Result<f32> {
        let scene = &self.job.scene;
        self.mean_psnr(scene, state, gaussians, &spread_views(scene, &self.stage_views(schedule.stage), PROBES), schedule.sh_degree)
    }

    fn probes(&self, schedule: &Schedule) -> Probes {
        Probes::new(&self.pyramid, &self.sampler(schedule), schedule)
    }
}

/// The Gaussians with a value that is not finite `[N]`.
pub(crate) fn broken_rows(state: &TrainState) -> Result<Vec<bool>> {
    let mut broken = vec![false; state.set.len()];
    for (name, values) in state.set.iter() {
        let width = values.dims()[1].max(1);
        for (row, values) in broken.iter_mut().zip(to_vec(values.clone(), name)?.chunks_exact(width)) {
            *row |= values.iter().any(|v| !v.is_finite());
        }
    }
    Ok(broken)
}

/// `plan` with the opacities that the Gaussians, or the parents of new ones, have now.
fn without_reset(plan: &DensityPlan) -> DensityPlan {
    let mut other = DensityPlan::new();
    for (&parent, &fresh) in plan.parents().iter().zip(plan.fresh()) {
        if fresh {
            other.copy(parent)
        } else {
            other.keep(parent)
        };
    }
    for set in plan.values().iter().filter(|set| set.attribute != OPACITIES) {
        let width = set.values.len() / set.rows.len().max(1);
        for (&row, values) in set.rows.iter().zip(set.values.chunks_exact(width.max(1))) {
            other.set(row, &set.attribute, values);
        }
    }
    plan.restarted().iter().filter(|name| *name != OPACITIES).for_each(|name| other.restart(name));
    other.report = plan.report;
    other
}

/// Resets the rows that were restored, from `first` on, as the control resets its own: to at most the largest logit that it sets. `logits` are those of old
/// rows.
fn lower_restored(plan: &mut DensityPlan, first: usize, logits: &[f32]) {
    let set = plan.values().iter().filter(|set| set.attribute == OPACITIES).flat_map(|set| &set.values);
    let highest = set.copied().fold(f32::NEG_INFINITY, f32::max);
    if highest.is_finite() {
        for row in first..plan.len() {
            let logit = logits[plan.parents()[row]];
            plan.set(row, OPACITIES, &[logit.min(highest)]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RunConfig;
    use crate::schedule::IMAGE_SCALES;
    use cc4dgs_core::{Camera, NoImages, Seed, Split, View};

    #[test]
    fn removals_are_judged_on_what_is_trained_at_the_time() {
        // Three cameras, ten frames that come in over 100 iterations.
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (40, 20), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |k: usize| View { camera: k % 3, frame: k / 3, time_norm: (k / 3) as f32 / 9.0, split: Split::Train };
        let scene = Scene::new("s", (0..3).map(camera).collect(), (0..30).map(view).collect(), Arc::new(NoImages), 0).unwrap();
        let mut config = RunConfig::resolve(Some("demo"), None, &[]).unwrap();
        config.train.image_growth = 0.5;
        let pyramid = Pyramid::new(&Arc::new(scene), &config).unwrap();
        let all: Vec<usize> = (0..30).collect();
        let ramp = Sampler::new(all.clone(), Seed::root(1), 1).with_ramp(|share| 100.0 * share, |view| (view / 3) as f32 / 9.0);
        let at =
            |sampler: &Sampler, iteration: usize, image_scale: f32| Probes::new(&pyramid, sampler, &Schedule { iteration, image_scale, ..Schedule::main(300) });
        assert_eq!(at(&ramp, 1, 1.0).views, [0, 1, 2], "the first frame");
        for (iteration, frames) in [(11, 1), (12, 2), (50, 5), (101, 10)] {
            let probes = at(&ramp, iteration, 1.0);
            assert!(probes.views.len() == PROBES && probes.views.iter().all(|view| view / 3 < frames), "{:?} at {iteration}", probes.views);
        }
        let late = at(&ramp, 101, 1.0);
        assert!(late.same_as(&at(&Sampler::new(all, Seed::root(2), 4), 1, 1.0)), "all frames are open, whatever their order");
        assert!(late.same_as(&at(&ramp, 300, 1.0)) && !late.same_as(&at(&ramp, 50, 1.0)));
        for scale in IMAGE_SCALES {
            let small = at(&ramp, 101, scale);
            assert!(small.views == late.views && !small.same_as(&late) && small.same_as(&at(&ramp, 102, scale)));
            assert_eq!(small.scene.cameras[0].width, (40.0 * scale).round() as u32);
        }
    }

    #[test]
    fn a_reset_reaches_rows_that_were_restored() {
        let logits = [3.0, 2.0, -9.0, 1.0];
        let mut plan = DensityPlan::new();
        let own = plan.keep(0);
        plan.set(own, OPACITIES, &[-4.5]);
        plan.restart(OPACITIES);
        plan.restore(&[2, 3]);
        lower_restored(&mut plan, 1, &logits);
        assert_eq!((plan.values()[0].rows.as_slice(), plan.values()[0].values.as_slice()), (&[0, 1, 2][..], &[-4.5, -9.0, -4.5][..]));
        // A control that sets no opacity has none to follow.
        let mut other = DensityPlan::unchanged(1);
        other.restore(&[1]);
        lower_restored(&mut other, 1, &logits);
        assert!(other.values().is_empty());
    }

    #[test]
    fn a_reset_is_left_out_of_a_plan_and_nothing_else() {
        let mut plan = DensityPlan::new();
        let (kept, copy) = (plan.keep(2), plan.copy(1));
        [kept, copy].iter().for_each(|&row| plan.set(row, OPACITIES, &[-4.0]));
        plan.set(copy, "means", &[1.0, 2.0, 3.0]);
        plan.restart(OPACITIES);
        plan.restart("means");
        plan.report.cloned = 1;
        let other = without_reset(&plan);
        assert_eq!((other.parents(), other.fresh(), other.report), (plan.parents(), plan.fresh(), plan.report));
        assert_eq!((other.restarted(), other.values()), (&["means".to_string()][..], &plan.values()[1..]));
    }
}
