//! The conformance suite of density controls.

use super::{guarded, settings_are_read, uniform};
use crate::{
    Camera, DensityControl, DensityPlan, DensityPlugin, Error, ExtraAttribute, Gaussians, HostGaussians, Result, Schedule, Seed, Split, Stage, Statistic, View,
    ViewStatistics, config,
};
use burn::tensor::{Device, Int, Tensor, TensorData};

/// Gaussians at the start.
const COUNT: usize = 40;
/// Largest number of Gaussians that a control may grow [`COUNT`] to.
const MOST: usize = 20 * COUNT;
/// Iterations of the suite's stages.
const ITERATIONS: usize = 320;
/// Frames of the suite's views.
const FRAMES: usize = 20;
/// Name of the extra attribute that identifies the Gaussians.
const LABEL: &str = "conformance-label";
/// Iterations between two plans that the suite makes without the control, as the trainer does, and the first of them.
const TRAINER_EVERY: usize = 64;
const TRAINER_FIRST: usize = 7;
/// The setting that bounds the number of Gaussians, and the bound that the suite states: little above [`COUNT`].
const MAX_GAUSSIANS: &str = "max_gaussians";
const BOUND: usize = COUNT + 4;

/// Tests a density control on `device`, with a coarse and a main stage of random statistics: two views per iteration, at the times of 20 frames.
/// Each finding is a line; an empty list means that it passed.
///
/// - Its schema is TOML and states the defaults; unknown settings are refused; nothing panics.
/// - Plans refer to existing rows and attributes, set finite values, never remove all Gaussians, and keep each row once at most; half of what they remove is
///   kept, and rows are put into another order, as the trainer may.
/// - Plans of the trainer, which it makes without asking, are followed: also before the first plan of the control's own.
/// - A control with a setting `max_gaussians` does not grow beyond it.
/// - Equal seeds give equal plans. State stored after any iteration continues with the same plans.
/// - Stored state of another size is an error.
/// - Gaussians without statistics, a single Gaussian, and centres and opacities that are not finite give plans or errors.
pub fn density(plugin: &DensityPlugin, settings: &toml::Table, device: &Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    guarded(
        &format!("{} on {device:?}", plugin.info.name),
        vec![
            ("settings", Box::new(|| suite.settings_are_read())),
            ("plans", Box::new(|| suite.plans_are_sound())),
            ("state", Box::new(|| suite.state_continues())),
            ("upper bound", Box::new(|| suite.upper_bound_is_kept())),
            ("odd inputs", Box::new(|| suite.odd_inputs_are_answered())),
        ],
    )
}

struct Suite<'a> {
    plugin: &'a DensityPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

/// The record of a run: the plan of every iteration, and the Gaussians at the end.
struct Run {
    plans: Vec<Option<DensityPlan>>,
    end: Gaussians,
}

