//! Gaussians that are free in time (FreeTimeGS, with the gate of FreeTimeGS++ and the flat-topped life of SharpTimeGS).
//!
//! Each has a velocity and a life: a centre T, a half-width r during which it is fully there, and a falloff s. Its centre is mu + v (t - T), its opacity is
//! multiplied by g + (1 - g) exp(-(max(|t - T| - r, 0) / s)^2). A gate g of 1 keeps it at all times. The mean of 1 - g is penalised with the weight `gate_weight`, so
//! that only what appears or moves becomes temporary.

use crate::parts::centres::check_time;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor};
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Plugin, Result, SpatialFeatures,
    SpatialInput, config, inventory,
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
velocity_lr = 1.6e-3     # Adam on the velocity in world units per sequence, times the extent of the cameras
";

/// Names of the attributes, in order, and their widths.
const ATTRIBUTES: [(&str, usize); 5] = [("life_center", 1), ("life_log_half_width", 1), ("life_log_falloff", 1), ("life_gate", 1), ("velocity", 3)];
/// How steep the gate is in its attribute (FreeTimeGS++).
const GATE_STEEPNESS: f32 = 20.0;
/// Least falloff, as a share of the sequence: a smaller one has no gradient.
const LEAST_FALLOFF: f32 = 1e-3;
/// Logarithm of the opacity factor of a hidden Gaussian.
const HIDDEN: f32 = -30.0;

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
        }
    }
}

/// It has no weights: everything learned is an attribute of Gaussians.
struct FreeTime {
    settings: Settings,
}

impl FreeTime {
    fn new(settings: Settings) -> Result<Self> {
        let limits = [
            ("half_width", settings.half_width, 1e-4, 10.0),
            ("falloff", settings.falloff, LEAST_FALLOFF, 10.0),
            ("gate", settings.gate, 1e-3, 0.999),
            ("gate_weight", settings.gate_weight, 0.0, 1.0),
            ("hidden_below", settings.hidden_below, 0.0, 0.999),
        ];
        match limits.into_iter().find(|(_, value, least, most)| !(*least..=*most).contains(value)) {
            Some((name, value, least, most)) => {
                Err(Error::parameter(format!("deformer.{name}"), format!("{value} is not in {least}..{most}"), "Choose a value in this range"))
            }
            None => Ok(Self { settings }),
        }
    }
}

impl Deformer for FreeTime {
    fn attributes(&self) -> Vec<AttributeSpec> {
        let s = &self.settings;
        let gate = (s.gate / (1.0 - s.gate)).ln() / GATE_STEEPNESS;
        // Centres of life are spread over the sequence, and a tenth beyond either end.
        let starts = [(0.5, 0.6), (s.half_width.ln(), 0.0), (s.falloff.ln(), 0.0), (gate, 0.0), (0.0, 0.0)];
        let rates = [s.center_lr, s.width_lr, s.width_lr, s.gate_lr, s.velocity_lr];
        let spec =
            |(((name, width), (start, spread)), lr)| AttributeSpec { spread, times_extent: name == "velocity", ..AttributeSpec::new(name, width, start, lr) };
        ATTRIBUTES.into_iter().zip(starts).zip(rates).map(spec).collect()
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("free-time", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: Tensor::cat(input.attributes.clone(), 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let [m, _] = features.dims();
        let column = |at: usize| features.clone().narrow(1, at, 1);
        let since = column(0).neg().add_scalar(time_norm);
        let outside = (since.clone().abs() - column(1).exp()).clamp_min(0.0);
        let in_falloffs = outside / column(2).exp().clamp_min(LEAST_FALLOFF);
        let life = in_falloffs.powi_scalar(2).clamp_max(-HIDDEN).neg().exp();
        let gate = sigmoid(column(3).mul_scalar(GATE_STEEPNESS));
        let factor = (gate.clone() + gate.neg().add_scalar(1.0) * life).clamp(HIDDEN.exp(), 1.0);
        let hidden = factor.clone().lower_elem(self.settings.hidden_below).reshape([m]);
        let log_factor = factor.log().reshape([m]).mask_fill(hidden, HIDDEN);
        let velocity = features.clone().narrow(1, 4, 3);
        Ok(Offsets { means: Some(velocity * since), opacity_log_factor: Some(log_factor), ..Offsets::default() })
    }
    fn regularizer(&self, input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        if self.settings.gate_weight == 0.0 || input.is_empty() {
            return Ok(None);
        }
        input.check("free-time", &self.attributes())?;
        let open = sigmoid(input.attributes[3].clone().mul_scalar(GATE_STEEPNESS)).mean();
        Ok(Some(open.neg().add_scalar(1.0).mul_scalar(self.settings.gate_weight)))
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
            summary: "a velocity and a life per Gaussian, with a gate for what lasts",
            paper: "FreeTimeGS; FreeTimeGS++; SharpTimeGS",
            schema: SCHEMA,
            capabilities: &["differentiable", "per-gaussian-attributes"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;

    #[test]
    fn lives_are_flat_then_fall_off_and_open_gates_last() {
        let device = Device::flex();
        let field = FreeTime::new(Settings::default()).unwrap();
        // Centre 0.5, half-width 0.1, falloff 0.1, velocity 2 along x; the gate is shut, then open.
        let (r, s) = (0.1f32.ln(), 0.1f32.ln());
        let features = Tensor::<2>::from_floats([[0.5, r, s, -1.0, 2.0, 0.0, 0.0], [0.5, r, s, 1.0, 2.0, 0.0, 0.0]], &device);
        let at = |time: f32| {
            let offsets = field.deform(features.clone(), time).unwrap();
            (to_vec(offsets.opacity_log_factor.unwrap(), "f").unwrap(), to_vec(offsets.means.unwrap(), "m").unwrap())
        };
        let (inside, means) = at(0.55);
        assert!(inside[0].abs() < 1e-4 && inside[1].abs() < 1e-4 && (means[0] - 0.1).abs() < 1e-5, "{inside:?} {means:?}");
        let (falling, _) = at(0.7);
        assert!((falling[0] + 1.0).abs() < 1e-3 && falling[1].abs() < 1e-4, "{falling:?}");
        let (gone, _) = at(1.0);
        assert!(gone[0] == HIDDEN && gone[1].abs() < 1e-4, "{gone:?}");
    }
}
