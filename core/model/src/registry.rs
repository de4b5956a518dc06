//! The registry: all linked plug-ins, collected into a value. Duplicate and unknown names are errors.

use crate::playback::MotionPlugin;
use crate::{
    Appearance, AppearanceContext, AppearancePlugin, AttributeCodec, CodecPlugin, Deformer, DeformerContext, DeformerLayerPlugin, DeformerPlugin,
    DensityControl, DensityPlugin, Entries, Error, Exporter, ExporterPlugin, LossPlugin, Optimizer, OptimizerPlugin, Plugin, Poses, PosesContext, PosesPlugin,
    PresetPlugin, Rasterizer, RasterizerPlugin, ReaderPlugin, Result, WeightCodec, WeightCodecPlugin, check_attributes, check_parameters, config, split_kind,
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
    poses: Entries<PosesPlugin>,
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
            poses: Entries::collect()?,
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
        let cameras = self.appearances.facts().chain(self.poses.facts());
        let training = self.density.facts().chain(self.losses.facts()).chain(cameras).chain(self.optimizers.facts());
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
    /// The pose model called `name`.
    pub fn poses(&self, name: &str) -> Result<&'static PosesPlugin> {
        self.poses.get(name)
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
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown `kind` and for weights that can be neither trained nor stored ([`check_parameters`]), and what the plug-in reports.
    pub fn build_appearance(&self, section: &toml::Table, context: &AppearanceContext, device: &Device) -> Result<Box<dyn Appearance>> {
        let (kind, settings) = split_kind("appearance", section)?;
        let appearance = (self.appearance(&kind)?.build)(&settings, context, device)?;
        check_parameters(&format!("appearance {kind}"), &appearance.parameters(), &appearance.groups())?;
        Ok(appearance)
    }
    /// Builds the pose model of a `[poses]` section (`kind` and its settings).
    ///
    /// # Errors
    /// As [`Registry::build_appearance`].
    pub fn build_poses(&self, section: &toml::Table, context: &PosesContext, device: &Device) -> Result<Box<dyn Poses>> {
        let (kind, settings) = split_kind("poses", section)?;
        let poses = (self.poses(&kind)?.build)(&settings, context, device)?;
        check_parameters(&format!("poses {kind}"), &poses.parameters(), &poses.groups())?;
        Ok(poses)
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
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown `kind`, for a layer whose key holds something else, and for attributes and weights that can be neither trained nor
    /// stored ([`check_attributes`], [`check_parameters`]), and what the plug-ins report.
    pub fn build_deformer(&self, section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
        let (kind, mut settings) = split_kind("deformer", section)?;
        let layers = self.take_layers(&mut settings)?;
        let deformer = (self.deformer(&kind)?.build)(&settings, context, device)?;
        let deformer = layers.into_iter().try_fold(deformer, |inner, (layer, table)| (layer.build)(&table, inner))?;
        check_attributes(&kind, &deformer.attributes())?;
        check_parameters(&format!("deformer {kind}"), &deformer.parameters(), &deformer.groups())?;
        Ok(deformer)
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

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use crate::{AttributeSpec, Offsets, Parameter, ParameterGroup, Part, Seed, SpatialFeatures, SpatialInput, inventory};
    use burn::tensor::Tensor;

    /// Weights in a group that does not exist, or an attribute that every Gaussian has: nothing needs either before the main stage.
    struct Wrong {
        parameters: Vec<Parameter>,
        attributes: Vec<AttributeSpec>,
    }

    impl Deformer for Wrong {
        fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
            Ok(SpatialFeatures { values: input.means_world.clone(), work: Default::default() })
        }
        fn attributes(&self) -> Vec<AttributeSpec> {
            self.attributes.clone()
        }
        fn deform(&self, _: Tensor<2>, _: f32) -> Result<Offsets> {
            Ok(Offsets::default())
        }
        fn parameters(&self) -> Vec<&Parameter> {
            self.parameters.iter().collect()
        }
        fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
            self.parameters.iter_mut().collect()
        }
        fn groups(&self) -> Vec<ParameterGroup> {
            vec![ParameterGroup::plain("only", 1e-3, 1e-3)]
        }
    }

    /// The group of the weights, and the name of the attribute.
    fn build(settings: &toml::Table, _: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
        let group = settings.get("group").and_then(toml::Value::as_integer).unwrap_or(0) as usize;
        let parameters = vec![Parameter { name: "w".into(), part: Part::Net, shape: vec![2], value: Tensor::zeros([2], device), group }];
        let attributes = settings.get("attribute").and_then(toml::Value::as_str).map(|name| AttributeSpec::new(name, 1, 0.0, 1e-3));
        Ok(Box::new(Wrong { parameters, attributes: attributes.into_iter().collect() }))
    }

    inventory::submit! {
        DeformerPlugin { info: Plugin { name: "wrong", version: "1", summary: "a test", paper: "", schema: "", capabilities: &[] }, build }
    }

    #[test]
    fn deformers_that_cannot_be_trained_are_refused_when_they_are_built() {
        let registry = Registry::collect().unwrap();
        let context = DeformerContext { box_min: [0.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 0, seed: Seed::root(1) };
        let of = |settings: &str| {
            let section = config::parse_table("test", &format!("kind = 'wrong'\n{settings}")).unwrap();
            registry.build_deformer(&section, &context, &Device::flex()).map(drop).map_err(|e| e.to_string())
        };
        assert_eq!(of("attribute = 'mine'"), Ok(()));
        let group = of("group = 1").unwrap_err();
        assert!(group.starts_with("deformer wrong: weights 'w': they are in group 1"), "{group}");
        let attribute = of("attribute = 'means'").unwrap_err();
        assert!(attribute.starts_with("deformer wrong: attribute 'means'"), "{attribute}");
    }

    #[test]
    fn weights_that_cannot_be_stored_are_named() {
        let groups = [ParameterGroup::plain("only", 1e-3, 1e-3)];
        let flex = Device::flex();
        let array = |name: &str, shape: Vec<usize>| Parameter { name: name.into(), part: Part::Grid, shape, value: Tensor::zeros([6], &flex), group: 0 };
        let check = |arrays: &[Parameter]| check_parameters("mine", &arrays.iter().collect::<Vec<_>>(), &groups).map_err(|e| e.to_string());
        assert_eq!(check(&[array("a", vec![2, 3]), array("b", vec![6])]), Ok(()));
        for (arrays, problem) in [
            ([array("a", vec![2, 3]), array("a", vec![6])], "weights 'a': the name is used twice"),
            ([array("a", vec![2, 3]), array("", vec![6])], "weights '': the name is empty"),
            ([array("a", vec![2, 3]), array("b", vec![5])], "weights 'b': 6 values have the shape [5]"),
            ([array("a", vec![2, 3]), array("b", vec![usize::MAX, 2])], "weights 'b': 6 values have the shape"),
        ] {
            let message = check(&arrays).unwrap_err();
            assert!(message.starts_with("mine: ") && message.contains(problem), "{message}");
        }
    }
}
