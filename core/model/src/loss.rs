//! Loss terms: what training minimises, as a weighted sum.

use crate::Plugin;
use crate::{Camera, Gaussians, Result, Schedule, View};
use burn::tensor::{Int, Tensor};

/// Input of a loss term: one view at one time. More may be added to it, so programs make one with [`LossInput::new`].
#[derive(Clone, Copy)]
#[non_exhaustive]
pub struct LossInput<'a> {
    /// Rendered planes `[5,H,W]`: red, green, blue as the camera records them (after the appearance model), alpha, depth. Depth is the sum of blending weight
    /// times z, not divided by alpha. Gradients flow through them. In the score stage (`[score_loss]`) the first three are the blended dynamic scores, and
    /// gradients reach nothing else.
    pub planes: &'a Tensor<3>,
    /// Recorded planes `[3,H,W]` in 0..1, or the mask `[1,H,W]` of the score stage.
    pub target: &'a Tensor<3>,
    /// Recorded depth `[1,H,W]`: along the z axis of the camera, in units of the scene, 0 where it is unknown. The rendered depth plane is to be compared with
    /// its product with alpha. `None` where the view has none, in the score stage, and unless a term [wants it](LossTerm::wants_depth).
    pub depth: Option<&'a Tensor<3>>,
    /// The camera of the view, at the size of the planes. Its name is that of the dataset.
    pub camera: &'a Camera,
    /// The view: its frame among those that the scene has, counted from 0, and its time.
    pub view: &'a View,
    /// The Gaussians as rendered at this time, with their attributes (opacities and scales before activation). Gradients flow through them. Attributes of a
    /// deformer are in [`Gaussians::extra`] during the main stage only.
    pub gaussians: &'a Gaussians,
    /// The same Gaussians before the deformer, row by row, with the same attributes; where nothing moves they are equal. Gradients flow through them, as
    /// through `gaussians`, to the values that training learns. With `train.sparse_adam` (the default) an iteration changes only Gaussians that one of its
    /// views shows. Where offsets are added, the difference of the two has a gradient for the deformer alone.
    pub canonical: &'a Gaussians,
    /// Screen radius in pixels `[N]`; 0 where the Gaussian was culled.
    pub radii: &'a Tensor<1, Int>,
    /// Normalised time of the view, 0..1.
    pub time_norm: f32,
    /// The current iteration of training.
    pub schedule: &'a Schedule,
}

impl<'a> LossInput<'a> {
    /// The input for static Gaussians (`canonical` is `gaussians`) without recorded depth. The arguments are the fields of the same names.
    pub fn new(
        camera: &'a Camera,
        view: &'a View,
        planes: &'a Tensor<3>,
        target: &'a Tensor<3>,
        gaussians: &'a Gaussians,
        radii: &'a Tensor<1, Int>,
        schedule: &'a Schedule,
    ) -> Self {
        Self { planes, target, depth: None, camera, view, gaussians, canonical: gaussians, radii, time_norm: view.time_norm, schedule }
    }
    /// The same view of Gaussians that a deformer moved from `canonical`, which has as many.
    pub fn moved_from(self, canonical: &'a Gaussians) -> Self {
        Self { canonical, ..self }
    }
    /// The same view with recorded `depth`, if there is some.
    pub fn with_depth(self, depth: Option<&'a Tensor<3>>) -> Self {
        Self { depth, ..self }
    }
}

/// One term of the loss.
pub trait LossTerm: Send {
    /// The value `[1]` for one view, without its weight; `None` if the term does not apply. Any other shape, and any error, ends the training. It is a mean
    /// over pixels or Gaussians, not a sum, so that weights mean the same at every image size and number of Gaussians. Add many numbers with
    /// [`ordered_sum`](crate::ordered_sum), whose bits do not depend on threads, and divide by their count.
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>>;
    /// Whether the term compares recorded depth, [`LossInput::depth`]. It is read for terms that do. Training refuses a scene without it.
    /// Fine-tuning and re-fit leave the term out with a warning, and refuse the scene where the loss has no other terms.
    fn wants_depth(&self) -> bool {
        false
    }
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