impl Suite<'_> {
    fn build(&self) -> Result<Box<dyn DensityControl>> {
        (self.plugin.build)(self.settings)
    }
    fn settings_are_read(&self) -> Result<Option<String>> {
        settings_are_read("density", &self.plugin.info, self.settings, |settings| (self.plugin.build)(settings).map(drop))
    }
    fn gaussians(&self, count: usize) -> Gaussians {
        let seed = Seed::root(41);
        let mut g = HostGaussians { sh_degree: 1, ..Default::default() };
        for i in 0..count {
            let draw = |k: usize| uniform(seed.index(i as u64), k);
            g.means.extend([draw(0), draw(1), draw(2)]);
            g.log_scales.extend([-4.0 + 2.0 * draw(3), -4.0 + 2.0 * draw(4), -4.0 + 2.0 * draw(5)]);
            g.quaternions.extend([1.0 + 0.3 * draw(6), draw(7), draw(8), draw(9)]);
            g.opacity_logits.push(5.0 * draw(10));
            g.sh_dc.extend([draw(11), draw(12), draw(13)]);
            g.sh_rest.extend((0..9).map(|c| 0.1 * draw(14 + c)));
            g.dynamic_scores.push(draw(30));
        }
        g.extra.insert(LABEL.into(), ExtraAttribute::exact(1, (0..count).map(|i| i as f32).collect()));
        Gaussians::from_host(&g, self.device)
    }
    fn schedule(stage: Stage, iteration: usize) -> Schedule {
        Schedule { stage, iteration, total: 2 * ITERATIONS, ..Schedule::main(ITERATIONS) }
    }
    /// Random statistics of a camera's view of `count` Gaussians at `frame`; `wanted` lists the optional ones.
    fn view(&self, count: usize, wanted: &[Statistic], camera: usize, frame: usize, seed: Seed) -> ViewStatistics {
        let draw = |k: usize| uniform(seed, k);
        let radii: Vec<i64> = (0..count).map(|i| if draw(i) > -0.6 { 1 + (4.0 * (draw(i) + 1.0)) as i64 } else { 0 }).collect();
        let pair = |shift: usize, absolute: bool| {
            // One Gaussian in thirty has a gradient that asks for more of them.
            let size = |k: usize| if (k / 2).is_multiple_of(30) { 2e-5 } else { 1e-8 };
            let values: Vec<f32> = (0..2 * count).map(|k| size(k) * draw(shift + k)).map(|v| if absolute { v.abs() } else { v }).collect();
            Tensor::<2>::from_data(TensorData::new(values, [count, 2]), self.device)
        };
        let weights: Vec<f32> = (0..count).map(|i| 0.5 + 0.5 * draw(7 * count + i)).collect();
        let eye = [[4.0, 0.0, 1.0], [0.0, 4.0, 1.0]][camera];
        let view = View { camera, frame, time_norm: frame as f32 / (FRAMES - 1) as f32, split: Split::Train };
        let camera = Camera::look_at(&format!("conformance-{camera}"), (640, 360), 1.0, eye, [0.0; 3], [0.0, 0.0, 1.0]);
        let mut seen = ViewStatistics::new(camera, view, Tensor::<1, Int>::from_data(TensorData::new(radii, [count]), self.device));
        seen.screen_gradient = wanted.contains(&Statistic::ScreenGradient).then(|| pair(2 * count, false));
        seen.absolute_screen_gradient = wanted.contains(&Statistic::AbsoluteScreenGradient).then(|| pair(4 * count, true));
        seen.max_weights = wanted.contains(&Statistic::MaxWeight).then(|| Tensor::from_data(TensorData::new(weights, [count]), self.device));
        seen.views = 2;
        seen
    }
    /// One iteration: statistics, noise, plan. Returns the plan, which is sound, and the Gaussians that it is for.
    fn planned(&self, control: &mut dyn DensityControl, gaussians: Gaussians, schedule: &Schedule) -> Result<(Option<DensityPlan>, Gaussians)> {
        let seed = Seed::root(43).child(schedule.stage.name()).index(schedule.iteration as u64);
        let wanted = control.statistics(schedule);
        for camera in 0..2 {
            control.observe(&self.view(gaussians.len(), &wanted, camera, schedule.iteration % FRAMES, seed.index(camera as u64)))?;
        }
        let mut gaussians = gaussians;
        for (name, values) in control.after_step(&gaussians, schedule, seed.child("noise"))? {
            gaussians = replaced(&gaussians, &name, values)?;
        }
        control.hold(0);
        let plan = control.plan(&gaussians, schedule, seed.child("plan"))?;
        if let Some(plan) = &plan {
            plan.check(self.plugin.info.name, &gaussians)?;
            if let Some(row) = kept_twice(plan, gaussians.len()) {
                let remedy = "Keep it once, and add copies with DensityPlan::copy, which start without momentum";
                return Err(Error::backend("conformance", format!("a plan keeps row {row} twice, with its optimizer state"), remedy));
            }
        }
        Ok((plan, gaussians))
    }
    /// As [`Suite::planned`], and carries the plan out. Returns what was carried out and the Gaussians after it.
    fn iterate(&self, control: &mut dyn DensityControl, gaussians: Gaussians, schedule: &Schedule) -> Result<(Option<DensityPlan>, Gaussians)> {
        let (mut plan, mut gaussians) = self.planned(control, gaussians, schedule)?;
        if let Some(plan) = &mut plan {
            // The trainer may keep rows that a plan removes, and puts those that move first.
            let removed = plan.removed(gaussians.len());
            plan.restore(&removed[..removed.len() / 2]);
            let order: Vec<usize> = (0..plan.len()).step_by(2).chain((1..plan.len()).step_by(2)).collect();
            plan.reorder(&order);
            gaussians = self.execute(control, plan, &gaussians)?;
        }
        Ok((plan, gaussians))
    }
    fn execute(&self, control: &mut dyn DensityControl, plan: &DensityPlan, gaussians: &Gaussians) -> Result<Gaussians> {
        plan.check(self.plugin.info.name, gaussians)?;
        control.executed(plan, self.device)?;
        plan.apply(gaussians)
    }
    /// Both stages. With `stored_at`, state and control are stored and rebuilt after that iteration of the main stage.
    fn run(&self, stored_at: Option<usize>) -> Result<Run> {
        let mut control = self.build()?;
        let mut run = Run { plans: Vec::new(), end: self.gaussians(COUNT) };
        for stage in [Stage::Coarse, Stage::Main] {
            control.begin_stage(run.end.len(), self.device);
            if stage == Stage::Main {
                // As points of key frames are added.
                run.end = self.execute(control.as_mut(), &of_trainer(run.end.len(), true), &run.end)?;
            }
            for iteration in 1..=ITERATIONS {
                let (plan, next) = self.iterate(control.as_mut(), run.end, &Self::schedule(stage, iteration))?;
                (run.end, _) = (next, run.plans.push(plan));
                if iteration % TRAINER_EVERY == TRAINER_FIRST {
                    let adds = (iteration / TRAINER_EVERY).is_multiple_of(2);
                    run.end = self.execute(control.as_mut(), &of_trainer(run.end.len(), adds), &run.end)?;
                }
                if stage == Stage::Main && stored_at == Some(iteration) {
                    let state = control.state();
                    control = self.build()?;
                    control.restore(state, run.end.len())?;
                }
            }
        }
        Ok(run)
    }
    fn plans_are_sound(&self) -> Result<Option<String>> {
        // `config.toml` is completed from the schema, so that its settings must do what no settings do.
        let stated = config::parse_table(&format!("schema of density {}", self.plugin.info.name), self.plugin.info.schema)?;
        let (settings, of) = if self.settings.is_empty() { (&stated, ", one of them with the settings of its schema,") } else { (self.settings, "") };
        let again = Suite { plugin: self.plugin, settings, device: self.device };
        let (first, second) = (self.run(None)?, again.run(None)?);
        let differ = |what: &str| Ok(Some(format!("two runs with equal seeds{of} give different {what}")));
        if first.plans != second.plans {
            return differ("plans");
        }
        if first.end.len() > MOST {
            return Ok(Some(format!("{COUNT} Gaussians became {} in {} iterations", first.end.len(), 2 * ITERATIONS)));
        }
        let host = first.end.to_host()?;
        if let Err(e) = host.validate("Gaussians after all plans", &crate::Limits::default()) {
            return Ok(Some(e.to_string()));
        }
        if second.end.to_host()? != host {
            return differ("Gaussians");
        }
        let labels = host.extra.get(LABEL).map(|a| a.values.clone()).unwrap_or_default();
        let inherited = labels.len() == host.len() && labels.iter().all(|&l| l.fract() == 0.0 && (0.0..COUNT as f32).contains(&l));
        Ok((!inherited).then(|| "attributes of other plug-ins were changed".into()))
    }
    fn state_continues(&self) -> Result<Option<String>> {
        let whole = self.run(None)?;
        for at in [1, ITERATIONS / 3, ITERATIONS - 1] {
            if self.run(Some(at))?.plans != whole.plans {
                return Ok(Some(format!("after storing at iteration {at} of the main stage, it continues with other plans")));
            }
        }
        let mut control = self.build()?;
        control.begin_stage(COUNT, self.device);
        let state = control.state();
        if let Some((name, values)) = state.iter().find(|(_, values)| values.dims()[0] > 0) {
            let shorter: Vec<_> =
                state.iter().map(|(n, v)| (n.clone(), if n == name { v.clone().narrow(0, 0, values.dims()[0] - 1) } else { v.clone() })).collect();
            if self.build()?.restore(shorter, COUNT).is_ok() {
                return Ok(Some(format!("stored state '{name}' of another length was accepted")));
            }
        }
        let mut renamed = state;
        renamed.push(("conformance-no-such-array".into(), Tensor::zeros([COUNT], self.device)));
        Ok(self.build()?.restore(renamed, COUNT).is_ok().then(|| "stored state with an unknown array was accepted".into()))
    }
    fn upper_bound_is_kept(&self) -> Result<Option<String>> {
        let stated = config::parse_table(&format!("schema of density {}", self.plugin.info.name), self.plugin.info.schema)?;
        if !stated.contains_key(MAX_GAUSSIANS) {
            return Ok(None);
        }
        let mut settings = self.settings.clone();
        settings.insert(MAX_GAUSSIANS.into(), (BOUND as i64).into());
        let bounded = Suite { plugin: self.plugin, settings: &settings, device: self.device };
        let (mut control, mut gaussians) = (bounded.build()?, self.gaussians(COUNT));
        for stage in [Stage::Coarse, Stage::Main] {
            control.begin_stage(gaussians.len(), self.device);
            for iteration in 1..=ITERATIONS {
                let (plan, before) = bounded.planned(control.as_mut(), gaussians, &Self::schedule(stage, iteration))?;
                gaussians = before;
                let Some(plan) = plan else { continue };
                if plan.len() > BOUND.max(gaussians.len()) {
                    return Ok(Some(format!("with {MAX_GAUSSIANS} = {BOUND}, {} Gaussians become {}", gaussians.len(), plan.len())));
                }
                gaussians = bounded.execute(control.as_mut(), &plan, &gaussians)?;
            }
        }
        Ok(None)
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let mut odd = self.gaussians(5);
        odd.means = Tensor::from_floats([[f32::NAN, 0.0, 0.0], [f32::INFINITY, 0.0, 0.0], [0.0; 3], [0.0; 3], [0.0; 3]], self.device);
        // A control may move the faint Gaussian onto the others, but must not copy the one whose opacity is NaN.
        odd.opacity_logits = Tensor::from_floats([2.0, 2.0, -8.0, f32::NAN, 2.0], self.device);
        for gaussians in [self.gaussians(1), odd] {
            let mut control = self.build()?;
            let mut gaussians = gaussians;
            control.begin_stage(gaussians.len(), self.device);
            for iteration in 1..=ITERATIONS {
                let schedule = Self::schedule(Stage::Main, iteration);
                // No Gaussian was visible in any view.
                let Some(plan) = control.plan(&gaussians, &schedule, Seed::root(47).index(iteration as u64))? else { continue };
                gaussians = self.execute(control.as_mut(), &plan, &gaussians)?;
            }
        }
        Ok(None)
    }
}

