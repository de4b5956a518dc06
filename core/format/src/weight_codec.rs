//! The weight codec trait: the weights of a deformer to bytes and back.

use crate::plugin::Plugin;
use crate::{CodecContext, Result, Stream};

/// A named array of a deformer's weights.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightArray {
    /// Unique within the deformer.
    pub name: String,
    /// Logical shape.
    pub shape: Vec<usize>,
    /// Row-major values, as many as the product of the shape.
    pub values: Vec<f32>,
}

/// What a training needs to know of how weights are stored.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WeightSteps {
    /// The distance of neighbouring values that can be stored, for every value of every array; 0 where there is only one.
    pub steps: Vec<Vec<f32>>,
    /// The derivative of the estimated size in bits by every value, in steps.
    pub bit_slopes: Vec<Vec<f32>>,
}

/// Weights of a deformer to bytes and back. Every weight codec can store the weights of every deformer.
///
/// [`crate::storage::write_shapes`] and [`crate::storage::read_shapes`] write, read and check names and shapes.
pub trait WeightCodec: Send + Sync {
    /// Encodes all arrays. Deterministic: equal weights, settings and seeds give equal bytes.
    fn encode(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Vec<Stream>>;
    /// Decodes what [`WeightCodec::encode`] wrote: the same names and shapes in the same order, finite values. Bytes are untrusted: an error, never a panic.
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>>;
    /// `weights` as they come back from [`WeightCodec::encode`] and [`WeightCodec::decode`], to the bit. A training that goes on while weights are rounded asks
    /// for it in every iteration: say how where that takes less time than coding.
    ///
    /// # Errors
    /// As [`WeightCodec::encode`].
    fn round(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Vec<WeightArray>> {
        self.decode(&self.encode(weights, context)?, context)
    }
    /// How far apart values that can be stored are, for a training that goes on while they are rounded; `None` where the codec does not say.
    ///
    /// # Errors
    /// As [`WeightCodec::encode`].
    fn steps(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Option<WeightSteps>> {
        let _ = (weights, context);
        Ok(None)
    }
    /// The largest absolute error of a value over the largest absolute value of its array, where the context has no importance; `0` is bit-exact. The
    /// conformance suite checks it.
    fn loss(&self) -> f64;
}

/// A weight codec in the registry.
pub struct WeightCodecPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the codec from its settings; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn WeightCodec>>,
}
crate::plugin_kind!(WeightCodecPlugin, "weight-codec");
