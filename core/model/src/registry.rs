//! All plug-ins that are linked in, collected once into a value. A name taken twice and a name unknown are errors.

use crate::plugin::{Entries, Plugin, split_kind};
use crate::preset::PresetPlugin;
use crate::reader::ReaderPlugin;
use crate::{AttributeCodec, CodecPlugin, Deformer, DeformerContext, DeformerPlugin, Rasterizer, RasterizerPlugin, Result};
use burn::tensor::Device;

/// The linked plug-ins by kind and name.
pub struct Registry {
    deformers: Entries<DeformerPlugin>,
    codecs: Entries<CodecPlugin>,
    rasterizers: Entries<RasterizerPlugin>,
    readers: Entries<ReaderPlugin>,
    presets: Entries<PresetPlugin>,
}

impl Registry {
    /// Collects everything linked into this program.
    pub fn collect() -> Result<Self> {
        Ok(Self {
            deformers: Entries::collect()?,
            codecs: Entries::collect()?,
            rasterizers: Entries::collect()?,
            readers: Entries::collect()?,
            presets: Entries::collect()?,
        })
    }
    /// All entries as (kind, facts), sorted.
    pub fn plugins(&self) -> Vec<(&'static str, &'static Plugin)> {
        let seams = self.codecs.facts().chain(self.deformers.facts()).chain(self.rasterizers.facts());
        seams.chain(self.readers.facts()).chain(self.presets.facts()).collect()
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
    /// The reader called `name`.
    pub fn reader(&self, name: &str) -> Result<&'static ReaderPlugin> {
        self.readers.get(name)
    }
    /// All readers in the order in which they are asked whether a path is theirs.
    pub fn readers(&self) -> Vec<&'static ReaderPlugin> {
        let mut readers: Vec<_> = self.readers.iter().collect();
        // Entries come sorted by name, and the sort is stable: equal orders are asked by name.
        readers.sort_by_key(|r| r.order);
        readers
    }
    /// All presets, families and methods, sorted by name; see [`Registry::preset`] for the settings of one.
    pub fn presets(&self) -> impl Iterator<Item = &'static PresetPlugin> + '_ {
        self.presets.iter()
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
}
