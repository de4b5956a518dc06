//! A 3x3 matrix and an offset per training camera: exposure, white balance and flare.
//!
//! Camera c records (I + D_c - mean D) rgb + (b_c - mean b). The mean over the training cameras is the identity by construction, so that the model cannot move
//! a colour change common to all cameras out of the Gaussians. Held-out cameras see the rendered image, which is the mean.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::colors::{NUMBERS, affine_colors};
use cc4dgs_core::{Appearance, AppearanceContext, AppearancePlugin, Error, Parameter, ParameterGroup, Part, Plugin, Result, config, inventory, ordered_sum};
use serde::Deserialize;

const SCHEMA: &str = "\
lr = 1e-3                # learning rate of matrices and offsets
identity = 1e-3          # weight of the squared distance from the identity, mean over cameras (FreeTimeGS++: 1e-3)
";
/// The transform that changes nothing: the rows of the matrix, then the offset.
const IDENTITY: [f32; NUMBERS] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    lr: f64,
    identity: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { lr: 1e-3, identity: 1e-3 }
    }
}

struct Affine {
    settings: Settings,
    cameras: usize,
    /// D and b of all cameras `[cameras, 12]`, flat: the rows of the matrix, then the offset.
    parameters: Vec<Parameter>,
}

impl Affine {
    /// Differences from the mean `[cameras, 12]`.
    fn differences(&self) -> Tensor<2> {
        let all = self.parameters[0].value.clone().reshape([self.cameras, NUMBERS]);
        all.clone() - all.mean_dim(0)
    }
}

impl Appearance for Affine {
    fn apply(&self, planes: Tensor<3>, camera: Option<usize>) -> Result<Tensor<3>> {
        let Some(camera) = camera else { return Ok(planes) };
        if camera >= self.cameras {
            return Err(Error::parameter("appearance affine", format!("camera {camera} of {}", self.cameras), "Report this as a defect"));
        }
        let own = self.differences().narrow(0, camera, 1).reshape([NUMBERS]);
        let identity = Tensor::from_floats(IDENTITY, &own.device());
        affine_colors(planes, own + identity)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup { epsilon: 1e-8, ..ParameterGroup::plain("affine appearance", self.settings.lr, self.settings.lr) }]
    }
    fn regularizer(&self) -> Result<Option<Tensor<1>>> {
        if self.settings.identity == 0.0 {
            return Ok(None);
        }
        let own = self.parameters[0].value.clone();
        Ok(Some(ordered_sum(own.clone() * own).mul_scalar(self.settings.identity / self.cameras.max(1) as f64)))
    }
}

fn build(section: &toml::Table, context: &AppearanceContext, device: &Device) -> Result<Box<dyn Appearance>> {
    let settings: Settings = config::parse_section("appearance affine", section)?;
    for (name, value) in [("lr", settings.lr), ("identity", settings.identity)] {
        if !(0.0..=1e6).contains(&value) {
            return Err(Error::parameter(format!("appearance affine: {name}"), format!("{value} cannot be used"), "Give a finite number of 0 or more"));
        }
    }
    let cameras = context.cameras.max(1);
    let value = Tensor::<1>::from_data(TensorData::new(vec![0.0f32; cameras * NUMBERS], [cameras * NUMBERS]), device);
    let parameter = Parameter { name: "affine".into(), part: Part::Net, shape: vec![cameras, NUMBERS], value, group: 0 };
    Ok(Box::new(Affine { settings, cameras, parameters: vec![parameter] }))
}

inventory::submit! {
    AppearancePlugin {
        info: Plugin {
            name: "affine",
            version: "1",
            summary: "a colour matrix and offset per training camera, the identity on average",
            paper: "per-camera colour as in FreeTimeGS++ and Dynamic 3D Gaussians",
            schema: SCHEMA,
            capabilities: &["differentiable"],
        },
        build,
    }
}
