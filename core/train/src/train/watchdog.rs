//! Finds values that are not finite at their source, goes back to the last good state, and lowers the learning rate of what caused them.
//!
//! - Every 100 iterations, in the last one of a stage, and before a checkpoint is written, loss, offsets, gradients and all parameters are looked at; loss and
//!   offsets also whenever the loss is logged. What is sound every 100 iterations is remembered, and nothing else: where the run goes back to does not depend
//!   on when it writes checkpoints and logs.
//! - Where something is not finite, the run goes back and repeats the iterations with a check of every loss, gradient and parameter, so that the first broken
//!   value is found. Iterations depend on seeds alone, so they repeat exactly, and it is the same value whenever the trouble was noticed.
//! - The part that it belongs to, or else the part that grew most since the good state, learns a quarter as fast from then on.
//! - After a few attempts the run ends with an error that names the source.
//!
//! Single broken Gaussians are no trouble: they are not drawn, and density control removes them, or the trainer before it writes a checkpoint. A run without
//! trouble computes nothing else than without this module.

use super::record::Attempts;
use super::{Context, TrainState};
use crate::gaussian_set::GaussianSet;
use crate::train::{Guard, Neighbours};
use burn::tensor::Tensor;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Error, Event, OptimizerState, Parameter, Result, plural};
use std::collections::BTreeMap;

/// Iterations between two good states.
const EVERY: usize = 100;
/// Times that a learning rate is lowered in a stage, and times that a stage is repeated to find a cause.
const ATTEMPTS: usize = 5;
/// Factor of a learning rate after trouble.
const LOWERED: f64 = 0.25;
/// Share of Gaussians that may be broken, or have such gradients or offsets; density control removes them, and optimizers skip such gradients.
pub(crate) const TOLERATED: f64 = 0.01;
/// Names of the parts beside `gaussians/ATTRIBUTE`.
const DEFORMER: &str = "deformer";

/// Something that is not finite.
#[derive(Clone, Debug)]
pub(crate) struct Trouble {
    /// What it is, as the subject of a sentence.
    pub what: String,
    /// The part whose learning rate is to blame, if that is known: `gaussians/means`, `deformer`, `appearance`, `poses`.
    pub part: Option<String>,
}

impl Trouble {
    pub fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), part: None }
    }
    pub fn of(part: impl Into<String>, what: impl Into<String>) -> Self {
        Self { what: what.into(), part: Some(part.into()) }
    }
}

/// Whether every value of `tensor` is finite: a sum is finite only if every summand is. `object` names it in errors.
///
/// # Errors
/// [`Error::Backend`] if the device fails.
pub(crate) fn is_finite<const D: usize>(tensor: &Tensor<D>, object: &str) -> Result<bool> {
    Ok(to_vec(tensor.clone().sum(), object)?.iter().all(|sum| sum.is_finite()))
}

/// How many rows of the `values` `[N,W]` of Gaussians are not finite, where they are more than is tolerated. `object` names them in errors.
///
/// # Errors
/// [`Error::Backend`] if the device fails.
fn too_many_broken(values: &Tensor<2>, object: &str) -> Result<Option<usize>> {
    if is_finite(values, object)? {
        return Ok(None);
    }
    let (rows, width) = (values.dims()[0], values.dims()[1].max(1));
    let broken = to_vec(values.clone(), object)?.chunks_exact(width).filter(|row| row.iter().any(|v| !v.is_finite())).count();
    Ok((broken as f64 > TOLERATED * rows as f64).then_some(broken))
}

/// The first of the `gradients` of Gaussians of which more rows are not finite than is tolerated.
///
/// # Errors
/// [`Error::Backend`] if the device fails.
pub(crate) fn broken_rows_of(gradients: &[(String, Tensor<2>)]) -> Result<Option<Trouble>> {
    for (name, gradient) in gradients {
        if let Some(broken) = too_many_broken(gradient, name)? {
            let what = format!("the gradient of {name} of {broken} of {} Gaussians", gradient.dims()[0]);
            return Ok(Some(Trouble::of(format!("gaussians/{name}"), what)));
        }
    }
    Ok(None)
}

/// Factors of learning rates by part; 1 where a part is not named.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RateFactors(pub BTreeMap<String, f64>);

impl RateFactors {
    /// The factor of a part.
    pub fn of(&self, part: &str) -> f64 {
        self.0.get(part).copied().unwrap_or(1.0)
    }
    pub(crate) fn of_gaussians(&self, attribute: &str) -> f64 {
        if self.0.is_empty() { 1.0 } else { self.of(&format!("gaussians/{attribute}")) }
    }
    pub(crate) fn of_deformer(&self) -> f64 {
        self.of(DEFORMER)
    }
}

