//! Training a model further while its values are rounded as a codec will store them.
//!
//! The codec knows how values are rounded ([`Rounding`]), the trainer has renderer, images and optimizer ([`TuneModel`]). Images are drawn with rounded
//! values, and what their derivatives say is applied to the values before rounding (the straight-through estimator, Bengio et al. 2013).

use crate::{HostGaussians, Result, Seed, Stream, WeightArray};

/// How a codec that has chosen its steps rounds Gaussians.
pub trait Rounding {
    /// `gaussians` as they will be decoded, in the same order.
    ///
    /// # Errors
    /// What the codec reports.
    fn round(&self, gaussians: &HostGaussians) -> Result<HostGaussians>;
    /// The distance of neighbouring values that can be stored, for every value of every column. Values with 0 stay as they are, and so do attributes of
    /// plug-ins.
    ///
    /// # Errors
    /// What the codec reports.
    fn steps(&self, gaussians: &HostGaussians) -> Result<HostGaussians>;
    /// The derivative of the estimated size in bits by every value of every column.
    ///
    /// # Errors
    /// What the codec reports.
    fn bit_slopes(&self, gaussians: &HostGaussians) -> Result<HostGaussians>;
}

/// A model that is trained further. Nothing in it is rounded.
#[derive(Clone, Debug, PartialEq)]
pub struct TunedModel {
    /// The canonical Gaussians.
    pub gaussians: HostGaussians,
    /// The weights of the deformer; none without one.
    pub weights: Vec<WeightArray>,
}

/// Streams of a deformer's weights, and the settings of the weight codec that encoded them.
pub type EncodedWeights = (Vec<Stream>, toml::Table);

/// One training.
pub struct Tuning<'a> {
    /// How Gaussians are rounded.
    pub rounding: &'a dyn Rounding,
    /// Steps of the deformer's weights over those that were chosen without training.
    pub weight_steps: f64,
    /// Steps of the optimizer.
    pub iterations: usize,
    /// Those of other trainings of the same search: done, and all with these. For progress.
    pub of: (usize, usize),
    /// The order of views follows from it.
    pub seed: Seed,
    /// How much size counts, where 1 is as much as what it costs in accuracy to save it by larger steps.
    pub size_weight: f64,
    /// Bits that steps twice as large save.
    pub bits_per_octave: f64,
}

/// Trains a model further on its training views: on their images, in the colours of the model where it was trained with colours per camera. A deformer's
/// weights are rounded as their own codec stores them.
pub trait TuneModel {
    /// Why the model should not be trained further unless the user asks for it, if so.
    ///
    /// # Errors
    /// What the model's configuration reports.
    fn caution(&self) -> Result<Option<String>>;
    /// `gaussians` with the weights of the model.
    ///
    /// # Errors
    /// What the device reports.
    fn start(&self, gaussians: &HostGaussians) -> Result<TunedModel>;
    /// Trains `from`. Equal arguments give equal results on one machine.
    ///
    /// # Errors
    /// [`crate::Error::Interrupted`] if the user asks for it, [`crate::Error::Backend`] where values do not stay finite, and what scene and parts report.
    fn tune(&self, from: &TunedModel, tuning: &Tuning) -> Result<TunedModel>;
    /// Mean PSNR in dB of `gaussians` as they are, moved by `weights`: rounded in steps that are `weight_steps` times those chosen without training, or as they
    /// are. Validation views judge where the scene has some, else training views.
    ///
    /// # Errors
    /// What scene and parts report.
    fn psnr(&self, gaussians: &HostGaussians, weights: &[WeightArray], weight_steps: Option<f64>) -> Result<f64>;
    /// `weights` in such steps, as they are stored; nothing where no deformer is stored.
    ///
    /// # Errors
    /// What the weight codec reports.
    fn encoded_weights(&self, weights: &[WeightArray], weight_steps: f64) -> Result<EncodedWeights>;
    /// States that the codec's streams hold Gaussians that were trained with `weights`, which are to be stored in such steps.
    fn adopt(&self, weights: Vec<WeightArray>, weight_steps: f64);
    /// The weights that were adopted, as they are stored; `None` if none were.
    ///
    /// # Errors
    /// What the weight codec reports.
    fn adopted(&self) -> Result<Option<EncodedWeights>>;
}
