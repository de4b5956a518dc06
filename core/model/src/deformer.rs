//! The first seam: deformation fields.

use crate::Plugin;
use crate::{DeformerContext, Offsets, Result};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

/// Which share of the stored bytes a parameter counts towards (the paper's Deform-Grid and Deform-Net).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// Spatial encoding: tables, planes, or the decoders that replace them.
    Grid,
    /// Everything else.
    Net,
}

/// One named weight array of a field. The optimizer replaces `value`; the field reads it at every call.
#[derive(Clone, Debug)]
pub struct Parameter {
    /// Unique within the field.
    pub name: String,
    /// Which share of the bytes it counts towards.
    pub part: Part,
    /// The logical shape; `value` is flat.
    pub shape: Vec<usize>,
    /// The weights, flat [product of shape].
    pub value: Tensor<1>,
    /// Index into [`Deformer::groups`].
    pub group: usize,
}

/// How a set of parameters is optimised (Adam).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterGroup {
    /// For people and logs.
    pub name: String,
    /// Learning rate at the first step.
    pub lr_start: f64,
    /// Learning rate at the last step, reached log-linearly.
    pub lr_end: f64,
    /// Linear warm-up from zero over this share of the stage.
    pub warmup: f64,
    /// Whether the rates are multiplied by the extent of the cameras (as the Gaussians' positions are).
    pub times_extent: bool,
    /// Adam's epsilon.
    pub epsilon: f64,
    /// Gradient-norm clip over the whole group; 0 is off.
    pub clip_norm: f64,
}

impl ParameterGroup {
    /// Adam from `lr_start` to `lr_end`, with the epsilon of 3DGS and neither warm-up nor clipping.
    pub fn plain(name: &str, lr_start: f64, lr_end: f64) -> Self {
        Self { name: name.into(), lr_start, lr_end, warmup: 0.0, times_extent: false, epsilon: 1e-15, clip_norm: 0.0 }
    }
}

/// What a call cost, counted rather than timed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeformerWork {
    /// Gaussians asked about.
    pub gaussians: u64,
    /// Corner queries before reuse.
    pub vertices_queried: u64,
    /// Vertices actually decoded; in training on a GPU, where nobody waits for their number, the most there can have been.
    pub vertices_decoded: u64,
}

/// Time-invariant features of M Gaussians and what they cost.
#[derive(Clone, Debug)]
pub struct SpatialFeatures {
    /// Features [M, F]. Only the field itself reads them; what lies where is its own affair.
    pub values: Tensor<2>,
    /// The work done for them.
    pub work: DeformerWork,
}

/// A number or vector that a field keeps per Gaussian, learned beside its weights. It lives among the Gaussians' extra attributes: it grows and is pruned with
/// them, and goes into checkpoints and archives.
#[derive(Clone, Debug, PartialEq)]
pub struct AttributeSpec {
    /// Name of the extra attribute.
    pub name: String,
    /// Floats per Gaussian.
    pub width: usize,
    /// What every float starts as.
    pub start: f32,
    /// Floats start evenly spread so far to either side of `start`, by the run's seed.
    pub spread: f32,
    /// Learning rate (Adam).
    pub lr: f64,
    /// Whether the rate is multiplied by the extent of the cameras (as that of the positions is).
    pub times_extent: bool,
}

/// A deformation field: canonical Gaussians in, offsets at a time out (paper Section IV-B).
///
/// The time-invariant half is a call of its own so that playback can cache it; training recomputes it every step.
pub trait Deformer: Send {
    /// Features of the canonical centres `means_world` [M,3]; no gradient flows to the centres.
    fn spatial(&self, means_world: Tensor<2>) -> Result<SpatialFeatures>;
    /// What the field keeps per Gaussian; see [`Deformer::spatial_with`].
    fn attributes(&self) -> Vec<AttributeSpec> {
        Vec::new()
    }
    /// As [`Deformer::spatial`], for a field with [`Deformer::attributes`]: their values [M,width], in that order, through which gradients flow.
    fn spatial_with(&self, means_world: Tensor<2>, _attributes: &[Tensor<2>]) -> Result<SpatialFeatures> {
        self.spatial(means_world)
    }
    /// Offsets at `time_norm` in 0..1 for the M Gaussians of `features` [M,F]; the same heads at every time.
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets>;
    /// The same features as [`Deformer::deform`] reads them fastest. Playback asks for this once per spatial pass.
    fn packed(&self, features: Tensor<2>) -> Tensor<2> {
        features
    }
    /// The weights, in a fixed order.
    fn parameters(&self) -> Vec<&Parameter>;
    /// The weights for the optimizer and for loading, in the same order.
    fn parameters_mut(&mut self) -> Vec<&mut Parameter>;
    /// The optimizer groups that [`Parameter::group`] points into.
    fn groups(&self) -> Vec<ParameterGroup>;
    /// Whether playback may keep spatial features between frames.
    fn caches_spatial(&self) -> bool {
        true
    }
    /// Whether the field never moves anything, so that every stage may skip it.
    fn is_static(&self) -> bool {
        false
    }
    /// A regularisation term of the field's own, at `progress` in 0..1 of the main stage.
    fn regularizer(&self, _means_world: Tensor<2>, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        Ok(None)
    }
    /// Tells the field how far the main stage of training is, 0 to 1, before every step. A field that was never told is trained.
    fn set_progress(&mut self, _progress: f32) {}
    /// After training, a smaller field that does nearly the same: without what this scene does not use. `features` [M,F] are those of all Gaussians that move,
    /// `times` the normalised times of the frames.
    fn simplified(&self, _features: Tensor<2>, _times: &[f32]) -> Result<Option<Simplified>> {
        Ok(None)
    }
    /// Bytes of the weights as float32, per part: (grid, net).
    fn size_bytes(&self) -> (u64, u64) {
        let sum = |part| self.parameters().iter().filter(|p| p.part == part).map(|p| 4 * p.shape.iter().product::<usize>() as u64).sum();
        (sum(Part::Grid), sum(Part::Net))
    }
}

/// What [`Deformer::simplified`] returns.
pub struct Simplified {
    /// The smaller field.
    pub field: Box<dyn Deformer>,
    /// The settings that build it, without `kind`.
    pub settings: toml::Table,
    /// What was left out, for people.
    pub message: String,
}

/// A deformation field in the registry.
pub struct DeformerPlugin {
    /// Facts for people, tables and checks.
    pub info: Plugin,
    /// Builds a fresh field. The table is the `[deformer]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table, &DeformerContext, &Device) -> Result<Box<dyn Deformer>>,
}
crate::plugin_kind!(DeformerPlugin, "deformer");
