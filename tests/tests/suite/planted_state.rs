//! Errors with state that conformance suites must find: deformers that remember their last input or mix Gaussians, density controls that count on making all
//! plans, and an optimizer in which new rows keep the momentum of others.

use super::planted::NoSettings;
use burn::tensor::{Device, Tensor};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, DensityControl, DensityPlan, DensityPlugin, Error, Gaussians, Offsets, Optimizer,
    OptimizerPlugin, OptimizerState, Parameter, ParameterGroup, Plugin, Registry, Result, Schedule, Seed, SpatialFeatures, SpatialInput, Statistic,
    StepSettings, ViewStatistics, config, conformance,
};
use std::cell::RefCell;

/// The error in [`Velocities`].
#[derive(Clone, Copy, PartialEq)]
enum Mistake {
    None,
    /// Offsets are those of the features that were computed last.
    Remembers,
    /// The offsets of a Gaussian depend on which others are asked about.
    Mixes,
}

/// A velocity per Gaussian.
struct Velocities {
    mistake: Mistake,
    last: RefCell<Option<Tensor<2>>>,
}

impl Deformer for Velocities {
    fn attributes(&self) -> Vec<AttributeSpec> {
        vec![AttributeSpec::new("velocity", 3, 0.0, 1e-3)]
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("velocities", &self.attributes())?;
        let velocity = input.attributes[0].clone();
        let values = if self.mistake == Mistake::Mixes && !input.is_empty() { velocity.clone() - velocity.mean_dim(0) } else { velocity };
        *self.last.borrow_mut() = Some(values.clone());
        Ok(SpatialFeatures { values, work: DeformerWork::default() })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let last = self.last.borrow().clone().filter(|_| self.mistake == Mistake::Remembers);
        Ok(Offsets { means: Some(last.unwrap_or(features).mul_scalar(time_norm)), ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
}

fn build_velocities(mistake: Mistake, settings: &toml::Table) -> Result<Box<dyn Deformer>> {
    let NoSettings {} = config::parse_section("deformer velocities", settings)?;
    Ok(Box::new(Velocities { mistake, last: RefCell::new(None) }))
}

type BuildDeformer = fn(&toml::Table, &DeformerContext, &Device) -> Result<Box<dyn Deformer>>;

#[test]
fn deformers_whose_offsets_depend_on_more_than_features_are_found() {
    let cases: [(BuildDeformer, &str); 3] = [
        (|settings, _, _| build_velocities(Mistake::None, settings), ""),
        (|settings, _, _| build_velocities(Mistake::Remembers, settings), "features: the same features give other offsets"),
        (|settings, _, _| build_velocities(Mistake::Mixes, settings), "rows: 17 Gaussians have other offsets alone than among 48"),
    ];
    for (build, wanted) in cases {
        let info = Plugin { name: "velocities", version: "1", summary: "a test", paper: "", schema: "# no settings\n", capabilities: &[] };
        let found = conformance::deformer(&DeformerPlugin { info, build }, &toml::Table::new(), &Device::flex()).join("\n");
        assert!(found.contains(wanted) && found.is_empty() == wanted.is_empty(), "expected '{wanted}' among:\n{found}");
    }
}

/// The error in [`Ages`].
#[derive(Clone, Copy, PartialEq)]
enum PlanMistake {
    None,
    /// Every plan that is carried out is taken for one of its own.
    ExpectsItsOwn,
    /// Plans of the trainer are not followed.
    IgnoresOthers,
    /// A Gaussian is added with the momentum of another one.
    KeepsTwice,
    /// There is no upper bound.
    NoBound,
}

/// Counts the views of every Gaussian, and copies one now and then.
struct Ages {
    mistake: PlanMistake,
    max_gaussians: usize,
    ages: Vec<f32>,
    /// Whether it has made the next plan that is carried out.
    own: bool,
}

impl DensityControl for Ages {
    fn begin_stage(&mut self, count: usize, _: &Device) {
        (self.ages, self.own) = (vec![0.0; count], false);
    }
    fn statistics(&self, _: &Schedule) -> Vec<Statistic> {
        Vec::new()
    }
    fn observe(&mut self, view: &ViewStatistics) -> Result<()> {
        let count = view.radii.dims()[0];
        if self.ages.len() != count {
            return Err(Error::backend("density ages", format!("{} ages of {count} Gaussians", self.ages.len()), "Follow every plan"));
        }
        self.ages.iter_mut().for_each(|age| *age += 1.0);
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, _: Seed) -> Result<Option<DensityPlan>> {
        self.own = schedule.iteration.is_multiple_of(10);
        if !self.own {
            return Ok(None);
        }
        let count = gaussians.len();
        let mut plan = DensityPlan::unchanged(count);
        if self.mistake == PlanMistake::KeepsTwice {
            plan.keep(0);
        } else if count < self.max_gaussians || self.mistake == PlanMistake::NoBound {
            plan.copy(count - 1);
        }
        Ok(Some(plan))
    }
    fn executed(&mut self, plan: &DensityPlan, _: &Device) -> Result<()> {
        let own = std::mem::take(&mut self.own);
        match self.mistake {
            PlanMistake::ExpectsItsOwn if !own => return Err(Error::backend("density ages", "it did not make this plan", "Ask it first")),
            PlanMistake::IgnoresOthers if !own => return Ok(()),
            _ => {}
        }
        let rows = plan.parents().iter().zip(plan.fresh());
        let ages = rows.map(|(&parent, &fresh)| if fresh { 0.0 } else { self.ages[parent] }).collect();
        self.ages = ages;
        Ok(())
    }
    fn state(&self) -> Vec<(String, Tensor<1>)> {
        vec![("ages".into(), Tensor::from_floats(self.ages.as_slice(), &Device::flex()))]
    }
    fn restore(&mut self, state: Vec<(String, Tensor<1>)>, count: usize) -> Result<()> {
        match state.as_slice() {
            [(name, ages)] if name == "ages" && ages.dims() == [count] => {
                self.ages = to_vec(ages.clone(), "ages")?;
                Ok(())
            }
            _ => Err(Error::data("density state", format!("it is not one array of {count} ages"), "Resume with the run's own config.toml")),
        }
    }
}

#[derive(serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Bound {
    max_gaussians: usize,
}

impl Default for Bound {
    fn default() -> Self {
        Self { max_gaussians: 1000 }
    }
}

fn build_ages(mistake: PlanMistake, settings: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let Bound { max_gaussians } = config::parse_section("density ages", settings)?;
    Ok(Box::new(Ages { mistake, max_gaussians, ages: Vec::new(), own: false }))
}

type BuildDensity = fn(&toml::Table) -> Result<Box<dyn DensityControl>>;

#[test]
fn density_controls_that_count_on_making_all_plans_are_found() {
    let cases: [(BuildDensity, &str); 5] = [
        (|settings| build_ages(PlanMistake::None, settings), ""),
        (|settings| build_ages(PlanMistake::ExpectsItsOwn, settings), "plans: density ages: it did not make this plan"),
        (|settings| build_ages(PlanMistake::IgnoresOthers, settings), "plans: density ages: 40 ages of 41 Gaussians"),
        (|settings| build_ages(PlanMistake::KeepsTwice, settings), "a plan keeps row 0 twice"),
        (|settings| build_ages(PlanMistake::NoBound, settings), "upper bound: with max_gaussians = 44, 44 Gaussians become 45"),
    ];
    for (build, wanted) in cases {
        let info = Plugin { name: "ages", version: "1", summary: "a test", paper: "", schema: "max_gaussians = 1000\n", capabilities: &[] };
        let found = conformance::density(&DensityPlugin { info, build }, &toml::Table::new(), &Device::flex()).join("\n");
        assert!(found.contains(wanted) && found.is_empty() == wanted.is_empty(), "expected '{wanted}' among:\n{found}");
    }
}

/// The optimizer `adam`, but rows that should start without momentum keep that of their parents.
struct Carried(Box<dyn Optimizer>);

impl Optimizer for Carried {
    fn step(&mut self, name: &str, value: Tensor<2>, gradient: Tensor<2>, settings: &StepSettings) -> Result<Tensor<2>> {
        self.0.step(name, value, gradient, settings)
    }
    fn restart(&mut self, path: &str) {
        self.0.restart(path);
    }
    fn select_rows(&mut self, path: &str, parents: &[usize], fresh: &[bool]) -> Result<()> {
        self.0.select_rows(path, parents, &vec![false; fresh.len()])
    }
    fn state(&self) -> OptimizerState {
        self.0.state()
    }
    fn restore(&mut self, state: OptimizerState) -> Result<()> {
        self.0.restore(state)
    }
}

fn build_carried(settings: &toml::Table) -> Result<Box<dyn Optimizer>> {
    Ok(Box::new(Carried((Registry::collect()?.optimizer("adam")?.build)(settings)?)))
}

#[test]
fn optimizers_that_carry_momentum_over_are_found() {
    let adam = Registry::collect().unwrap().optimizer("adam").unwrap();
    let plugin = OptimizerPlugin { info: adam.info.clone(), build: build_carried };
    let found = conformance::optimizer(&plugin, &toml::Table::new(), &Device::flex());
    assert!(found.len() == 1 && found[0].contains("momentum: without a gradient, fresh rows move by up to"), "{found:?}");
}
