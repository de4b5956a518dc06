//! The deformer trait (deformation fields), its inputs and parameters.

use crate::gaussians::{CORE_ATTRIBUTES, first_rows};
use crate::storage::value_count;
use crate::{DeformerContext, Error, HostGaussians, Offsets, Plugin, Result};
use burn::tensor::{Device, Int, Tensor};
use serde::{Deserialize, Serialize};

/// The part of a model's size that a parameter is counted in (the paper's Deform-Grid and Deform-Net).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Part {
    /// Spatial encoding: tables, planes, or the decoders that replace them.
    Grid,
    /// Everything else.
    Net,
}

/// A named weight array of a deformer. The optimizer replaces `value`; the deformer reads it at every call.
#[derive(Clone, Debug)]
pub struct Parameter {
    /// Unique within the deformer.
    pub name: String,
    /// The part of the size that it is counted in.
    pub part: Part,
    /// The logical shape; `value` is flat.
    pub shape: Vec<usize>,
    /// The weights, flat `[product of shape]`.
    pub value: Tensor<1>,
    /// Index into [`Deformer::groups`].
    pub group: usize,
}

/// How a set of parameters is optimised (Adam).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterGroup {
    /// Display name.
    pub name: String,
    /// Learning rate at the first step.
    pub lr_start: f64,
    /// Learning rate at the last step, reached log-linearly.
    pub lr_end: f64,
    /// Linear warm-up from zero over this share of the stage.
    pub warmup: f64,
    /// Whether the rates are multiplied by the extent of the cameras in the normalised frame, [`crate::Scene::extent`] (as those of the Gaussians' positions
    /// are).
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

/// Counts of the work of a call.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeformerWork {
    /// Number of Gaussians.
    pub gaussians: u64,
    /// Vertices needed before reuse: eight per Gaussian and level.
    pub vertices_queried: u64,
    /// Vertices decoded. In training on a GPU the upper bound, because the exact number is not read back.
    pub vertices_decoded: u64,
}

/// Time-invariant features of M Gaussians and the work done for them.
#[derive(Clone, Debug)]
pub struct SpatialFeatures {
    /// Features `[M, F]`. Only the deformer itself reads them; their layout is its own.
    pub values: Tensor<2>,
    /// The work done for them.
    pub work: DeformerWork,
}

/// Input of the time-invariant half of a deformer: M Gaussians.
#[derive(Clone, Debug)]
pub struct SpatialInput {
    /// Canonical centres in world units `[M,3]`. They are constants: no gradient flows to them.
    pub means_world: Tensor<2>,
    /// Values `[M,width]` of [`Deformer::attributes`], in that order. Gradients flow through them.
    pub attributes: Vec<Tensor<2>>,
}

