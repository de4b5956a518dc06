//! The seam of weight codecs: the weights of a deformation field to bytes and back.

use crate::plugin::Plugin;
use crate::{CodecContext, Result, Stream};

/// A named array of a field's weights.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightArray {
    /// Unique within the field.
    pub name: String,
    /// Logical shape.
    pub shape: Vec<usize>,
    /// Row-major values, as many as the product of the shape.
    pub values: Vec<f32>,
}

/// Weights of a deformation field to bytes and back. Any field can be stored by any weight codec.
///
/// [`crate::storage::write_shapes`] and [`crate::storage::read_shapes`] store names and shapes, and check them.
pub trait WeightCodec: Send + Sync {
    /// Encodes all arrays. Must be deterministic in the weights, the settings and the seed.
    fn encode(&self, weights: &[WeightArray], context: &CodecContext) -> Result<Vec<Stream>>;
    /// Decodes what [`WeightCodec::encode`] wrote: the same names and shapes in the same order, finite values. Bytes are hostile: an error, never a panic.
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<Vec<WeightArray>>;
    /// The largest absolute error of a value over the largest absolute value of its array; `0` is bit-exact. The conformance suite holds the codec to it.
    fn loss(&self) -> f64;
}

/// A weight codec in the registry.
pub struct WeightCodecPlugin {
    /// Facts for people, tables and checks.
    pub info: Plugin,
    /// Builds the codec from its settings; unknown keys are errors.
    pub build: fn(&toml::Table) -> Result<Box<dyn WeightCodec>>,
}
crate::plugin_kind!(WeightCodecPlugin, "weight-codec");
