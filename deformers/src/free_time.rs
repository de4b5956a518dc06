//! Gaussians that are free in time (FreeTimeGS, with the gate of FreeTimeGS++ and the flat-topped life of SharpTimeGS).
//!
//! Each has a velocity and a [`Life`]; there is no other motion. The mean of 1 - g, where g is the gate of a life, is penalised with the weight `gate_weight`,
//! so that only what appears or moves becomes temporary.

use crate::parts::lives::{Life, LifeSettings, side_by_side};
use burn::tensor::{Device, Tensor};
use cc4dgs_backends::ops::life::LifeAt;
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Offsets, Parameter, ParameterGroup, Plugin, Result, SpatialFeatures, SpatialInput,
    config, inventory,
};
use serde::Deserialize;

const SCHEMA: &str = "\
half_width = 0.05        # start of r, as a share of the sequence
falloff = 0.1            # start of s, as a share of the sequence
gate = 0.9               # start of the gate, 0..1: nearly as without time
gate_weight = 1e-3       # weight of the mean of 1 - gate; 0 is off
hidden_below = 0.01      # a Gaussian whose opacity factor is below this is hidden
center_lr = 1.6e-4       # Adam on T, as a share of the sequence
width_lr = 5e-3          # Adam on the logarithms of r and s
gate_lr = 1e-3           # Adam on the gate's logit over 20
velocity_lr = 1.6e-3     # Adam on the velocity in world units per sequence, times the extent of the cameras in the normalised frame
# velocity_lr_end = 1.6e-5   # the same at the end of the main stage, reached log-linearly (FreeTimeGS: a hundredth); no fall unless given
";

/// Centres of life are spread over the sequence, and a tenth beyond either end.
const SPREAD: f32 = 0.6;
/// Index of the gates among the attributes.
const GATE: usize = 3;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    half_width: f32,
    falloff: f32,
    gate: f32,
    gate_weight: f32,
    hidden_below: f32,
    center_lr: f64,
    width_lr: f64,
    gate_lr: f64,
    velocity_lr: f64,
    velocity_lr_end: Option<f64>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            half_width: 0.05,
            falloff: 0.1,
            gate: 0.9,
            gate_weight: 1e-3,
            hidden_below: 0.01,
            center_lr: 1.6e-4,
            width_lr: 5e-3,
            gate_lr: 1e-3,
            velocity_lr: 1.6e-3,
            velocity_lr_end: None,
        }
    }
}

/// It has no weights: everything learned is an attribute of Gaussians.
struct FreeTime {
    life: Life,
}

impl FreeTime {
    fn new(settings: Settings) -> Result<Self> {
        let Settings { half_width, falloff, gate, gate_weight, hidden_below, center_lr, width_lr, gate_lr, velocity_lr, velocity_lr_end } = settings;
        let rates = LifeSettings { center_lr, width_lr, gate_lr, velocity_lr, velocity_lr_end, ..LifeSettings::default() };
        let life = LifeSettings { half_width, falloff, gate, spread: SPREAD, gate_weight, hidden_below, ..rates };
        Ok(Self { life: Life::new(life)? })
    }
}

impl Deformer for FreeTime {
    fn attributes(&self) -> Vec<AttributeSpec> {
        self.life.attributes()
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("free-time", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: side_by_side(input.attributes.clone()), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        Ok(self.deform_all(features, &[time_norm])?.pop().unwrap_or_default())
    }
    fn deform_all(&self, features: Tensor<2>, times_norm: &[f32]) -> Result<Vec<Offsets>> {
        let at = |LifeAt { shift, log_factor }| Offsets { means: Some(shift), opacity_log_factor: Some(log_factor), ..Offsets::default() };
        Ok(self.life.at(features, times_norm, false)?.into_iter().map(at).collect())
    }
    fn regularizer(&self, input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        input.check("free-time", &self.attributes())?;
        Ok(input.attributes.get(GATE).and_then(|gates| self.life.regularizer(gates.clone())))
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

fn build(section: &toml::Table, _context: &DeformerContext, _device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(FreeTime::new(config::parse_section("deformer free-time", section)?)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "free-time",
            version: "1",
            summary: "a velocity and a temporal opacity per Gaussian, with a gate that keeps lasting ones visible throughout",
            paper: "FreeTimeGS; FreeTimeGS++; SharpTimeGS",
            schema: SCHEMA,
            capabilities: &["differentiable", "per-gaussian-attributes"],
        },
        build,
    }
}
