//! The attribute codec trait: Gaussians to bytes and back.

use crate::plugin::Plugin;
use crate::{CodecContext, HostGaussians, Result};
use serde::{Deserialize, Serialize};

/// A named array of bytes. The size of a model is the size of its archive file, in which streams are compressed; it is never an estimate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Stream {
    /// Unique within the codec.
    pub name: String,
    /// The payload; the archive adds Zstandard and a checksum.
    pub bytes: Vec<u8>,
}

/// The largest error of one attribute; the conformance suite checks it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeclaredLoss {
    /// Name of a column of [`HostGaussians`].
    pub attribute: String,
    /// The largest root-mean-square error, divided by the attribute's standard deviation. `0` is bit-exact.
    pub relative_rms: f64,
}

/// When a player needs a stream of a codec. Files have streams in this order, with the motion between layers and harmonics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum StreamStage {
    /// More Gaussians, together with the streams of lower layers. Codecs without layers have layer 0 alone.
    Layer(u8),
    /// Nothing but the colour coefficients of this degree, 1 and up, together with all layers and the lower degrees.
    Harmonics(u8),
}

impl StreamStage {
    /// All layers.
    pub const BASE: Self = Self::Layer(u8::MAX);
    /// All layers and all degrees. Codecs that store the degrees together have their streams in this stage.
    pub const WHOLE: Self = Self::Harmonics(u8::MAX);
}

/// Gaussians to bytes and back (paper Section IV-D for `cca`).
pub trait AttributeCodec: Send + Sync {
    /// Encodes all attributes. Deterministic: equal Gaussians, settings and `context` give equal bytes, whatever the number of threads.
    ///
    /// Of [`HostGaussians::extra`], the needed rows must be kept, bit for bit or within each attribute's tolerance.
    ///
    /// # Errors
    /// [`Error::Data`](crate::Error::Data) for Gaussians that are not finite or whose columns differ in length, as [`HostGaussians::validate`] returns it.
    fn encode(&self, gaussians: &HostGaussians, context: &CodecContext) -> Result<Vec<Stream>>;
    /// Decodes what [`AttributeCodec::encode`] wrote; streams are found by name and may be in any order. Bytes are untrusted: an error, never a panic. A stream
    /// that ends early or has bytes behind its end is an error. `context` has no views, renderer and deformer.
    ///
    /// # Errors
    /// [`Error::Data`](crate::Error::Data) for damaged streams, [`Error::Limit`](crate::Error::Limit) for counts over [`CodecContext::limits`].
    fn decode(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians>;
    /// When a player needs the stream `name`.
    fn stage(&self, _name: &str) -> StreamStage {
        StreamStage::Layer(0)
    }
    /// Decodes the streams of all stages up to one before [`StreamStage::WHOLE`]: the first rows of [`AttributeCodec::decode`]. [`HostGaussians::sh_degree`] is
    /// that of the whole; coefficients of degrees whose stage is still to come are 0. Extra attributes are there where all layers are.
    fn decode_stage(&self, streams: &[Stream], context: &CodecContext) -> Result<HostGaussians> {
        self.decode(streams, context)
    }
    /// The largest error of each attribute. Attributes that are not listed are bit-exact.
    fn losses(&self) -> Vec<DeclaredLoss>;
    /// Whether a decoded score is above [`CodecContext::dynamic_threshold`] if and only if the given one was, wherever the context of encoding states the
    /// threshold.
    fn keeps_motion(&self) -> bool {
        false
    }
    /// Refuses settings that need a scene (recorded images, [`CodecContext::tuner`]). It is asked where there is none, or views without images in its place,
    /// before any work; [`AttributeCodec::encode`] refuses them as well.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter) that names the setting and the remedy.
    fn check_without_scene(&self) -> Result<()> {
        Ok(())
    }
    /// The bytes that the whole file may have at most, where the user bounded them ([`CodecContext::file_bytes`]).
    fn most_bytes(&self) -> Option<u64> {
        None
    }
}

/// An attribute codec in the registry.
pub struct CodecPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the codec. The string is the profile after the colon of `name:profile` (empty: the default profile); the table holds its settings.
    pub build: fn(&str, &toml::Table) -> Result<Box<dyn AttributeCodec>>,
}
crate::plugin_kind!(CodecPlugin, "codec");