/// A row of `count` that `plan` keeps more than once, with the momentum that it has in the optimizer.
fn kept_twice(plan: &DensityPlan, count: usize) -> Option<usize> {
    let mut kept = vec![false; count];
    let rows = plan.parents().iter().zip(plan.fresh()).filter(|(_, fresh)| !**fresh).map(|(&row, _)| row);
    rows.filter(|&row| row < count).find(|&row| std::mem::replace(&mut kept[row], true))
}

/// A plan that the trainer makes without asking the control: the rows are in another order, and a Gaussian is added (`adds`) or removed.
fn of_trainer(count: usize, adds: bool) -> DensityPlan {
    let mut plan = DensityPlan::new();
    let first = usize::from(!adds && count > 1);
    (first..count).rev().for_each(|row| {
        plan.keep(row);
    });
    if adds {
        plan.copy(0);
    }
    plan
}

/// `gaussians` with `values` `[N,width]` of the attribute `name`.
fn replaced(gaussians: &Gaussians, name: &str, values: Tensor<2>) -> Result<Gaussians> {
    let Some(old) = gaussians.attribute(name).filter(|old| old.dims() == values.dims()) else {
        let problem = format!("after_step returns '{name}' {:?}, but there is no attribute of this name and shape", values.dims());
        return Err(Error::backend("conformance", problem, "Return existing attributes, for all rows"));
    };
    drop(old);
    let all = gaussians.attribute_names().into_iter().filter_map(|n| Some((gaussians.attribute(&n)?, n)));
    Gaussians::from_attributes(gaussians.sh_degree, all.map(|(t, n)| if n == name { (n, values.clone()) } else { (n, t) }).collect::<Vec<_>>())
}
