//! What a density control must keep to.

use super::uniform;
use crate::gaussians::to_vec;
use crate::{DensityControl, DensityPlan, DensityPlugin, Gaussians, HostGaussians, Result, Schedule, Seed, Stage, Statistic, ViewStatistics, config};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_format::ExtraAttribute;
use std::panic::{AssertUnwindSafe, catch_unwind};

const GAUSSIANS: usize = 40;
/// Iterations of a simulated stage, long enough for rounds of any interval that shrinks with the run.
const LENGTH: usize = 120;
/// Where a simulated run is interrupted: between two rounds.
const INTERRUPTED: usize = 67;
const VIEWS: usize = 2;
const SIZE: (u32, u32) = (64, 48);

/// Holds a density control to its promises on `device`, in simulated stages whose plans are carried out:
/// - unknown settings are refused, and the schema builds what no settings build;
/// - plans name rows and attributes that exist and leave something; noise has the shape of its attribute and is finite; attributes of plug-ins are carried along;
/// - equal seeds give equal plans;
/// - a control restored from its state goes on as if it had not been interrupted, and a damaged state is refused;
/// - sets without Gaussians, and statistics that are not numbers, are answered.
///
/// `settings` is the `[density]` section without `kind`. Each finding is a line; an empty list is a pass.
pub fn density<'a>(plugin: &'a DensityPlugin, settings: &'a toml::Table, device: &'a Device) -> Vec<String> {
    let suite = Suite { plugin, settings, device };
    let checks: [(&str, Check<'a>); 6] = [
        ("settings", Suite::refuses_unknown_settings),
        ("schema", Suite::schema_states_the_defaults),
        ("plans", Suite::plans_repeat),
        ("checkpoints", Suite::state_carries_everything),
        ("damaged state", Suite::damaged_state_is_refused),
        ("odd inputs", Suite::odd_inputs_are_answered),
    ];
    let found = checks.into_iter().filter_map(|(name, check)| {
        let finding = match catch_unwind(AssertUnwindSafe(|| check(&suite))) {
            Ok(Ok(finding)) => finding?,
            Ok(Err(e)) => e.to_string(),
            Err(_) => "it panics".to_string(),
        };
        Some(format!("{} on {device:?}, {name}: {finding}", plugin.info.name))
    });
    found.collect()
}

struct Suite<'a> {
    plugin: &'a DensityPlugin,
    settings: &'a toml::Table,
    device: &'a Device,
}

/// One check: what it found, if anything.
type Check<'a> = fn(&Suite<'a>) -> Result<Option<String>>;

/// A stage under way.
struct Run {
    control: Box<dyn DensityControl>,
    set: HostGaussians,
    plans: Vec<(usize, DensityPlan)>,
}