/// A state to go back to.
struct Good {
    iteration: usize,
    set: GaussianSet,
    /// The settings of the deformer: it may be given lives on the way.
    section: Option<toml::Table>,
    deformer: Vec<Tensor<1>>,
    of_cameras: [Vec<Tensor<1>>; 2],
    optimizer: OptimizerState,
    density: Vec<(String, Tensor<1>)>,
    guard: Guard,
    smooth: bool,
    moving: cc4dgs_play::Moving,
    neighbours: Option<Neighbours>,
}

fn values(parameters: Vec<&Parameter>) -> Vec<Tensor<1>> {
    parameters.into_iter().map(|p| p.value.clone()).collect()
}

impl Good {
    fn of(state: &TrainState) -> Self {
        Self {
            iteration: state.iteration,
            set: state.set.clone(),
            section: state.deformer.as_ref().map(|d| d.section.clone()),
            deformer: state.deformer.as_ref().map(|d| values(d.field.parameters())).unwrap_or_default(),
            of_cameras: state.of_cameras().map(|(_, parameters)| values(parameters)),
            optimizer: state.optimizer.state(),
            density: state.density.state(),
            guard: state.guard.clone(),
            smooth: state.smooth,
            moving: state.moving,
            neighbours: state.neighbours.clone(),
        }
    }
    fn restore(&self, state: &mut TrainState, context: &Context) -> Result<()> {
        state.iteration = self.iteration;
        state.set = self.set.clone();
        if let Some(deformer) = &mut state.deformer {
            if let Some(section) = self.section.as_ref().filter(|section| **section != deformer.section) {
                deformer.field = context.job.registry.build_deformer(section, &deformer.context, &context.device)?;
                deformer.section = section.clone();
            }
            deformer.field.parameters_mut().into_iter().zip(&self.deformer).for_each(|(p, value)| p.value = value.clone());
        }
        for ((_, parameters), then) in state.of_cameras_mut().into_iter().zip(&self.of_cameras) {
            parameters.into_iter().zip(then).for_each(|(p, value)| p.value = value.clone());
        }
        state.optimizer.restart("");
        state.optimizer.restore(self.optimizer.clone())?;
        // What a control counts beside its arrays begins anew; the arrays continue.
        state.density.begin_stage(state.set.len(), &context.device);
        state.density.restore(self.density.clone(), state.set.len())?;
        state.guard = self.guard.clone();
        (state.smooth, state.moving) = (self.smooth, self.moving);
        state.invalidate_rows();
        state.neighbours = self.neighbours.clone();
        Ok(())
    }
}

/// Whether a state after `iteration` of a stage of `length` is remembered, if it is sound.
fn due(iteration: usize, length: usize) -> bool {
    iteration.is_multiple_of(EVERY) || iteration == length
}

/// The watchdog of one stage.
pub(crate) struct Watchdog {
    good: Good,
    attempts: Attempts,
}

impl Watchdog {
    /// `state` is good: nothing of the stage happened yet, or it comes from a checkpoint.
    pub fn new(state: &TrainState) -> Self {
        Self { good: Good::of(state), attempts: state.record.attempts }
    }
    /// Whether every value of an iteration of a stage of `length` is to be checked: where a source is looked for, and where the state may be gone back to or is
    /// about to be written, which `saves` says. A loss that is not finite leaves parameters finite, because optimizers skip such gradients.
    pub fn checks(&self, iteration: usize, length: usize, saves: bool) -> bool {
        self.looks_for_source(iteration) || due(iteration, length) || saves
    }
    fn looks_for_source(&self, iteration: usize) -> bool {
        iteration <= self.attempts.checked_until
    }
    /// After an iteration of `length`: looks at the parameters where it is time for it or where the state is about to be written, which `saves` says, and goes
    /// back where `trouble` was found before or is found now. [`Watchdog::remember`] comes after what else belongs to the iteration.
    ///
    /// # Errors
    /// [`Error::Backend`] that names the source, after too many attempts.
    pub fn after_iteration(&mut self, context: &Context, state: &mut TrainState, trouble: Option<Trouble>, length: usize, saves: bool) -> Result<()> {
        let iteration = state.iteration;
        let trouble = match trouble {
            None if self.checks(iteration, length, saves) => unsound(state)?,
            trouble => trouble,
        };
        if let Some(trouble) = trouble {
            self.go_back(context, state, trouble)?;
            state.record.attempts = self.attempts;
        }
        Ok(())
    }
    /// Remembers the sound `state` after an iteration of a stage of `length`, where it is time for it. Returns whether it did.
    pub fn remember(&mut self, state: &TrainState, length: usize) -> bool {
        let due = due(state.iteration, length);
        if due {
            self.good = Good::of(state);
        }
        due
    }
    /// Makes `state` the last one that was remembered, or the one that the watchdog began with.
    ///
    /// # Errors
    /// What building the deformer and restoring the state of plug-ins report.
    pub fn return_to_good(&self, context: &Context, state: &mut TrainState) -> Result<()> {
        self.good.restore(state, context)
    }

