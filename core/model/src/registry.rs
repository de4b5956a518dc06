//! All plug-ins that are linked in, collected once into a value. A name taken twice and a name unknown are errors.

use crate::{AttributeCodec, CodecPlugin, Deformer, DeformerContext, DeformerPlugin, Rasterizer, RasterizerPlugin, Result, WeightCodec, WeightCodecPlugin};
use crate::{Entries, Plugin, split_kind};
use burn::tensor::Device;

/// The linked plug-ins by kind and name.
pub struct Registry {
    deformers: Entries<DeformerPlugin>,
    codecs: Entries<CodecPlugin>,
    rasterizers: Entries<RasterizerPlugin>,
    weight_codecs: Entries<WeightCodecPlugin>,
}

impl Registry {
    /// Collects everything linked into this program.
    pub fn collect() -> Result<Self> {
        Ok(Self { deformers: Entries::collect()?, codecs: Entries::collect()?, rasterizers: Entries::collect()?, weight_codecs: Entries::collect()? })
    }
    /// All entries as (kind, facts), sorted.
    pub fn plugins(&self) -> Vec<(&'static str, &'static Plugin)> {
        self.codecs.facts().chain(self.deformers.facts()).chain(self.rasterizers.facts()).chain(self.weight_codecs.facts()).collect()
    }
    /// The deformer called `name`.
    pub fn deformer(&self, name: &str) -> Result<&'static DeformerPlugin> {
        self.deformers.get(name)
    }
    /// The codec called `name`.
    pub fn codec(&self, name: &str) -> Result<&'static CodecPlugin> {
        self.codecs.get(name)
    }
    /// The rasterizer called `name`.
    pub fn rasterizer(&self, name: &str) -> Result<&'static RasterizerPlugin> {
        self.rasterizers.get(name)
    }
    /// The weight codec called `name`.
    pub fn weight_codec(&self, name: &str) -> Result<&'static WeightCodecPlugin> {
        self.weight_codecs.get(name)
    }
    /// Builds the deformer of a `[deformer]` section (`kind` and its settings).
    pub fn build_deformer(&self, section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
        let (kind, settings) = split_kind("deformer", section)?;
        (self.deformer(&kind)?.build)(&settings, context, device)
    }
    /// Builds the rasterizer of a `[rasterizer]` section (`kind` and its settings).
    pub fn build_rasterizer(&self, section: &toml::Table) -> Result<Box<dyn Rasterizer>> {
        let (kind, settings) = split_kind("rasterizer", section)?;
        (self.rasterizer(&kind)?.build)(&settings)
    }
    /// Builds the codec of `name` or `name:profile` with `settings`.
    pub fn build_codec(&self, spec: &str, settings: &toml::Table) -> Result<Box<dyn AttributeCodec>> {
        let (name, profile) = spec.split_once(':').unwrap_or((spec, ""));
        (self.codec(name)?.build)(profile, settings)
    }
    /// Builds the weight codec called `name` with `settings`.
    pub fn build_weight_codec(&self, name: &str, settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
        (self.weight_codec(name)?.build)(settings)
    }
}