impl Suite<'_> {
    fn refuses_unknown_settings(&self) -> Result<Option<String>> {
        let mut settings = self.settings.clone();
        settings.insert("no_such_setting".into(), 1.into());
        Ok(match (self.plugin.build)(&settings) {
            Ok(_) => Some("an unknown setting was accepted".into()),
            Err(e) if !e.to_string().contains("no_such_setting") => Some(format!("the error does not name the unknown setting: {e}")),
            Err(_) => None,
        })
    }
    /// `config.toml` is written in full from the schema, so that it must build what no settings build.
    fn schema_states_the_defaults(&self) -> Result<Option<String>> {
        let stated = config::parse_table(&format!("schema of density {}", self.plugin.info.name), self.plugin.info.schema)?;
        let (plain, full) = (self.stage(Stage::Coarse, &toml::Table::new(), LENGTH)?, self.stage(Stage::Coarse, &stated, LENGTH)?);
        Ok((plain.plans != full.plans).then(|| "the settings it states give other plans than no settings".to_string()))
    }
    fn plans_repeat(&self) -> Result<Option<String>> {
        for stage in [Stage::Coarse, Stage::Main] {
            let (first, second) = (self.stage(stage, self.settings, LENGTH)?, self.stage(stage, self.settings, LENGTH)?);
            if first.plans != second.plans || first.set != second.set {
                return Ok(Some(format!("equal seeds give other plans in the {} stage", stage.name())));
            }
        }
        Ok(None)
    }
    fn state_carries_everything(&self) -> Result<Option<String>> {
        let whole = self.stage(Stage::Main, self.settings, LENGTH)?;
        let mut parts = self.stage(Stage::Main, self.settings, INTERRUPTED)?;
        let (state, count) = (parts.control.state(), parts.set.len());
        parts.control = (self.plugin.build)(self.settings)?;
        parts.control.restore(state, count)?;
        self.advance(&mut parts, Stage::Main, INTERRUPTED + 1, LENGTH)?;
        Ok((whole.plans != parts.plans || whole.set != parts.set).then(|| "a restored control goes on differently".to_string()))
    }
    fn damaged_state_is_refused(&self) -> Result<Option<String>> {
        let run = self.stage(Stage::Main, self.settings, INTERRUPTED)?;
        for index in 0..run.control.state().len() {
            let (mut shortened, mut missing) = (run.control.state(), run.control.state());
            let (name, values) = shortened[index].clone();
            missing.remove(index);
            if values.dims()[0] < 2 {
                continue;
            }
            shortened[index].1 = values.narrow(0, 0, 1);
            for (state, problem) in [(shortened, "one value in place of all"), (missing, "the array missing")] {
                if (self.plugin.build)(self.settings)?.restore(state, run.set.len()).is_ok() {
                    return Ok(Some(format!("a state with {problem} of '{name}' was accepted")));
                }
            }
        }
        Ok(None)
    }
    fn odd_inputs_are_answered(&self) -> Result<Option<String>> {
        let mut empty = Run { control: (self.plugin.build)(self.settings)?, set: gaussians(0), plans: Vec::new() };
        empty.control.begin_stage(0, self.device);
        self.advance(&mut empty, Stage::Coarse, 1, LENGTH)?;
        let mut run = self.stage(Stage::Coarse, self.settings, 5)?;
        let n = run.set.len();
        let numberless = Tensor::<2>::full([n, 2], f32::NAN, self.device);
        let schedule = schedule(Stage::Coarse, 6);
        let wanted = run.control.statistics(&schedule);
        run.control.observe(&self.view(n, &wanted, 0, Some(numberless)))?;
        self.advance(&mut run, Stage::Coarse, 6, LENGTH)?;
        Ok(None)
    }
    /// The first `iterations` of a stage.
    fn stage(&self, stage: Stage, settings: &toml::Table, iterations: usize) -> Result<Run> {
        let mut run = Run { control: (self.plugin.build)(settings)?, set: gaussians(GAUSSIANS), plans: Vec::new() };
        run.control.begin_stage(run.set.len(), self.device);
        self.advance(&mut run, stage, 1, iterations)?;
        Ok(run)
    }
    /// Iterations `from` to `to` of a stage, both included, as the trainer runs them. Findings are errors.
    fn advance(&self, run: &mut Run, stage: Stage, from: usize, to: usize) -> Result<()> {
        for iteration in from..=to {
            let (schedule, seed) = (schedule(stage, iteration), Seed::root(41).index(iteration as u64));
            let wanted = run.control.statistics(&schedule);
            for view in 0..VIEWS {
                run.control.observe(&self.view(run.set.len(), &wanted, iteration * VIEWS + view, None))?;
            }
            let tensors = Gaussians::from_host(&run.set, self.device);
            for (name, values) in run.control.after_step(&tensors, &schedule, seed.child("noise"))? {
                let wanted = tensors.attribute(&name).map(|a| a.dims());
                let dims = values.dims();
                let values = to_vec(values, &name)?;
                if wanted != Some(dims) || values.iter().any(|v| !v.is_finite()) {
                    let problem = format!("after_step gives '{name}' the shape {dims:?} in place of {wanted:?}, or values that are not finite");
                    return Err(crate::Error::backend(format!("density {}", self.plugin.info.name), problem, "Correct it"));
                }
                set_rows(&mut run.set, &name, &(0..dims[0]).collect::<Vec<_>>(), &values);
            }
            let tensors = Gaussians::from_host(&run.set, self.device);
            if let Some(plan) = run.control.plan(&tensors, &schedule, seed.child("plan"))? {
                plan.check(self.plugin.info.name, &tensors)?;
                run.set = run.set.select(plan.parents());
                for values in plan.values() {
                    set_rows(&mut run.set, &values.attribute, &values.rows, &values.values);
                }
                run.plans.push((iteration, plan));
            }
        }
        Ok(())
    }
    /// Statistics of one view: those that were asked for. `gradient` replaces the random ones.
    fn view(&self, n: usize, wanted: &[Statistic], index: usize, gradient: Option<Tensor<2>>) -> ViewStatistics {
        let seed = Seed::root(42).index(index as u64);
        // Gradients about as large as those that ask for more Gaussians.
        let random = |salt: u64, width: usize, scale: f32| -> Vec<f32> { (0..n * width).map(|k| scale * uniform(seed.index(salt), k)).collect() };
        let two = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, [n, 2]), self.device);
        let asked = |statistic: Statistic| wanted.contains(&statistic).then_some(());
        let weights: Vec<f32> = random(3, 1, 0.5).into_iter().map(|v| v + 0.5).collect();
        let radii: Vec<i64> = (0..n).map(|i| if (i + index).is_multiple_of(3) { 0 } else { 4 }).collect();
        ViewStatistics {
            radii: Tensor::from_data(TensorData::new(radii, [n]), self.device),
            screen_gradient: asked(Statistic::ScreenGradient).map(|()| gradient.clone().unwrap_or_else(|| two(random(1, 2, 2e-5)))),
            absolute_screen_gradient: asked(Statistic::AbsoluteScreenGradient)
                .map(|()| gradient.unwrap_or_else(|| two(random(2, 2, 4e-5).into_iter().map(f32::abs).collect()))),
            max_weights: asked(Statistic::MaxWeight).map(|()| Tensor::from_data(TensorData::new(weights, [n]), self.device)),
            size: SIZE,
            views: VIEWS,
        }
    }
}

