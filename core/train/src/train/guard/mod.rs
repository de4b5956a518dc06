//! Keeps density control from destroying what is already fitted, whatever the control. `train.guard = false` switches all of it off: plans are then carried out
//! as they are.
//!
//! - Gaussians with values that are not finite always go. Of the others:
//! - Nothing is removed before the cameras of the stage had two passes to fit it, or a sixth of the stage: not at its beginning, and no Gaussian that is
//!   younger.
//! - A Gaussian that was drawn in fewer than 16 views stays longer, up to a sixth of the stage.
//! - One round removes at most a quarter of the Gaussians.
//! - A removal that costs more than 0.3 dB on training views at once is halved, the most opaque Gaussians being kept, and then left out.
//! - It is measured on images of the size and of the frames that are trained on at the time. When images grow or frames come in, scores before and after cannot
//!   be compared: what was lost before counts no more.
//! - After a removal that was measured, what training views lost must be back within a stated number of iterations, to within 0.3 dB. Until then removals
//!   together may cost no more than one; where the PSNR is lower, the next ones are put off. What is not back after three times as long has other causes.
//! - Where a measured removal made the Gaussians fewer, growth does not replace them until training views have the PSNR of before it, or that time is over
//!   as above.
//! - After an opacity reset, the PSNR of training views must be back within the same time; else the opacities return, and the stage has no more resets. A reset
//!   is left out where this time is not left, and while the last one is not back.

mod judge;

pub(crate) use judge::broken_rows;

use burn::tensor::{Int, Tensor};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, Error, Result, Schedule};
use judge::OPACITIES;

/// Passes over the cameras of a stage before a Gaussian may be removed.
const PATIENCE_PASSES: usize = 2;
/// The largest share of a stage that these passes, and the views below, may take.
const PATIENCE_SHARE: usize = 6;
/// The least iterations a Gaussian is given.
const LEAST_PATIENCE: usize = 50;
/// Views in which a Gaussian is drawn before it may be removed.
const VIEWS: f32 = 16.0;
/// Largest share of the Gaussians that one round removes.
const MAX_REMOVED: f64 = 0.25;
/// What one round may cost on training views, in dB.
const MAX_COST_DB: f32 = 0.3;
/// Iterations within which the PSNR must be back after an opacity reset or a removal, at least; and passes over the cameras.
const RECOVERY: usize = 400;
const RECOVERY_PASSES: usize = 4;
/// In [`Reset::logits`]: added since, with an opacity of its own, which an undone reset leaves as it is; or not finite before it. Finite, for checkpoints.
const ADDED: f32 = f32::MIN;
/// Multiple of that time after which a PSNR that is lower is not blamed on removals.
const GIVE_UP: usize = 3;

/// What the guard remembers between iterations.
#[derive(Clone, Debug, Default)]
pub struct Guard {
    /// Iteration of the stage in which each Gaussian was added; 0 for those it began with `[N]`.
    born: Vec<f32>,
    /// Views in which each Gaussian was drawn since then, up to the last plan `[N]`.
    drawn: Vec<f32>,
    /// Views since the last plan, on the device `[N]`.
    drawn_since: Option<Tensor<1, Int>>,
    /// The last removal that was measured, until the next one or a reset.
    removal: Option<Removal>,
    /// Number of removed Gaussians that growth may not replace yet; 0 without a removal.
    held: usize,
    /// The last opacity reset, until it is judged.
    reset: Option<Reset>,
    /// Whether an opacity reset of the stage was undone.
    resets_off: bool,
}

#[derive(Clone, Debug, PartialEq)]
struct Reset {
    iteration: usize,
    psnr_db: f32,
    /// Opacity logits before it, or [`ADDED`] `[N]`.
    logits: Vec<f32>,
}

impl Reset {
    /// A reset at `iteration`, before which training views had `psnr_db` and Gaussians the opacity logits `logits`.
    fn new(iteration: usize, psnr_db: f32, mut logits: Vec<f32>) -> Self {
        logits.iter_mut().filter(|logit| !logit.is_finite()).for_each(|logit| *logit = ADDED);
        Self { iteration, psnr_db, logits }
    }
}

#[derive(Clone, Debug, PartialEq)]
struct Removal {
    /// Iteration and PSNR from which losses count.
    iteration: usize,
    psnr_db: f32,
    /// Whether a message said that the PSNR is not back in time.
    reported: bool,
}

/// What the last removal means for the next.
#[derive(Debug, PartialEq)]
enum Standing {
    /// It may go; its loss counts from here.
    Back(Removal),
    /// It is put off.
    Waiting,
    /// It is put off, and the time is over: the removal that is not back, to be reported.
    Overdue(Removal),
}

