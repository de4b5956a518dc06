//! The deformer of Deformable-3DGS: a network of eight layers on positionally encoded centre and time (Yang et al. 2024).
//!
//! Scale changes are added after the exponential and rotations to the normalised quaternion, as in the published code, whose rasterizer does not normalise the
//! sum; ours does. The last layers start at zero, so that nothing moves at first; the published ones are random, as with `random_heads`.

use crate::parts::centres::{check_time, finite};
use crate::parts::settings::{bounded, not_negative, within};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput,
    config, inventory,
};
use serde::Deserialize;
use std::sync::Arc;

const SCHEMA: &str = r#"width = 256
layers = 8
skip = 5                 # the input is concatenated again after this many layers
position_bands = 10      # sines and cosines of x * 2^0 ... 2^9
time_bands = 10          # of t; the published code uses 6 on synthetic scenes
time_network = false     # a separate network for time (256 wide, 30 outputs), as on synthetic scenes
random_heads = false     # start the last layers at random, as published, in place of zero: the first offsets displace all Gaussians
lr_start = 8e-4          # Adam, log-linear to lr_end
lr_end = 1.6e-6
"#;

/// Hidden width and output of the time network.
const TIME_WIDTHS: [usize; 2] = [256, 30];
/// Widths of centre, rotation, scale.
const OUTPUTS: [usize; 3] = [3, 4, 3];

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    width: usize,
    layers: usize,
    skip: usize,
    position_bands: usize,
    time_bands: usize,
    time_network: bool,
    random_heads: bool,
    lr_start: f64,
    lr_end: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { width: 256, layers: 8, skip: 5, position_bands: 10, time_bands: 10, time_network: false, random_heads: false, lr_start: 8e-4, lr_end: 1.6e-6 }
    }
}

/// Parameters: layers before the skip, layers after it with the heads, the optional time network.
struct DeformMlp {
    settings: Settings,
    before: Arc<ReluShape>,
    after: Arc<ReluShape>,
    time: Option<Arc<ReluShape>>,
    parameters: Vec<Parameter>,
}

/// x, then sines and cosines of x times powers of two, per column.
fn encode(x: Tensor<2>, bands: usize) -> Tensor<2> {
    let mut parts = vec![x.clone()];
    for band in 0..bands {
        let turned = x.clone().mul_scalar((band as f32).exp2());
        parts.extend([turned.clone().sin(), turned.cos()]);
    }
    Tensor::cat(parts, 1)
}

impl DeformMlp {
    fn new(settings: Settings, context: &DeformerContext, device: &Device) -> Result<Self> {
        within("width", settings.width, 1, 4096)?;
        within("layers", settings.layers, 2, 32)?;
        within("skip", settings.skip, 1, settings.layers - 1)?;
        within("position_bands", settings.position_bands, 0, 20)?;
        within("time_bands", settings.time_bands, 0, 20)?;
        not_negative(&[("lr_start", settings.lr_start), ("lr_end", settings.lr_end)])?;
        let of_time = 1 + 2 * settings.time_bands;
        let input = 3 * (1 + 2 * settings.position_bands) + if settings.time_network { TIME_WIDTHS[1] } else { of_time };
        let w = settings.width;
        let before = ReluShape { input, trunk: vec![w; settings.skip], heads: Vec::new() };
        let after = ReluShape { input: input + w, trunk: vec![w; settings.layers - settings.skip], heads: OUTPUTS.iter().map(|&out| vec![out]).collect() };
        let time = settings.time_network.then(|| ReluShape::chain(&[of_time, TIME_WIDTHS[0], TIME_WIDTHS[1]]));
        bounded([before.parameter_count(), after.parameter_count()])?;
        let seed = context.seed;
        let layers = |name: &str, pairs: Vec<(usize, usize)>| -> Vec<f32> {
            pairs.into_iter().enumerate().flat_map(|(i, (a, b))| weights::torch(seed.child(name).index(i as u64), a, b)).collect()
        };
        let chain = |first: usize, widths: &[usize]| -> Vec<(usize, usize)> {
            std::iter::once(first).chain(widths.iter().copied()).zip(widths.iter().copied()).collect()
        };
        let add = |name: &str, values| parameter(format!("net.{name}"), Part::Net, 0, values, device);
        let mut last = layers("after", chain(after.input, &after.trunk));
        // Published heads are random: their first offsets move static parts of the scene, and short runs never undo it.
        if settings.random_heads {
            last.extend(layers("last", OUTPUTS.iter().map(|&out| (w, out)).collect()));
        } else {
            last.extend(OUTPUTS.iter().flat_map(|&out| weights::zeros(w, out)));
        }
        let mut parameters = vec![add("before", layers("before", chain(input, &before.trunk))), add("after", last)];
        if time.is_some() {
            parameters.push(add("time", layers("time", chain(of_time, &TIME_WIDTHS))));
        }
        Ok(Self { settings, before: Arc::new(before), after: Arc::new(after), time: time.map(Arc::new), parameters })
    }
}

fn only(outputs: Vec<Tensor<2>>) -> Result<Tensor<2>> {
    outputs.into_iter().next().ok_or_else(|| Error::backend("deformer deform-mlp", "a network returned no output", "Report this as a defect"))
}

impl Deformer for DeformMlp {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let work = DeformerWork { gaussians: means_world.dims()[0] as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: encode(finite(means_world), self.settings.position_bands), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let (m, device) = (features.dims()[0], features.device());
        let outputs = if m == 0 {
            OUTPUTS.map(|width| Tensor::zeros([0, width], &device)).to_vec()
        } else {
            let mut time = encode(Tensor::from_data(TensorData::new(vec![time_norm], [1, 1]), &device), self.settings.time_bands);
            if let Some(shape) = &self.time {
                time = only(mlp_relu(time, self.parameters[2].value.clone(), shape)?)?;
            }
            let input = Tensor::cat(vec![features, time.repeat_dim(0, m)], 1);
            let hidden = only(mlp_relu(input.clone(), self.parameters[0].value.clone(), &self.before)?)?;
            mlp_relu(Tensor::cat(vec![input, hidden], 1), self.parameters[1].value.clone(), &self.after)?
        };
        let [means, rotation, scales]: [Tensor<2>; 3] =
            outputs.try_into().map_err(|_| Error::backend("deformer deform-mlp", "the network returned another number of heads", "Report this as a defect"))?;
        Ok(Offsets { means: Some(means), quaternions: Some(rotation), unit_quaternions: true, scales: Some(scales), ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup::plain("deform-mlp", self.settings.lr_start, self.settings.lr_end)]
    }
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(DeformMlp::new(config::parse_section("deformer deform-mlp", section)?, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "deform-mlp",
            version: "1",
            summary: "a deep network on encoded centre and time",
            paper: "Deformable 3DGS (Yang et al. 2024)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "cached-spatial"],
        },
        build,
    }
}