fn schedule(stage: Stage, iteration: usize) -> Schedule {
    Schedule { stage, iteration, total: 2 * LENGTH, sh_degree: 0, extent: 3.0, ..Schedule::main(LENGTH) }
}

/// Gaussians from faint to opaque, with an attribute of a plug-in.
fn gaussians(n: usize) -> HostGaussians {
    let random = |salt: u64, width: usize, middle: f32, half: f32| -> Vec<f32> {
        (0..n * width).map(|k| middle + half * uniform(Seed::root(43).index(salt), k)).collect()
    };
    HostGaussians {
        means: random(0, 3, 0.0, 1.0),
        log_scales: random(1, 3, -3.0, 1.5),
        quaternions: random(2, 4, 0.2, 1.0),
        opacity_logits: random(3, 1, -2.0, 5.0),
        sh_dc: random(4, 3, 0.0, 1.0),
        dynamic_scores: random(5, 1, 0.5, 0.5),
        extra: [("conformance".to_string(), ExtraAttribute::exact(2, random(6, 2, 0.0, 1.0)))].into(),
        ..Default::default()
    }
}

/// Gives `rows` of an attribute other values; names and widths were checked before.
fn set_rows(set: &mut HostGaussians, attribute: &str, rows: &[usize], values: &[f32]) {
    let column = match set.extra.get_mut(attribute) {
        Some(extra) => Some((extra.width, &mut extra.values)),
        None => set.columns_mut().into_iter().find(|(name, _, _)| *name == attribute).map(|(_, width, values)| (width, values)),
    };
    let Some((width, column)) = column else { return };
    for (&row, new) in rows.iter().zip(values.chunks_exact(width.max(1))) {
        column[row * width..(row + 1) * width].copy_from_slice(new);
    }
}
