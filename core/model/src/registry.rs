//! The registry: all linked plug-ins, collected into a value. Duplicate and unknown names are errors.

use crate::playback::MotionPlugin;
use crate::{
    Appearance, AppearanceContext, AppearancePlugin, AttributeCodec, CodecPlugin, Deformer, DeformerContext, DeformerLayerPlugin, DeformerPlugin,
    DensityControl, DensityPlugin, Entries, Error, Exporter, ExporterPlugin, LossPlugin, Optimizer, OptimizerPlugin, Plugin, PresetPlugin, Rasterizer,
    RasterizerPlugin, ReaderPlugin, Result, WeightCodec, WeightCodecPlugin, config, split_kind,
};
use burn::tensor::Device;

/// The linked plug-ins by kind and name.
pub struct Registry {
    deformers: Entries<DeformerPlugin>,
    layers: Entries<DeformerLayerPlugin>,
    motions: Entries<MotionPlugin>,
    codecs: Entries<CodecPlugin>,
    exporters: Entries<ExporterPlugin>,
    rasterizers: Entries<RasterizerPlugin>,
    density: Entries<DensityPlugin>,
    losses: Entries<LossPlugin>,
    appearances: Entries<AppearancePlugin>,
    optimizers: Entries<OptimizerPlugin>,
    weight_codecs: Entries<WeightCodecPlugin>,
    readers: Entries<ReaderPlugin>,
    presets: Entries<PresetPlugin>,
}

