//! `wobble`: every Gaussian swings with an amplitude and a phase of its own, and all of them drift with one wind.

use cc4dgs_core::burn::tensor::{Device, Tensor};
use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures,
    SpatialInput, config, inventory, ordered_sum, toml,
};
use std::f32::consts::TAU;

#[derive(Deserialize)]
#[serde(crate = "self::serde", default, deny_unknown_fields)]
struct Settings {
    cycles: f32,
    lr: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { cycles: 1.0, lr: 1e-3 }
    }
}

struct Wobble {
    settings: Settings,
    /// The wind [3], world units per sequence.
    parameters: Vec<Parameter>,
}

impl Deformer for Wobble {
    fn attributes(&self) -> Vec<AttributeSpec> {
        let amplitude = AttributeSpec { times_extent: true, tolerance: Some(1e-4), ..AttributeSpec::new("wobble_amplitude", 3, 0.0, self.settings.lr) };
        let phase = AttributeSpec { spread: 0.25, tolerance: Some(1e-3), ..AttributeSpec::new("wobble_phase", 1, 0.0, 10.0 * self.settings.lr) };
        vec![amplitude, phase]
    }
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        input.check("wobble", &self.attributes())?;
        let work = DeformerWork { gaussians: input.len() as u64, ..Default::default() };
        Ok(SpatialFeatures { values: Tensor::cat(input.attributes.clone(), 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let (amplitude, phase) = (features.clone().narrow(1, 0, 3), features.narrow(1, 3, 1).mul_scalar(TAU));
        // Nothing moves at time 0.
        let swing = phase.clone().add_scalar(TAU * self.settings.cycles * time_norm).sin() - phase.sin();
        let wind = self.parameters[0].value.clone().reshape([1, 3]).mul_scalar(time_norm);
        Ok(Offsets { means: Some(amplitude * swing + wind), ..Default::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup { times_extent: true, ..ParameterGroup::plain("wind", self.settings.lr, 0.1 * self.settings.lr) }]
    }
    fn regularizer(&self, input: &SpatialInput, _: f32, _: f32) -> Result<Option<Tensor<1>>> {
        // What need not swing should not.
        let squares = || input.attributes[0].clone().powi_scalar(2);
        Ok((!input.is_empty()).then(|| ordered_sum(squares()).mul_scalar(1e-3 / (3 * input.len()) as f32)))
    }
}

fn build(section: &toml::Table, _: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let settings: Settings = config::parse_section("deformer wobble", section)?;
    for (name, value) in [("cycles", f64::from(settings.cycles)), ("lr", settings.lr)] {
        if !value.is_finite() {
            return Err(Error::parameter(format!("deformer wobble: {name}"), format!("{value} is not finite"), "Give a number such as the default"));
        }
    }
    let wind = Parameter { name: "wind".into(), part: Part::Net, shape: vec![3], value: Tensor::zeros([3], device), group: 0 };
    Ok(Box::new(Wobble { settings, parameters: vec![wind] }))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "wobble",
            version: "1",
            summary: "an amplitude and a phase per Gaussian, and one wind",
            paper: "an example",
            schema: "cycles = 1.0             # per sequence\nlr = 1e-3                # Adam on the amplitudes, times the extent of the cameras in the normalised frame; phases ten times as fast\n",
            capabilities: &["differentiable", "starts-as-identity", "per-gaussian-attributes"],
        },
        build,
    }
}
