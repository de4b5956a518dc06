//! Appearance models: corrections between the rendered image and the recorded image of a training camera.

use crate::Plugin;
use crate::{Parameter, ParameterGroup, Result, Seed};
use burn::tensor::{Device, Tensor};

/// The properties of a scene that an appearance model is built for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AppearanceContext {
    /// Number of training cameras.
    pub cameras: usize,
    /// The model's node of the seed tree.
    pub seed: Seed,
}

/// Maps rendered planes to the planes that a camera records. Used in training only; held-out cameras and playback use the rendered image.
pub trait Appearance: Send {
    /// The planes `[5,H,W]` as training camera `camera` (0-based) records them; `None` is a camera that was not trained on, for which the model must be the
    /// identity. Alpha and depth are unchanged.
    fn apply(&self, planes: Tensor<3>, camera: Option<usize>) -> Result<Tensor<3>>;
    /// The weights, in a fixed order.
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    /// The weights for the optimizer and for loading, in the same order.
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    /// The optimizer groups that [`Parameter::group`] points into.
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
    /// An additional loss term `[1]`.
    fn regularizer(&self) -> Result<Option<Tensor<1>>> {
        Ok(None)
    }
}

/// An appearance model in the registry.
pub struct AppearancePlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the model from the `[appearance]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table, &AppearanceContext, &Device) -> Result<Box<dyn Appearance>>,
}
cc4dgs_format::plugin_kind!(AppearancePlugin, "appearance");