impl SpatialInput {
    /// Input for a deformer without attributes: centres `[M,3]` in world units.
    pub fn new(means_world: Tensor<2>) -> Self {
        Self { means_world, attributes: Vec::new() }
    }
    /// Centres `[M,3]` in world units, with the start value of each attribute of `deformer`.
    pub fn at_start(means_world: Tensor<2>, deformer: &dyn Deformer) -> Self {
        let (m, device) = (means_world.dims()[0], means_world.device());
        let attributes = deformer.attributes().iter().map(|a| Tensor::full([m, a.width], a.start, &device)).collect();
        Self { means_world, attributes }
    }
    /// The number of Gaussians M.
    pub fn len(&self) -> usize {
        self.means_world.dims()[0]
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// The Gaussians with the indices `rows` `[K]`.
    pub fn select(&self, rows: &Tensor<1, Int>) -> Self {
        self.map(|values| values.clone().select(0, rows.clone()))
    }
    /// The first `count` Gaussians.
    pub fn first(&self, count: usize) -> Self {
        self.map(|values| first_rows(values.clone(), count.min(self.len())))
    }
    fn map(&self, change: impl Fn(&Tensor<2>) -> Tensor<2>) -> Self {
        Self { means_world: change(&self.means_world), attributes: self.attributes.iter().map(&change).collect() }
    }
    /// Refuses attributes whose number or shapes differ from `wanted`. `deformer` is the name in the error.
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn check(&self, deformer: &str, wanted: &[AttributeSpec]) -> Result<()> {
        let m = self.len();
        if self.attributes.len() == wanted.len() && self.attributes.iter().zip(wanted).all(|(a, spec)| a.dims() == [m, spec.width]) {
            return Ok(());
        }
        let names: Vec<String> = wanted.iter().map(|a| format!("{} [{m},{}]", a.name, a.width)).collect();
        let found: Vec<[usize; 2]> = self.attributes.iter().map(|a| a.dims()).collect();
        let problem = format!("the Gaussians must have the attributes {}; found {} of shapes {found:?}", names.join(", "), found.len());
        Err(Error::parameter(format!("deformer {deformer}"), problem, "Load a model that was trained with this deformer"))
    }
}

/// A number or vector per Gaussian that a deformer learns in addition to its weights. It is one of the Gaussians' extra attributes: density control copies and
/// removes it with its Gaussian, and checkpoints and archives store it by name. It begins with the main stage. Gaussians that key frames or recovery add take
/// the value of the nearest moving one.
#[derive(Clone, Debug, PartialEq)]
pub struct AttributeSpec {
    /// Name of the extra attribute: letters, digits, `_`, `-` and `.`; unique, and not one of the attributes that every Gaussian has.
    pub name: String,
    /// Floats per Gaussian, at least 1.
    pub width: usize,
    /// Start value of every float.
    pub start: f32,
    /// Start values are uniform random numbers from `start - spread` to `start + spread`, from the run's seed.
    pub spread: f32,
    /// Learning rate of the optimizer at the first step of the main stage.
    pub lr: f64,
    /// Learning rate at the last step of the main stage, reached log-linearly, as that of a [`ParameterGroup`]. `None`: `lr` in all of it. The trainer's
    /// `train.lr.cooldown` counts in addition.
    pub lr_end: Option<f64>,
    /// Whether the rates are multiplied by the extent of the cameras in the normalised frame, [`crate::Scene::extent`] (as that of the positions is).
    pub times_extent: bool,
    /// Largest absolute error of a float after lossy compression. `None`: codecs that measure what errors change in images round by that, others store it
    /// bit for bit.
    pub tolerance: Option<f32>,
}

impl AttributeSpec {
    /// An attribute of `width` floats with start value `start` and a learning rate of `lr` throughout, without a tolerance.
    pub fn new(name: &str, width: usize, start: f32, lr: f64) -> Self {
        Self { name: name.into(), width, start, spread: 0.0, lr, lr_end: None, times_extent: false, tolerance: None }
    }
}

/// Refuses attributes that cannot be stored: names that are empty, duplicate, reserved or have other characters, widths outside 1..4096, and numbers that are
/// not finite.
///
/// # Errors
/// [`Error::Parameter`] that names the deformer and the attribute.
pub fn check_attributes(deformer: &str, attributes: &[AttributeSpec]) -> Result<()> {
    let bad = |name: &str, problem: &str| {
        Err(Error::parameter(format!("deformer {deformer}: attribute '{name}'"), problem, "Give each attribute its own name and at least one float"))
    };
    for (index, spec) in attributes.iter().enumerate() {
        let plain = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if spec.name.is_empty() || spec.name.len() > 100 || !spec.name.chars().all(plain) {
            return bad(&spec.name, "the name must be 1 to 100 letters, digits, '_', '-' or '.'");
        }
        if CORE_ATTRIBUTES.contains(&spec.name.as_str()) {
            return bad(&spec.name, "every Gaussian has an attribute of this name");
        }
        if attributes[..index].iter().any(|other| other.name == spec.name) {
            return bad(&spec.name, "the name is used twice");
        }
        if spec.width == 0 || spec.width > 4096 {
            return bad(&spec.name, &format!("the width {} is not in 1..4096", spec.width));
        }
        let rates = [spec.lr, spec.lr_end.unwrap_or(0.0)].map(|rate| rate as f32);
        if [spec.start, spec.spread, rates[0], rates[1], spec.tolerance.unwrap_or(0.0)].iter().any(|v| !v.is_finite()) {
            return bad(&spec.name, "start, spread, rates and tolerance must be finite");
        }
    }
    Ok(())
}

/// Refuses weights that can be neither trained nor stored: names that are empty, not printable or used twice, values that are not as many as the shape says,
/// and groups that do not exist. `owner` names the plug-in in errors.
///
/// # Errors
/// [`Error::Parameter`] that names the plug-in and the array.
pub fn check_parameters(owner: &str, parameters: &[&Parameter], groups: &[ParameterGroup]) -> Result<()> {
    for (index, parameter) in parameters.iter().enumerate() {
        let Parameter { name, shape, value, group, .. } = parameter;
        let count = value.dims()[0];
        let problem = match () {
            () if name.is_empty() || name.chars().any(char::is_control) => "the name is empty or not printable".to_string(),
            () if parameters[..index].iter().any(|other| other.name == *name) => "the name is used twice".into(),
            () if value_count(shape) != Some(count) => format!("{count} values have the shape {shape:?}"),
            () if *group >= groups.len() => format!("they are in group {group}, counted from 0, and there are {}", groups.len()),
            () => continue,
        };
        return Err(Error::parameter(format!("{owner}: weights '{name}'"), problem, "Correct what its parameters() and groups() return"));
    }
    Ok(())
}

/// Calls [`Deformer::start_from`] of a new deformer, as a training does. `name` is the deformer's in errors.
///
/// # Errors
/// [`Error::Parameter`] where the weights do not have the names and shapes that they had before, and what the deformer reports.
pub fn start_deformer(name: &str, deformer: &mut dyn Deformer, first: &HostGaussians) -> Result<()> {
    fn shapes(deformer: &dyn Deformer) -> Vec<(String, Vec<usize>)> {
        deformer.parameters().into_iter().map(|p| (p.name.clone(), p.shape.clone())).collect()
    }
    let (owner, before) = (format!("deformer {name}"), shapes(deformer));
    deformer.start_from(first)?;
    check_parameters(&owner, &deformer.parameters(), &deformer.groups())?;
    if shapes(deformer) == before {
        return Ok(());
    }
    let remedy = "Let them depend on settings and context alone: stored models are opened without the first Gaussians";
    Err(Error::parameter(owner, "start_from changed the names or shapes of weights", remedy))
}

/// A deformer (deformation field): from canonical Gaussians to offsets at a time (paper Section IV-B).
///
/// The time-invariant half is a separate call, so that playback can cache it. Training recomputes it every step.
pub trait Deformer: Send {
    /// Features of M Gaussians, from their centres and the attributes of [`Deformer::attributes`]. Those of a Gaussian do not depend on which others are in
    /// `input`: training, playback and baking ask about different ones.
    ///
    /// # Errors
    /// [`Error::Parameter`] for Gaussians without these attributes, as [`SpatialInput::check`] returns it.
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures>;
    /// The deformer's attributes per Gaussian; [`Deformer::spatial`] receives their values.
    fn attributes(&self) -> Vec<AttributeSpec> {
        Vec::new()
    }
    /// Offsets at `time_norm` (0 at the first frame, 1 at the last) for the M Gaussians of `features` `[M,F]`; the same heads at every time. They depend on
    /// features, weights, progress and time alone: features may be older than the last ones that [`Deformer::spatial`] returned.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a time that is not finite.
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets>;
    /// The offsets of [`Deformer::deform`] at each of `times_norm`. Training asks for all views of an iteration at once, so that work and gradients can be
    /// shared.
    fn deform_all(&self, features: Tensor<2>, times_norm: &[f32]) -> Result<Vec<Offsets>> {
        times_norm.iter().map(|&time_norm| self.deform(features.clone(), time_norm)).collect()
    }
    /// The same features in the layout that [`Deformer::deform`] reads fastest. Playback calls this once per spatial pass.
    fn packed(&self, features: Tensor<2>) -> Tensor<2> {
        features
    }
    /// The weights, in a fixed order.
    fn parameters(&self) -> Vec<&Parameter>;
    /// The weights for the optimizer and for loading, in the same order.
    fn parameters_mut(&mut self) -> Vec<&mut Parameter>;
    /// The optimizer groups that [`Parameter::group`] points into.
    fn groups(&self) -> Vec<ParameterGroup>;
    /// Whether playback may cache spatial features between frames.
    fn caches_spatial(&self) -> bool {
        true
    }
    /// Whether the deformer never moves anything, so that every stage may skip it.
    fn is_static(&self) -> bool {
        false
    }
    /// An additional loss term `[1]` for the moving Gaussians, added as it is. It is asked for once per iteration, with the time `time_norm` (0..1) of the
    /// first view of that iteration and the `progress` (0..1) of the main stage. It may call [`Deformer::deform`] at other times, to compare several. Add many
    /// numbers with [`ordered_sum`](crate::ordered_sum), whose bits do not depend on threads.
    fn regularizer(&self, _input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        Ok(None)
    }
    /// Sets initial weights that depend on the first Gaussians, such as control points. A training calls it once, on a new deformer before the main stage;
    /// stored models are opened without it, and their weights are replaced by name. So it may change nothing but values of weights: their names and shapes
    /// depend on settings and context alone, whatever the number of Gaussians. `first` are those that may move, or all if none may: there may be few, or none,
    /// all values are finite, and attributes of plug-ins may be missing. Equal Gaussians must give equal weights: draw random numbers from
    /// [`DeformerContext::seed`]. Default: nothing.
    fn start_from(&mut self, _first: &HostGaussians) -> Result<()> {
        Ok(())
    }
    /// Sets the progress of the main stage of training, 0..1; called before every step. A deformer without such a call has progress 1, as after training.
    fn set_progress(&mut self, _progress: f32) {}
    /// After training, a smaller deformer with nearly the same offsets, without parts that this scene does not use; `None` if there is none. `features` `[M,F]`
    /// are those of all moving Gaussians, `times` the normalised times of the frames.
    fn simplified(&self, _features: Tensor<2>, _times: &[f32]) -> Result<Option<Simplified>> {
        Ok(None)
    }
    /// Bytes of the weights as float32, per part: (grid, net).
    fn size_bytes(&self) -> (u64, u64) {
        let sum = |part| self.parameters().iter().filter(|p| p.part == part).map(|p| 4 * p.shape.iter().product::<usize>() as u64).sum();
        (sum(Part::Grid), sum(Part::Net))
    }
}

/// The result of [`Deformer::simplified`].
pub struct Simplified {
    /// The smaller deformer.
    pub field: Box<dyn Deformer>,
    /// The `[deformer]` settings that build it, without `kind`.
    pub settings: toml::Table,
    /// A message that says what was dropped.
    pub message: String,
}

/// A deformer in the registry.
pub struct DeformerPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds a deformer with initial weights. The table is the `[deformer]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table, &DeformerContext, &Device) -> Result<Box<dyn Deformer>>,
}
cc4dgs_format::plugin_kind!(DeformerPlugin, "deformer");

/// Puts a layer with these settings around a deformer.
pub type BuildLayer = fn(&toml::Table, Box<dyn Deformer>) -> Result<Box<dyn Deformer>>;

/// Something that any deformer can be given in addition, in the registry. It is a deformer around another one, asked for by a key of the `[deformer]` section
/// that has the plug-in's name, such as `life = true`.
pub struct DeformerLayerPlugin {
    /// Name, version and other facts. The schema is that of the table that may stand in place of `true`.
    pub info: Plugin,
    /// Builds the layer around a deformer. The table holds its settings, and is empty for `true`; unknown keys are errors.
    pub build: BuildLayer,
}
cc4dgs_format::plugin_kind!(DeformerLayerPlugin, "deformer layer");