impl Registry {
    /// Collects all plug-ins that are linked into this program.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter) if two plug-ins of a kind have the same name.
    pub fn collect() -> Result<Self> {
        Ok(Self {
            deformers: Entries::collect()?,
            layers: Entries::collect()?,
            motions: Entries::collect()?,
            codecs: Entries::collect()?,
            exporters: Entries::collect()?,
            rasterizers: Entries::collect()?,
            density: Entries::collect()?,
            losses: Entries::collect()?,
            appearances: Entries::collect()?,
            optimizers: Entries::collect()?,
            weight_codecs: Entries::collect()?,
            readers: Entries::collect()?,
            presets: Entries::collect()?,
        })
    }
    /// All entries as (kind, facts), sorted.
    pub fn plugins(&self) -> Vec<(&'static str, &'static Plugin)> {
        let deformers = self.deformers.facts().chain(self.layers.facts()).chain(self.motions.facts());
        let model = self.codecs.facts().chain(deformers).chain(self.rasterizers.facts()).chain(self.weight_codecs.facts()).chain(self.exporters.facts());
        let training = self.density.facts().chain(self.losses.facts()).chain(self.appearances.facts()).chain(self.optimizers.facts());
        model.chain(training).chain(self.readers.facts()).chain(self.presets.facts()).collect()
    }
    /// The deformer called `name`.
    pub fn deformer(&self, name: &str) -> Result<&'static DeformerPlugin> {
        self.deformers.get(name)
    }
    /// The codec called `name`.
    pub fn codec(&self, name: &str) -> Result<&'static CodecPlugin> {
        self.codecs.get(name)
    }
    /// The exporter called `name`.
    pub fn exporter(&self, name: &str) -> Result<&'static ExporterPlugin> {
        self.exporters.get(name)
    }
    /// All exporters, sorted by name.
    pub fn exporters(&self) -> impl Iterator<Item = &'static ExporterPlugin> + '_ {
        self.exporters.iter()
    }
    /// The rasterizer called `name`.
    pub fn rasterizer(&self, name: &str) -> Result<&'static RasterizerPlugin> {
        self.rasterizers.get(name)
    }
    /// The density control called `name`.
    pub fn density(&self, name: &str) -> Result<&'static DensityPlugin> {
        self.density.get(name)
    }
    /// The loss term called `name`.
    pub fn loss(&self, name: &str) -> Result<&'static LossPlugin> {
        self.losses.get(name)
    }
    /// All loss terms, sorted by name.
    pub fn losses(&self) -> impl Iterator<Item = &'static LossPlugin> + '_ {
        self.losses.iter()
    }
    /// The appearance model called `name`.
    pub fn appearance(&self, name: &str) -> Result<&'static AppearancePlugin> {
        self.appearances.get(name)
    }
    /// The optimizer called `name`.
    pub fn optimizer(&self, name: &str) -> Result<&'static OptimizerPlugin> {
        self.optimizers.get(name)
    }
    /// Builds the density control of a `[density]` section (`kind` and its settings).
    pub fn build_density(&self, section: &toml::Table) -> Result<Box<dyn DensityControl>> {
        let (kind, settings) = split_kind("density", section)?;
        (self.density(&kind)?.build)(&settings)
    }
    /// Builds the appearance model of an `[appearance]` section (`kind` and its settings).
    pub fn build_appearance(&self, section: &toml::Table, context: &AppearanceContext, device: &Device) -> Result<Box<dyn Appearance>> {
        let (kind, settings) = split_kind("appearance", section)?;
        (self.appearance(&kind)?.build)(&settings, context, device)
    }
    /// Builds the optimizer of an `[optimizer]` section (`kind` and its settings).
    pub fn build_optimizer(&self, section: &toml::Table) -> Result<Box<dyn Optimizer>> {
        let (kind, settings) = split_kind("optimizer", section)?;
        (self.optimizer(&kind)?.build)(&settings)
    }
    /// The weight codec called `name`.
    pub fn weight_codec(&self, name: &str) -> Result<&'static WeightCodecPlugin> {
        self.weight_codecs.get(name)
    }
    /// The reader called `name`.
    pub fn reader(&self, name: &str) -> Result<&'static ReaderPlugin> {
        self.readers.get(name)
    }
    /// All readers in the order in which they are probed.
    pub fn readers(&self) -> Vec<&'static ReaderPlugin> {
        let mut readers: Vec<_> = self.readers.iter().collect();
        // Entries are sorted by name and the sort is stable, so readers of equal order are probed by name.
        readers.sort_by_key(|r| r.order);
        readers
    }
    /// All presets, families and methods, sorted by name; see [`Registry::preset`] for the settings of one.
    pub fn presets(&self) -> impl Iterator<Item = &'static PresetPlugin> + '_ {
        self.presets.iter()
    }
    /// Builds the deformer of a `[deformer]` section: `kind`, its settings, and the layers around it, in the order of their names. A layer's key holds true,
    /// false or a table of its settings.
    pub fn build_deformer(&self, section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
        let (kind, mut settings) = split_kind("deformer", section)?;
        let layers = self.take_layers(&mut settings)?;
        let deformer = (self.deformer(&kind)?.build)(&settings, context, device)?;
        layers.into_iter().try_fold(deformer, |inner, (layer, table)| (layer.build)(&table, inner))
    }
    /// A `[deformer]` section with every setting of the deformer and of the layers around it stated, defaults included.
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown `kind`, and for a layer whose key holds neither a boolean nor a table.
    pub fn complete_deformer(&self, section: &toml::Table) -> Result<toml::Table> {
        let (kind, mut settings) = split_kind("deformer", section)?;
        let layers = self.take_layers(&mut settings)?;
        let mut full = config::filled(self.deformer(&kind)?.info.schema, &settings)?;
        full.insert("kind".into(), kind.into());
        for (layer, table) in layers {
            full.insert(layer.info.name.into(), config::filled(layer.info.schema, &table)?.into());
        }
        Ok(full)
    }
    /// Moves the layers that a `[deformer]` section asks for out of it, with the settings of each.
    fn take_layers(&self, settings: &mut toml::Table) -> Result<Vec<(&'static DeformerLayerPlugin, toml::Table)>> {
        let mut layers = Vec::new();
        for layer in self.layers.iter() {
            match settings.remove(layer.info.name) {
                None | Some(toml::Value::Boolean(false)) => {}
                Some(toml::Value::Boolean(true)) => layers.push((layer, toml::Table::new())),
                Some(toml::Value::Table(table)) => layers.push((layer, table)),
                Some(other) => {
                    let object = format!("deformer.{}", layer.info.name);
                    return Err(Error::parameter(object, format!("{other} is neither true, false nor a table"), "Give true, or a table of settings"));
                }
            }
        }
        Ok(layers)
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
    /// Builds the exporter called `name` with `settings`.
    pub fn build_exporter(&self, name: &str, settings: &toml::Table) -> Result<Box<dyn Exporter>> {
        (self.exporter(name)?.build)(settings)
    }
    /// Builds the weight codec called `name` with `settings`.
    pub fn build_weight_codec(&self, name: &str, settings: &toml::Table) -> Result<Box<dyn WeightCodec>> {
        (self.weight_codec(name)?.build)(settings)
    }
}
