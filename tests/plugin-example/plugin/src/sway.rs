//! `sway`: every Gaussian swings by an amount that is linear in where it is. Small, and enough for grass in the wind.

use cc4dgs_core::burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput,
    config, inventory, toml,
};

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

/// Offsets = [x y z 1] W φ(t) with φ = (t, sin, cos - 1).
struct Sway {
    settings: Settings,
    /// W [4, 9]: three axes times three functions.
    parameters: Vec<Parameter>,
}

impl Deformer for Sway {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let m = means_world.dims()[0];
        // What is no number stays where it is.
        let odd = means_world.clone().is_nan();
        let centres = means_world.mask_fill(odd, 0.0).clamp(-1e4, 1e4);
        let one = Tensor::ones([m, 1], &centres.device());
        Ok(SpatialFeatures { values: Tensor::cat(vec![centres, one], 1), work: DeformerWork { gaussians: m as u64, ..Default::default() } })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let m = features.dims()[0];
        if m == 0 {
            return Ok(Offsets { means: Some(Tensor::zeros([0, 3], &features.device())), ..Default::default() });
        }
        let angle = std::f32::consts::TAU * self.settings.cycles * time_norm;
        let phi = Tensor::<2>::from_data(TensorData::new(vec![time_norm, angle.sin(), angle.cos() - 1.0], [3, 1]), &features.device());
        let weights = self.parameters[0].value.clone().reshape([4, 9]);
        let means = features.matmul(weights).reshape([3 * m, 3]).matmul(phi).reshape([m, 3]);
        Ok(Offsets { means: Some(means), ..Default::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let lr = self.settings.lr;
        vec![ParameterGroup { name: "sway".into(), lr_start: lr, lr_end: 0.1 * lr, warmup: 0.0, times_extent: true, epsilon: 1e-15, clip_norm: 0.0 }]
    }
}

fn build(section: &toml::Table, _: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let settings: Settings = config::parse_section("deformer sway", section)?;
    let weights = Parameter { name: "weights".into(), part: Part::Net, shape: vec![4, 9], value: Tensor::zeros([36], device), group: 0 };
    Ok(Box::new(Sway { settings, parameters: vec![weights] }))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "sway",
            version: "1",
            summary: "swings by an amount linear in the position",
            paper: "an example",
            schema: "cycles = 1.0             # per sequence\nlr = 1e-3                # Adam, times the extent of the cameras in the normalised frame\n",
            capabilities: &["differentiable", "starts-as-identity"],
        },
        build,
    }
}
