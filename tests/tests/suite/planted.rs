//! Errors that conformance suites must find: a deformer whose weights are all per-Gaussian attributes, in one correct and several wrong versions, and plug-ins
//! with a schema that is not theirs.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{
    Appearance, AppearanceContext, AppearancePlugin, AttributeSpec, Camera, Deformer, DeformerContext, DeformerPlugin, DeformerWork, DensityPlugin, Error,
    ExporterPlugin, ExtraAttribute, HostGaussians, LossPlugin, Offsets, OptimizerPlugin, Parameter, ParameterGroup, Part, Plugin, PosesPlugin, Rasterizer,
    RasterizerPlugin, Registry, RenderOutput, RenderSettings, Result, Seed, Similarity, SpatialFeatures, SpatialInput, Splats, WeightCodecPlugin, conformance,
};
use cc4dgs_play::model::ModelDeformer;
use cc4dgs_play::{Model, Moving, Player, RenderConfig, default_rasterizer};

/// The error in [`Velocities`].
#[derive(Clone, Copy, PartialEq)]
enum Mistake {
    None,
    DoubledGradient,
    DetachedGradient,
    PartialGradient,
    DetachedRegularizer,
    NameTwice,
    WrongShape,
    LateShape,
    Panic,
    TimeNotChecked,
    MissingAttributes,
    NotFinite,
}

/// A velocity per Gaussian.
struct Velocities(Mistake);