    fn go_back(&mut self, context: &Context, state: &mut TrainState, trouble: Trouble) -> Result<()> {
        let (iteration, stage) = (state.iteration, state.stage.name());
        let what = format!("{} at iteration {iteration} of stage {stage}", trouble.what);
        let warn = |message: String| context.job.events.emit(&Event::Warning { object: "watchdog".into(), message });
        if self.attempts.lowered >= ATTEMPTS || self.attempts.repeated > 2 * ATTEMPTS {
            return Err(Error::backend(
                what,
                format!("it is not finite, after learning rates were lowered {} {}", self.attempts.lowered, plural(self.attempts.lowered, "time", "times")),
                "Lower the learning rates (train.lr), choose another deformer or loss, or look at the images of this scene",
            ));
        }
        let part = match &trouble.part {
            Some(part) => part.clone(),
            None => fastest(state, &self.good)?,
        };
        self.good.restore(state, context)?;
        let back = self.good.iteration;
        // The first broken value is known only where every value before it was checked, those of this iteration too.
        if !self.looks_for_source(iteration) {
            self.attempts.repeated += 1;
            self.attempts.checked_until = iteration;
            warn(format!("{what}: it is not finite; back to iteration {back}, to find its source"));
            return Ok(());
        }
        self.attempts.lowered += 1;
        let factor = state.rates.of(&part) * LOWERED;
        state.rates.0.insert(part.clone(), factor);
        warn(format!("{what}: it is not finite; back to iteration {back}, and {part} learns {factor} times as fast as configured"));
        Ok(())
    }
}

/// The first parameter that is not finite.
fn unsound(state: &TrainState) -> Result<Option<Trouble>> {
    for (name, values) in state.set.iter() {
        if let Some(broken) = too_many_broken(values, name)? {
            return Ok(Some(Trouble::of(format!("gaussians/{name}"), format!("{name} of {broken} of {} Gaussians", state.set.len()))));
        }
    }
    let deformer = state.deformer.iter().flat_map(|d| d.field.parameters());
    let of_cameras = state.of_cameras().into_iter().flat_map(|(part, parameters)| parameters.into_iter().map(move |p| (part, p)));
    let weights = deformer.map(|p| (DEFORMER, p)).chain(of_cameras);
    for (part, parameter) in weights {
        if !is_finite(&parameter.value, &parameter.name)? {
            return Ok(Some(Trouble::of(part, format!("the weights '{}' of {part}", parameter.name))));
        }
    }
    Ok(None)
}

/// The part whose largest value grew most since `good`.
fn fastest(state: &TrainState, good: &Good) -> Result<String> {
    let mut best = ("gaussians/means".to_string(), 0.0f32);
    let mut consider = |part: String, now: f32, then: f32| {
        // Values that are not finite grew most. Values near zero have room to grow.
        let growth = if now.is_finite() { now / (then + 0.1) } else { f32::INFINITY };
        if growth > best.1 {
            best = (part, growth);
        }
    };
    let largest = |values: Vec<f32>| values.iter().fold(0.0f32, |a, v| if v.is_finite() { a.max(v.abs()) } else { f32::INFINITY });
    for (name, values) in state.set.iter() {
        // What was added since counts from zero.
        let then = good.set.get(name).ok().map(|then| to_vec(then.clone(), name)).transpose()?.unwrap_or_default();
        consider(format!("gaussians/{name}"), largest(to_vec(values.clone(), name)?), largest(then));
    }
    let deformer = state.deformer.as_ref().map(|d| values(d.field.parameters())).unwrap_or_default();
    let of_cameras = state.of_cameras().into_iter().zip(&good.of_cameras).map(|((part, parameters), then)| (part, values(parameters), then));
    for (part, now, then) in std::iter::once((DEFORMER, deformer, &good.deformer)).chain(of_cameras) {
        let mut sizes = [0.0f32; 2];
        for (size, arrays) in sizes.iter_mut().zip([&now, then]) {
            for array in arrays {
                *size = size.max(largest(to_vec(array.clone(), part)?));
            }
        }
        if !now.is_empty() {
            consider(part.into(), sizes[0], sizes[1]);
        }
    }
    Ok(best.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, TensorData};

    #[test]
    fn gradients_of_a_hundredth_of_the_gaussians_may_be_broken() {
        let of = |broken: usize| {
            let mut values = vec![0.5f32; 200];
            values.iter_mut().step_by(2).take(broken).for_each(|value| *value = f32::NAN);
            let gradient = Tensor::<2>::from_data(TensorData::new(values, [100, 2]), &Device::default());
            broken_rows_of(&[("means".to_string(), gradient)]).unwrap().map(|trouble| trouble.what)
        };
        assert_eq!((of(0), of(1)), (None, None));
        assert_eq!(of(2).as_deref(), Some("the gradient of means of 2 of 100 Gaussians"));
    }
}