/// Iterations that the PSNR has to come back.
fn recovery(schedule: &Schedule) -> usize {
    RECOVERY.max(RECOVERY_PASSES * schedule.pass)
}

impl Guard {
    /// A stage begins with `count` Gaussians.
    pub fn begin_stage(&mut self, count: usize) {
        *self = Self { born: vec![0.0; count], drawn: vec![0.0; count], ..Self::default() };
    }
    /// Whether it counts for so many Gaussians: not before the first stage that has an iteration begins.
    pub(super) fn counts(&self, gaussians: usize) -> bool {
        self.born.len() == gaussians
    }
    /// A training view drew the Gaussians with these radii, 0 where it did not `[N]`. Nothing is read from the device.
    pub(super) fn saw(&mut self, radii: &Tensor<1, Int>) {
        if radii.dims()[0] == self.born.len() {
            let drawn = radii.clone().clamp(0, 1);
            self.drawn_since = Some(match self.drawn_since.take() {
                Some(sum) => sum + drawn,
                None => drawn,
            });
        }
    }
    /// Number of removed Gaussians that growth may not replace yet: training views have not recovered from their removal.
    pub(super) fn held(&self) -> usize {
        self.held
    }
    /// Views in which each Gaussian was drawn `[N]`.
    fn drawn_until_now(&self) -> Result<Vec<f32>> {
        let Some(since) = &self.drawn_since else { return Ok(self.drawn.clone()) };
        Ok(self.drawn.iter().zip(to_vec(since.clone().float(), "views of Gaussians")?).map(|(before, since)| before + since).collect())
    }
    /// Reads the count of views from the device.
    fn read_views(&mut self) -> Result<()> {
        self.drawn = self.drawn_until_now()?;
        self.drawn_since = None;
        Ok(())
    }
    /// Arrays for checkpoints, by name.
    pub fn state(&self) -> Vec<(String, Vec<f32>)> {
        // A device that cannot be read fails the checkpoint at its Gaussians.
        let drawn = self.drawn_until_now().unwrap_or_else(|_| self.drawn.clone());
        let mut arrays = vec![("born".to_string(), self.born.clone()), ("drawn".into(), drawn)];
        if let Some(removal) = &self.removal {
            arrays.push(("removal".into(), vec![removal.iteration as f32, removal.psnr_db, f32::from(removal.reported)]));
        }
        if self.held > 0 {
            // Up to 16,777,216 a float32 is exact.
            arrays.push(("held".into(), vec![self.held as f32]));
        }
        if let Some(reset) = &self.reset {
            arrays.push(("reset".into(), vec![reset.iteration as f32, reset.psnr_db]));
            arrays.push(("logits".into(), reset.logits.clone()));
        }
        if self.resets_off {
            arrays.push(("resets_off".into(), vec![1.0]));
        }
        arrays
    }
    /// What [`Guard::state`] returned, for `count` Gaussians.
    ///
    /// # Errors
    /// [`Error::Data`] for arrays of another length or name.
    pub fn restore(state: Vec<(String, Vec<f32>)>, count: usize) -> Result<Self> {
        let damaged = |problem: String| Error::data("checkpoint: guard of density control", problem, "Use another checkpoint of the run");
        let (mut born, mut drawn, mut removal, mut held) = (None, None, None, None);
        let (mut numbers, mut logits, mut resets_off) = (None, None, None);
        for (name, values) in state {
            let (slot, length) = match name.as_str() {
                "born" => (&mut born, count),
                "drawn" => (&mut drawn, count),
                "removal" => (&mut removal, 3),
                "held" => (&mut held, 1),
                "reset" => (&mut numbers, 2),
                "logits" => (&mut logits, count),
                "resets_off" => (&mut resets_off, 1),
                _ => return Err(damaged(format!("there is no array '{name}'"))),
            };
            if values.len() != length || values.iter().any(|v| !v.is_finite()) {
                return Err(damaged(format!("'{name}' has {} values for {count} Gaussians, or some that are not finite", values.len())));
            }
            *slot = Some(values);
        }
        let whole = |number: f32| number.clamp(0.0, 1e9) as usize;
        let reset = match (numbers.as_deref(), logits) {
            (Some([at, psnr_db]), Some(logits)) => Some(Reset { iteration: whole(*at), psnr_db: *psnr_db, logits }),
            (None, None) => None,
            _ => return Err(damaged("half of an opacity reset is missing".into())),
        };
        let removal = match removal.as_deref() {
            Some([at, psnr_db, reported]) => Some(Removal { iteration: whole(*at), psnr_db: *psnr_db, reported: *reported > 0.0 }),
            _ => None,
        };
        let held = match held.as_deref() {
            Some([count]) => whole(*count),
            _ => 0,
        };
        // Older programs counted no views.
        let drawn = drawn.unwrap_or_else(|| vec![0.0; count]);
        let born = born.ok_or_else(|| damaged("'born' is missing".into()))?;
        Ok(Self { born, drawn, drawn_since: None, removal, held, reset, resets_off: resets_off.is_some() })
    }
    /// The Gaussians are those of `plan` now. Call [`Guard::read_views`] first.
    fn follow(&mut self, plan: &DensityPlan, iteration: usize) {
        let of = |old: &[f32], new: f32| plan.parents().iter().zip(plan.fresh()).map(|(&parent, &fresh)| if fresh { new } else { old[parent] }).collect();
        (self.born, self.drawn) = (of(&self.born, iteration as f32), of(&self.drawn, 0.0));
        if let Some(reset) = &mut self.reset {
            reset.logits = plan.parents().iter().map(|&parent| reset.logits[parent]).collect();
            // The reset itself sets the opacities of all rows.
            if !plan.restarted().iter().any(|name| name == OPACITIES) {
                let given = plan.values().iter().filter(|set| set.attribute == OPACITIES).flat_map(|set| &set.rows);
                given.filter(|&&row| plan.fresh()[row]).for_each(|&row| reset.logits[row] = ADDED);
            }
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
    /// Whether the Gaussian `row` is too young, or was drawn in too few views, to be judged.
    fn is_young(&self, row: usize, schedule: &Schedule) -> bool {
        let most = (schedule.length / PATIENCE_SHARE).max(LEAST_PATIENCE);
        let patience = (PATIENCE_PASSES * schedule.pass).clamp(LEAST_PATIENCE, most);
        let age = schedule.iteration.saturating_sub(self.born[row] as usize);
        age < patience || (age < most && self.drawn[row] < VIEWS)
    }
    /// Whether the next removal may go, where training views have `psnr_db` now. Within the time that the last one has to come back, losses count from before
    /// it.
    fn standing(&self, psnr_db: f32, schedule: &Schedule) -> Standing {
        let now = Removal { iteration: schedule.iteration, psnr_db, reported: false };
        let Some(last) = &self.removal else { return Standing::Back(now) };
        let over = schedule.iteration >= last.iteration + recovery(schedule);
        let near = psnr_db >= last.psnr_db - MAX_COST_DB;
        match () {
            () if psnr_db >= last.psnr_db || (near && over) => Standing::Back(now),
            () if near => Standing::Back(last.clone()),
            () if over && !last.reported => Standing::Overdue(last.clone()),
            // Other causes last: smoothness that was switched on, say.
            () if schedule.iteration >= last.iteration + GIVE_UP * recovery(schedule) && psnr_db.is_finite() => Standing::Back(now),
            () => Standing::Waiting,
        }
    }
    /// Growth may replace all removed Gaussians where what their removal cost is back, and losses count from this iteration.
    fn release(&mut self, standing: &Standing, schedule: &Schedule) {
        if matches!(standing, Standing::Back(from) if from.iteration == schedule.iteration) {
            self.held = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_young_are_spared_and_rows_are_followed() {
        let mut guard = Guard::default();
        guard.begin_stage(3);
        guard.drawn = vec![VIEWS; 3];
        let at = |iteration| Schedule { iteration, pass: 100, ..Schedule::main(6000) };
        assert!(guard.is_young(0, &at(199)) && !guard.is_young(0, &at(200)));
        let mut plan = DensityPlan::new();
        plan.keep(2);
        plan.copy(1);
        guard.reset = Some(Reset { iteration: 250, psnr_db: 20.0, logits: vec![0.0, 1.0, 2.0] });
        guard.follow(&plan, 300);
        assert!(!guard.is_young(0, &at(320)) && guard.is_young(1, &at(320)));
        assert_eq!(guard.drawn, [VIEWS, 0.0]);
        assert_eq!(guard.reset.as_ref().unwrap().logits, [2.0, 1.0]);
        guard.removal = Some(Removal { iteration: 290, psnr_db: 21.0, reported: true });
        assert_eq!(Guard::restore(guard.state(), 2).unwrap().state(), guard.state());
        assert!(Guard::restore(guard.state(), 3).is_err());
        let half: Vec<_> = guard.state().into_iter().filter(|(name, _)| name != "logits").collect();
        assert!(Guard::restore(half, 2).is_err());
    }

    #[test]
    fn only_what_the_reset_changed_returns() {
        let reset = || Some(Reset { iteration: 250, psnr_db: 20.0, logits: vec![1.0, 2.0] });
        let mut plan = DensityPlan::unchanged(2);
        let (copy, given) = (plan.copy(1), plan.copy(1));
        [0, given].iter().for_each(|&row| plan.set(row, OPACITIES, &[-1.0]));
        let followed = |plan: &DensityPlan| {
            let mut guard = Guard::default();
            guard.begin_stage(2);
            guard.reset = reset();
            guard.follow(plan, 300);
            assert_eq!(Guard::restore(guard.state(), plan.len()).unwrap().reset, guard.reset);
            guard.reset.unwrap().logits
        };
        let after = followed(&plan);
        assert_eq!((copy, given), (2, 3));
        assert_eq!(after, [1.0, 2.0, 2.0, ADDED], "a copy is as opaque as its parent was, unless it was given an opacity");
        assert_eq!((-1.0f32).max(after[given]), -1.0);
        plan.restart(OPACITIES);
        assert_eq!(followed(&plan), [1.0, 2.0, 2.0, 2.0], "the opacities of the reset itself");
        let broken = Reset::new(250, 20.0, vec![f32::NAN, 1.0, f32::INFINITY]);
        assert_eq!(broken.logits, [ADDED, 1.0, ADDED], "checkpoints refuse what is not finite");
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

    #[test]
    fn what_few_views_drew_stays_up_to_a_share_of_the_stage() {
        let device = burn::tensor::Device::flex();
        let mut guard = Guard::default();
        guard.begin_stage(2);
        let at = |iteration| Schedule { iteration, pass: 10, ..Schedule::main(6000) };
        for view in 0..VIEWS as usize {
            let radii = Tensor::<1, Int>::from_ints([3, i32::from(view > 0)], &device);
            guard.saw(&radii);
        }
        // A checkpoint between two plans keeps what the device counted.
        guard = Guard::restore(guard.state(), 2).unwrap();
        assert!(guard.is_young(0, &at(49)) && !guard.is_young(0, &at(50)));
        assert!(guard.is_young(1, &at(999)) && !guard.is_young(1, &at(1000)), "views that never draw it do not keep it for ever");
        guard.saw(&Tensor::<1, Int>::from_ints([0, 7], &device));
        guard.read_views().unwrap();
        assert!(!guard.is_young(1, &at(50)) && guard.drawn == [VIEWS; 2]);
    }

    #[test]
    fn losses_of_removals_do_not_add_up() {
        let at = |iteration| Schedule { iteration, ..Schedule::main(30_000) };
        let removal = |iteration, psnr_db| Removal { iteration, psnr_db, reported: false };
        let mut guard = Guard::default();
        assert_eq!(guard.standing(25.0, &at(1000)), Standing::Back(removal(1000, 25.0)));
        guard.removal = Some(removal(1000, 25.0));
        // Within the time, losses count from the PSNR before it.
        assert_eq!(guard.standing(24.75, &at(1100)), Standing::Back(removal(1000, 25.0)));
        assert_eq!(guard.standing(25.5, &at(1100)), Standing::Back(removal(1100, 25.5)));
        assert_eq!(guard.standing(24.6, &at(1100)), Standing::Waiting);
        assert_eq!(guard.standing(f32::NAN, &at(1100)), Standing::Waiting);
        // Afterwards what is not back is reported once.
        assert_eq!(guard.standing(24.75, &at(1400)), Standing::Back(removal(1400, 24.75)));
        assert_eq!(guard.standing(24.6, &at(1400)), Standing::Overdue(removal(1000, 25.0)));
        guard.removal = Some(Removal { reported: true, ..removal(1000, 25.0) });
        assert_eq!(guard.standing(24.6, &at(2100)), Standing::Waiting);
        // What does not come back has other causes.
        assert_eq!(guard.standing(24.6, &at(2200)), Standing::Back(removal(2200, 24.6)));
        assert_eq!(guard.standing(f32::NAN, &at(2200)), Standing::Waiting);
    }

    #[test]
    fn growth_is_held_until_what_the_removal_cost_is_back() {
        let at = |iteration| Schedule { iteration, ..Schedule::main(30_000) };
        let guard = Guard { removal: Some(Removal { iteration: 1000, psnr_db: 25.0, reported: true }), held: 7, ..Guard::default() };
        for (psnr_db, iteration, held) in [(24.9, 1100, 7), (24.6, 1399, 7), (25.0, 1100, 0), (24.75, 1400, 0), (24.6, 1400, 7), (24.0, 2200, 0)] {
            let mut guard = guard.clone();
            let standing = guard.standing(psnr_db, &at(iteration));
            guard.release(&standing, &at(iteration));
            assert_eq!(guard.held(), held, "{psnr_db} dB at {iteration}");
        }
        assert_eq!(Guard::restore(guard.state(), 0).unwrap().held(), 7);
    }
}
