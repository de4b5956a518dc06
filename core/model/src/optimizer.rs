//! Optimizers: from gradients to new values. The state (moments, step counts) belongs to the optimizer and is found by the name of the array.

use crate::Plugin;
use crate::{Error, Result};
use burn::tensor::{Int, Tensor};
use std::collections::BTreeMap;

/// One step of one array.
#[derive(Clone, Debug)]
pub struct StepSettings<'a> {
    /// Learning rate.
    pub lr: f64,
    /// Added to the denominator, where the optimizer has one.
    pub epsilon: f64,
    /// Rows `[N]` that are 0 keep values and state; `None` steps all rows.
    pub visible: Option<&'a Tensor<1, Int>>,
}

impl StepSettings<'_> {
    /// A step of all rows, with the epsilon of 3DGS.
    pub fn new(lr: f64) -> Self {
        Self { lr, epsilon: 1e-15, visible: None }
    }
}

/// What an optimizer keeps between steps, for checkpoints.
#[derive(Clone, Debug, Default)]
pub struct OptimizerState {
    /// Arrays `[N,W]` by name; the name begins with that of the array they belong to and a slash.
    pub arrays: BTreeMap<String, Tensor<2>>,
    /// Step counts by name of the array they belong to.
    pub steps: BTreeMap<String, u64>,
}

/// Steps named arrays along their gradients.
pub trait Optimizer: Send {
    /// The values after one step. `value` and `gradient` are `[N,W]`, plain tensors; an array that was not seen before starts with empty state.
    fn step(&mut self, name: &str, value: Tensor<2>, gradient: Tensor<2>, settings: &StepSettings) -> Result<Tensor<2>>;
    /// Forgets the state of all arrays whose names begin with `prefix`.
    fn restart(&mut self, prefix: &str);
    /// Rows of the arrays whose names begin with `prefix` changed: row i now stands for the old row `parents[i]`, and where `fresh[i]` is true its state starts from zero.
    fn select_rows(&mut self, prefix: &str, parents: &[usize], fresh: &[bool]) -> Result<()>;
    /// What checkpoints must keep.
    fn state(&self) -> OptimizerState;
    /// Takes back what [`Optimizer::state`] returned. It comes from a file: an error, never a panic.
    fn restore(&mut self, state: OptimizerState) -> Result<()>;
}

/// An optimizer in the registry.
pub struct OptimizerPlugin {
    /// Facts for people, tables and checks.
    pub info: Plugin,
    /// Builds the optimizer from the `[optimizer]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn Optimizer>>,
}
cc4dgs_format::plugin_kind!(OptimizerPlugin, "optimizer");

/// The state array `name`, or an error that names it.
pub fn state_array(state: &mut OptimizerState, name: &str) -> Result<Tensor<2>> {
    state
        .arrays
        .remove(name)
        .ok_or_else(|| Error::data(format!("optimizer state '{name}'"), "it is missing", "The checkpoint is damaged or of another optimizer"))
}
