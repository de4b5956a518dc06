//! Loss terms: what training minimises, as a weighted sum.

use crate::Plugin;
use crate::{Gaussians, Result, Schedule};
use burn::tensor::Tensor;

/// Input of a loss term: one view at one time.
pub struct LossInput<'a> {
    /// Rendered planes `[5,H,W]`: red, green, blue as the camera records them (after the appearance model), alpha, depth. Gradients flow through them. In the score
    /// stage (`[score_loss]`) the first three are the blended dynamic scores, and gradients reach nothing else.
    pub planes: &'a Tensor<3>,
    /// Recorded planes `[3,H,W]` in 0..1, or the mask `[1,H,W]` of the score stage.
    pub target: &'a Tensor<3>,
    /// The Gaussians as rendered at this time, with their attributes (opacities and scales before activation). Gradients flow through them.
    pub gaussians: &'a Gaussians,
    /// Screen radius in pixels `[N]`; 0 where the Gaussian was culled.
    pub radii: &'a Tensor<1, burn::tensor::Int>,
    /// Normalised time of the view, 0..1.
    pub time_norm: f32,
    /// The current iteration of training.
    pub schedule: &'a Schedule,
}

/// One term of the loss.
pub trait LossTerm: Send {
    /// The value `[1]` for one view, without its weight; `None` if the term does not apply. Any other shape, and any error, ends the training.
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>>;
}

/// A loss term in the registry.
pub struct LossPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the term from its `[[loss]]` section without `kind` and `weight`; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn LossTerm>>,
    /// Terms without settings whose weighted sum this one computes in one pass.
    pub fuses: Option<Fusion>,
}
cc4dgs_format::plugin_kind!(LossPlugin, "loss");

/// How a term replaces several others.
pub struct Fusion {
    /// Kinds of the terms it replaces.
    pub kinds: &'static [&'static str],
    /// Builds the term that returns the sum of those terms, weighted in that order.
    pub build: fn(weights: &[f64]) -> Result<Box<dyn LossTerm>>,
}
