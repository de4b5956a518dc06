//! What a step of fine-tuning draws in place of the values that it changes (the straight-through estimator, Bengio et al. 2013).

use super::TrainState;
use crate::gaussian_set::GaussianSet;
use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Parameter, Result, StepSettings};
use std::collections::BTreeMap;

/// Rounded values of all Gaussians and weights.
pub(crate) struct Rounded {
    /// Gaussians as they will be decoded.
    pub gaussians: GaussianSet,
    /// The distance of neighbouring values by attribute `[N,width]`; attributes without one stay as they are.
    pub steps: BTreeMap<String, Tensor<2>>,
    /// What is added to the derivatives by values in steps, by attribute `[N,width]`: those of the size.
    pub size: BTreeMap<String, Tensor<2>>,
    /// Learning rate in steps.
    pub rate: f64,
    /// Weights of the deformer as they will be decoded, in the order of its parameters; the deformer's own lie in `exact_weights` between
    /// [`Rounded::exchange_weights`] and the step.
    pub weights: Vec<Tensor<1>>,
    /// The weights' steps, where they have some; `None` in place of an array that has none.
    pub weight_scales: Option<Vec<Option<WeightScale>>>,
    /// The weights that were exchanged.
    pub exact_weights: Vec<Tensor<1>>,
}

/// An array of weights in steps.
#[derive(Clone)]
pub(crate) struct WeightScale {
    /// The distances of neighbouring values.
    pub steps: Tensor<1>,
    /// What is added to the derivatives by values in steps: those of the size.
    pub size: Tensor<1>,
}

/// What the optimizer steps in place of tracked weights.
#[derive(Default)]
pub(crate) struct ExactWeights {
    /// The values before rounding; empty where nothing is rounded.
    pub values: Vec<Tensor<1>>,
    /// Their steps, array by array, where they have some.
    pub scales: Option<Vec<Option<WeightScale>>>,
    /// Learning rate in steps.
    pub rate: f64,
}

impl Rounded {
    /// Gives a deformer the rounded weights and keeps its own.
    pub fn exchange_weights(&mut self, parameters: Vec<&mut Parameter>) {
        self.exact_weights = parameters.into_iter().zip(&self.weights).map(|(p, rounded)| std::mem::replace(&mut p.value, rounded.clone())).collect();
    }
    /// The exchanged weights, with their steps.
    pub fn exact(&mut self) -> ExactWeights {
        ExactWeights { values: std::mem::take(&mut self.exact_weights), scales: self.weight_scales.take(), rate: self.rate }
    }
    /// One optimizer step of the attributes that have steps. Values are measured in their steps, so that one learning rate does for all: the codec chose steps
    /// that change images alike.
    pub fn step_gaussians(&mut self, state: &mut TrainState, gradients: Vec<(String, Tensor<2>)>, visible: Option<&Tensor<1, Int>>) -> Result<()> {
        let mut gradients: BTreeMap<String, Tensor<2>> = gradients.into_iter().collect();
        let settings = StepSettings { visible, ..StepSettings::new(self.rate) };
        for (name, slot) in state.set.slots() {
            let (Some(steps), Some(gradient)) = (self.steps.get(name), gradients.remove(name)) else { continue };
            let mut gradient = gradient * steps.clone();
            if let Some(size) = self.size.get(name) {
                gradient = gradient + size.clone();
            }
            let moved = state.optimizer.step(&format!("gaussians/{name}"), gradient.zeros_like(), gradient, &settings)?;
            *slot = slot.clone() + moved * steps.clone();
        }
        Ok(())
    }
}