impl Deformer for Velocities {
    fn attributes(&self) -> Vec<AttributeSpec> {
        let velocity = AttributeSpec::new("velocity", 3, 0.0, 1e-3);
        if self.0 == Mistake::NameTwice { vec![velocity.clone(), velocity] } else { vec![velocity] }
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        if self.0 != Mistake::MissingAttributes {
            input.check("velocities", &self.attributes())?;
        }
        let velocity = input.attributes.first().cloned().unwrap_or_else(|| Tensor::zeros([input.len(), 3], &input.means_world.device()));
        let values = match self.0 {
            Mistake::DoubledGradient => velocity.clone().mul_scalar(2.0) - velocity.detach(),
            Mistake::DetachedGradient => velocity.detach(),
            Mistake::PartialGradient => {
                let [n, width] = velocity.dims();
                Tensor::cat(vec![velocity.clone().narrow(0, 0, n / 2).detach(), velocity.narrow(0, n / 2, n - n / 2)], 0).reshape([n, width])
            }
            _ => velocity,
        };
        Ok(SpatialFeatures { values, work: DeformerWork::default() })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() && self.0 != Mistake::TimeNotChecked {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let means = features.mul_scalar(time_norm);
        let means = match self.0 {
            Mistake::WrongShape => means.narrow(1, 0, 2),
            Mistake::LateShape if time_norm > 0.5 => means.narrow(1, 0, 2),
            Mistake::NotFinite => means.div_scalar(0.0),
            Mistake::Panic if time_norm > 0.5 => panic!("a mistake"),
            _ => means,
        };
        Ok(Offsets { means: Some(means), ..Offsets::default() })
    }
    fn regularizer(&self, input: &SpatialInput, _: f32, _: f32) -> Result<Option<Tensor<1>>> {
        let velocity = input.attributes.first().cloned();
        let velocity = velocity.map(|v| if self.0 == Mistake::DetachedRegularizer { v.detach() } else { v });
        Ok(velocity.map(|v| v.powi_scalar(2).mean()))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
}

#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NoSettings {}

type Build = fn(&toml::Table, &DeformerContext, &Device) -> Result<Box<dyn Deformer>>;

fn findings(build: Build, schema: &'static str) -> String {
    let info = Plugin { name: "velocities", version: "1", summary: "a test", paper: "", schema, capabilities: &["starts-as-identity"] };
    conformance::deformer(&DeformerPlugin { info, build }, &toml::Table::new(), &Device::flex()).join("\n")
}

/// A build function per error, because function pointers cannot capture it.
macro_rules! with {
    ($mistake:ident) => {
        |settings, _, _| {
            let NoSettings {} = cc4dgs_core::config::parse_section("deformer velocities", settings)?;
            Ok(Box::new(Velocities(Mistake::$mistake)))
        }
    };
}

#[test]
fn a_deformer_that_lives_in_its_attributes_conforms() {
    assert_eq!(findings(with!(None), "# no settings\n"), "");
}

#[test]
fn mistakes_are_found() {
    let cases: [(Build, &str); 10] = [
        (with!(DoubledGradient), "attribute velocity: the value rises"),
        (with!(PartialGradient), "attribute velocity: the value changes with entries that have no gradient"),
        (with!(DetachedGradient), "no gradient reaches attribute velocity"),
        (with!(DetachedRegularizer), "regularizer: at progress 0: no gradient reaches attribute velocity, but"),
        (with!(NameTwice), "the name is used twice"),
        (with!(WrongShape), "head means"),
        (with!(Panic), "it panics"),
        (with!(TimeNotChecked), "a time that is not a number was accepted"),
        (with!(MissingAttributes), "without its attributes were accepted"),
        (with!(NotFinite), "offsets are not finite"),
    ];
    for (build, wanted) in cases {
        let found = findings(build, "# no settings\n");
        assert!(found.contains(wanted), "expected '{wanted}' among:\n{found}");
    }
    let found = findings(with!(None), "speed = 1.0");
    assert!(found.contains("schema"), "a schema that is not the default's TOML:\n{found}");
}

/// The error in [`Anchored`].
#[derive(Clone, Copy, PartialEq)]
enum StartMistake {
    None,
    /// Part of what was learned from the first Gaussians is not in the weights.
    Hidden,
    /// An array has as many rows as there are Gaussians.
    GrownArray,
    /// The mean of no Gaussians.
    NotFinite,
}

/// Moves everything along the mean of the first Gaussians.
struct Anchored {
    mistake: StartMistake,
    parameters: Vec<Parameter>,
    hidden: f32,
}

impl Deformer for Anchored {
    fn start_from(&mut self, first: &HostGaussians) -> Result<()> {
        let divisor = if self.mistake == StartMistake::NotFinite { first.len() } else { first.len().max(1) } as f32;
        let mean: Vec<f32> = (0..3).map(|k| first.means.iter().skip(k).step_by(3).sum::<f32>() / divisor).collect();
        let anchor = &mut self.parameters[0];
        anchor.value = Tensor::from_floats(mean.as_slice(), &anchor.value.device());
        if self.mistake == StartMistake::GrownArray {
            (anchor.shape, anchor.value) = (vec![first.len() + 1, 3], anchor.value.clone().repeat_dim(0, first.len() + 1));
        }
        if self.mistake == StartMistake::Hidden {
            self.hidden = first.len() as f32;
        }
        Ok(())
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        Ok(SpatialFeatures { values: input.means_world.zeros_like(), work: DeformerWork::default() })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let along = self.parameters[0].value.clone().narrow(0, 0, 3).reshape([1, 3]);
        Ok(Offsets { means: Some(features + along * (time_norm * (1.0 + self.hidden))), ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("anchor", 1e-3, 1e-3)]
    }
}

fn build_anchored(mistake: StartMistake, settings: &toml::Table, device: &Device) -> Result<Box<dyn Deformer>> {
    let NoSettings {} = cc4dgs_core::config::parse_section("deformer anchored", settings)?;
    let anchor = Parameter { name: "anchor".into(), part: Part::Net, shape: vec![3], value: Tensor::zeros([3], device), group: 0 };
    Ok(Box::new(Anchored { mistake, parameters: vec![anchor], hidden: 0.0 }))
}

#[test]
fn mistakes_with_the_first_gaussians_are_found() {
    let cases: [(Build, &str); 4] = [
        (|settings, _, device| build_anchored(StartMistake::None, settings, device), ""),
        (|settings, _, device| build_anchored(StartMistake::Hidden, settings, device), "a deformer with the same weights gives other offsets"),
        (|settings, _, device| build_anchored(StartMistake::GrownArray, settings, device), "start_from changed the names or shapes of weights"),
        (|settings, _, device| build_anchored(StartMistake::NotFinite, settings, device), "offsets are not finite where start_from had 0 Gaussians"),
    ];
    for (build, wanted) in cases {
        let info = Plugin { name: "anchored", version: "1", summary: "a test", paper: "", schema: "# no settings\n", capabilities: &[] };
        let found = conformance::deformer(&DeformerPlugin { info, build }, &toml::Table::new(), &Device::flex()).join("\n");
        assert!(found.contains(wanted) && found.is_empty() == wanted.is_empty(), "expected '{wanted}' among:\n{found}");
    }
}

#[test]
fn schemas_that_do_not_state_the_defaults_are_found() {
    let (registry, none, flex) = (Registry::collect().unwrap(), toml::Table::new(), Device::flex());
    let stating = |info: &Plugin, schema: &'static str| Plugin { schema, ..info.clone() };
    let (density, loss) = (registry.density("clone-split").unwrap(), registry.loss("photometric").unwrap());
    let (appearance, optimizer) = (registry.appearance("affine").unwrap(), registry.optimizer("adam").unwrap());
    let poses = registry.poses("refined").unwrap();
    let others = [
        conformance::density(&DensityPlugin { info: stating(&density.info, "min_opacity = 0.5"), build: density.build }, &none, &flex),
        conformance::loss(&LossPlugin { info: stating(&loss.info, "l1_share = 0.5"), build: loss.build, fuses: None }, &none, &registry, &flex),
        conformance::appearance(&AppearancePlugin { info: stating(&appearance.info, "lr = 0.5"), build: appearance.build }, &none, &flex),
        conformance::poses(&PosesPlugin { info: stating(&poses.info, "lr = 0.5"), build: poses.build }, &none, &flex),
        conformance::optimizer(&OptimizerPlugin { info: stating(&optimizer.info, "beta1 = 0.5"), build: optimizer.build }, &none, &flex),
    ];
    assert!(others.iter().all(|found| found.len() == 1 && found[0].contains("schema")), "{others:?}");
    let (rasterizer, exporter) = (registry.rasterizer("tile").unwrap(), registry.exporter("ply").unwrap());
    let weights = registry.weight_codec("fp16").unwrap();
    let refused = [
        conformance::rasterizer(&RasterizerPlugin { info: stating(&rasterizer.info, "tiles = 16"), build: rasterizer.build }, &none, &flex),
        conformance::exporter(&ExporterPlugin { info: stating(&exporter.info, "text = true"), target: exporter.target, build: exporter.build }, &none),
        conformance::weight_codec(&WeightCodecPlugin { info: stating(&weights.info, "bits = 16"), build: weights.build }, &none),
    ];
    assert!(refused.iter().all(|found| found.len() == 1 && found[0].contains("it refuses the settings that its schema states")), "{refused:?}");
}

/// The rasterizer `tile`, but for a panic where there is nothing to draw.
struct Impatient(Box<dyn Rasterizer>);

impl Rasterizer for Impatient {
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput> {
        assert!(splats.means.dims()[0] > 0, "a mistake");
        self.0.render(splats, camera, settings)
    }
}

fn build_impatient(settings: &toml::Table) -> Result<Box<dyn Rasterizer>> {
    Ok(Box::new(Impatient((Registry::collect()?.rasterizer("tile")?.build)(settings)?)))
}

#[test]
fn rasterizers_that_panic_are_found() {
    let tile = Registry::collect().unwrap().rasterizer("tile").unwrap();
    let plugin = RasterizerPlugin { info: tile.info.clone(), build: build_impatient };
    let found = conformance::rasterizer(&plugin, &toml::Table::new(), &Device::flex());
    assert!(found.len() == 1 && found[0].contains("background: it panics"), "{found:?}");
}

/// A gain per training camera, each an array of its own.
struct Gains(Vec<Parameter>);

impl Appearance for Gains {
    fn apply(&self, planes: Tensor<3>, camera: Option<usize>) -> Result<Tensor<3>> {
        let Some(camera) = camera else { return Ok(planes) };
        let gain = self.0[camera].value.clone().exp().reshape([1, 1, 1]);
        Ok(Tensor::cat(vec![planes.clone().narrow(0, 0, 3) * gain, planes.narrow(0, 3, 2)], 0))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.0.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.0.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("gains", 1e-3, 1e-3)]
    }
}

fn build_gains(settings: &toml::Table, context: &AppearanceContext, device: &Device) -> Result<Box<dyn Appearance>> {
    let NoSettings {} = cc4dgs_core::config::parse_section("appearance gains", settings)?;
    let gain = |camera: usize| Parameter { name: format!("camera-{camera}"), part: Part::Net, shape: vec![1], value: Tensor::zeros([1], device), group: 0 };
    Ok(Box::new(Gains((0..context.cameras).map(gain).collect())))
}

#[test]
fn cameras_may_have_weights_of_their_own() {
    let info = Plugin { name: "gains", version: "1", summary: "a test", paper: "", schema: "# no settings\n", capabilities: &[] };
    let plugin = AppearancePlugin { info, build: build_gains };
    assert_eq!(conformance::appearance(&plugin, &toml::Table::new(), &Device::flex()), Vec::<String>::new());
}

#[test]
fn a_frame_survives_offsets_of_a_wrong_shape() {
    let gaussians = HostGaussians {
        means: vec![0.0; 12],
        log_scales: vec![-3.0; 12],
        quaternions: [1.0, 0.0, 0.0, 0.0].repeat(4),
        opacity_logits: vec![0.0; 4],
        sh_dc: vec![0.0; 12],
        dynamic_scores: vec![1.0, 0.0, 1.0, 0.0],
        extra: [("velocity".to_string(), ExtraAttribute::exact(3, vec![1.0; 12]))].into(),
        ..Default::default()
    };
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 0, seed: Seed::root(1) };
    let model = Model {
        gaussians,
        field: Some(ModelDeformer { field: Box::new(Velocities(Mistake::LateShape)), section: toml::Table::new(), context }),
        moving: Moving::Scored { zeta: 0.5 },
        render: RenderConfig::default(),
        background: None,
        rasterizer: default_rasterizer(),
        frame_count: 2,
        normalisation: Similarity::IDENTITY,
        provenance: Default::default(),
        size: Default::default(),
    };
    let mut player = Player::new(&model, &Registry::collect().unwrap(), &Device::flex()).unwrap();
    let mut at = |time| player.gaussians_at(time).and_then(|gaussians| gaussians.to_host());
    let whole = at(0.25).unwrap();
    assert!(at(0.75).unwrap_err().to_string().contains("head means"));
    assert_eq!(whole.len(), 4);
    assert!(at(0.25).unwrap() == whole, "the frame has lost what does not move");
}
