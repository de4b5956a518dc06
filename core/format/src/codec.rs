//! The seam of attribute codecs: Gaussians to bytes and back.

use crate::plugin::Plugin;
use crate::{CodecContext, HostGaussians, Result};
use serde::{Deserialize, Serialize};

/// A named run of bytes. The size of a model is the sum of these lengths after the archive's compression, never an estimate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stream {
    /// Unique within the codec.
    pub name: String,
    /// The payload; the archive adds Zstandard and a checksum.
    pub bytes: Vec<u8>,
}

/// What a codec may lose of one attribute; the conformance suite holds it to that.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeclaredLoss {
    /// Name of a column of [`HostGaussians`].
    pub attribute: String,
    /// `0` is bit-exact. Otherwise the largest root-mean-square error over the attribute's own standard deviation.
    pub relative_rms: f64,
}

/// Gaussians to bytes and back (paper Section IV-D for `cca`).
pub trait AttributeCodec: Send + Sync {
    /// Encodes all attributes. Must be deterministic in the Gaussians, the configuration, the seed and what else `context` holds.
    ///
    /// [`HostGaussians::extra`] must survive as far as each attribute asks for: bit for bit, or within its tolerance, and in the rows that are needed.
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>>;
    /// Decodes what [`AttributeCodec::encode`] wrote. Bytes are hostile: an error, never a panic. A player decodes without views, renderer and field.
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians>;
    /// What is lost, per attribute; an attribute not named is bit-exact.
    fn losses(&self) -> Vec<DeclaredLoss>;
}

/// An attribute codec in the registry.
pub struct CodecPlugin {
    /// Facts for people, tables and checks.
    pub info: Plugin,
    /// Builds the codec. The string is the profile after the colon of `name:profile` (empty: the default one); the table holds its settings.
    pub build: fn(&str, &toml::Table) -> Result<Box<dyn AttributeCodec>>,
}
crate::plugin_kind!(CodecPlugin, "codec");
