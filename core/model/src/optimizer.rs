//! Optimizers: from gradients to new values. The optimizer owns its state (moments, step counts), which is stored by the name of the array.

use crate::Plugin;
use crate::{Error, Result};
use burn::tensor::{Int, Tensor};
use std::collections::BTreeMap;

/// Settings of one step of one array.
#[derive(Clone, Debug)]
pub struct StepSettings<'a> {
    /// Learning rate.
    pub lr: f64,
    /// Added to the denominator, if the optimizer has one.
    pub epsilon: f64,
    /// Rows `[N]` that are 0 keep values and state; `None` updates all rows.
    pub visible: Option<&'a Tensor<1, Int>>,
}

impl StepSettings<'_> {
    /// A step of all rows, with the epsilon of 3DGS.
    pub fn new(lr: f64) -> Self {
        Self { lr, epsilon: 1e-15, visible: None }
    }
}

/// The state of an optimizer between steps, for checkpoints.
#[derive(Clone, Debug, Default)]
pub struct OptimizerState {
    /// Arrays `[N,W]` by name; the name is that of the optimised array, a slash, and a suffix.
    pub arrays: BTreeMap<String, Tensor<2>>,
    /// Step counts by name of the optimised array.
    pub steps: BTreeMap<String, u64>,
}

/// Updates named arrays by their gradients.
pub trait Optimizer: Send {
    /// The values after one step. `value` and `gradient` are `[N,W]`, tensors without autodiff; a new array starts with zero state. In fine-tuning, where
    /// values are rounded, `value` is 0 and the caller adds the step to the values, in units of their quantisation steps: terms that depend on the size of
    /// values, such as weight decay, have no effect there.
    fn step(&mut self, name: &str, value: Tensor<2>, gradient: Tensor<2>, settings: &StepSettings) -> Result<Tensor<2>>;
    /// Removes the state of all arrays that `path` holds ([`path_holds`]). By a setting of its own an optimizer may keep its count of steps where `path` is the
    /// name of one array.
    fn restart(&mut self, path: &str);
    /// Reorders the state of the arrays that `path` holds ([`path_holds`]): row i is a copy of the old row `parents[i]`. Where `fresh[i]` is set, it starts
    /// without momentum, but its steps have the size of its parent's, unless a setting of the optimizer says otherwise.
    ///
    /// # Errors
    /// [`Error::Backend`] for rows that do not exist.
    fn select_rows(&mut self, path: &str, parents: &[usize], fresh: &[bool]) -> Result<()>;
    /// The state for checkpoints.
    fn state(&self) -> OptimizerState;
    /// Restores what [`Optimizer::state`] returned. It is untrusted: an error, never a panic.
    fn restore(&mut self, state: OptimizerState) -> Result<()>;
}

/// An optimizer in the registry.
pub struct OptimizerPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the optimizer from the `[optimizer]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn Optimizer>>,
}
cc4dgs_format::plugin_kind!(OptimizerPlugin, "optimizer");

/// Whether `path` holds the array `name`: it is the name, or the beginning of it up to a slash. `gaussians/` holds `gaussians/life`, which does not hold
/// `gaussians/life_gate`. The empty path holds all arrays.
pub fn path_holds(path: &str, name: &str) -> bool {
    let path = path.strip_suffix('/').unwrap_or(path);
    path.is_empty() || name.strip_prefix(path).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

/// Removes and returns the state array `name`.
///
/// # Errors
/// [`Error::Data`] if it is missing.
pub fn state_array(state: &mut OptimizerState, name: &str) -> Result<Tensor<2>> {
    state
        .arrays
        .remove(name)
        .ok_or_else(|| Error::data(format!("optimizer state '{name}'"), "it is missing", "The checkpoint is damaged or of another optimizer"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_ends_at_a_slash() {
        let held = |path: &str| ["gaussians/life", "gaussians/life_gate", "deformer/net"].map(|name| path_holds(path, name));
        assert_eq!(held("gaussians/life"), [true, false, false]);
        assert_eq!((held("gaussians/"), held("gaussians")), ([true, true, false], [true, true, false]));
        assert_eq!((held(""), held("gauss")), ([true; 3], [false; 3]));
    }
}
