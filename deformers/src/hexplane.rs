//! The deformer of 4DGS: six planes of features over the pairs of x, y, z and t at two resolutions, multiplied, then five heads (Wu et al. 2024).
//!
//! The published code feeds times of 0..1 to planes that expect -1..1, so that half of the time axis is never read; `half_time` reproduces that.

use crate::parts::centres::{check_time, column, in_box};
use crate::parts::heads::{self, Head};
use crate::parts::settings::{bounded, not_negative, within};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::{Device, Tensor};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_backends::ops::lookup::{GridShape, Outside, lookup};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput, config,
    inventory, ordered_sum,
};
use rand::Rng;
use serde::Deserialize;
use std::sync::Arc;

const SCHEMA: &str = r#"resolution = 64          # vertices per spatial axis of the first resolution
multires = [1, 2]        # factors of the spatial axes; the time axis is not scaled
time_resolution = 150    # vertices of the time axis
features = 16            # per plane
width = 128              # width of the network
heads = ["means", "log_scales", "quaternions", "opacity", "sh"]
half_time = false        # read only the upper half of the time axis, as the published code does
random_heads = false     # start the last layers at random, as published, in place of zero: the first offsets displace all Gaussians
tv_space = 2e-4          # weight of the squared second differences of spatial planes
tv_time = 1e-3           # the same for planes with time, along time
time_one = 1e-4          # weight of the distance from 1 of planes with time
lr_start = 1.6e-4        # Adam on the network, log-linear to lr_end
lr_end = 1.6e-5
grid_rate = 10.0         # learning rate of the planes, as a multiple
times_extent = true      # multiply the rates by the extent of the cameras in the normalised frame, as published
"#;

/// The axes of each plane; axis 3 is time.
const PLANES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
const TIME: usize = 3;
/// Parameter groups by index.
const NET: usize = 0;
const GRID: usize = 1;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    resolution: u32,
    multires: Vec<u32>,
    time_resolution: u32,
    features: usize,
    width: usize,
    heads: Vec<Head>,
    half_time: bool,
    random_heads: bool,
    tv_space: f32,
    tv_time: f32,
    time_one: f32,
    lr_start: f64,
    lr_end: f64,
    grid_rate: f64,
    times_extent: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            resolution: 64,
            multires: vec![1, 2],
            time_resolution: 150,
            features: 16,
            width: 128,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh],
            half_time: false,
            random_heads: false,
            tv_space: 2e-4,
            tv_time: 1e-3,
            time_one: 1e-4,
            lr_start: 1.6e-4,
            lr_end: 1.6e-5,
            grid_rate: 10.0,
            times_extent: true,
        }
    }
}

/// Parameters: six planes (all resolutions of each), the network.
struct HexPlane {
    settings: Settings,
    context: DeformerContext,
    planes: Vec<Arc<GridShape>>,
    network: Arc<ReluShape>,
    parameters: Vec<Parameter>,
}

impl HexPlane {
    fn new(settings: Settings, context: &DeformerContext, device: &Device) -> Result<Self> {
        within("resolution", settings.resolution as usize, 2, 4096)?;
        within("time_resolution", settings.time_resolution as usize, 2, 100_000)?;
        within("multires", settings.multires.len(), 1, 8)?;
        settings.multires.iter().try_for_each(|&m| within("multires", m as usize, 1, 64))?;
        within("features", settings.features, 1, 256)?;
        within("width", settings.width, 1, 4096)?;
        heads::check(&settings.heads)?;
        let penalties = [("tv_space", settings.tv_space), ("tv_time", settings.tv_time), ("time_one", settings.time_one)];
        not_negative(&penalties.map(|(name, weight)| (name, f64::from(weight))))?;
        not_negative(&[("lr_start", settings.lr_start), ("lr_end", settings.lr_end), ("grid_rate", settings.grid_rate)])?;
        let (input, w) = (settings.features * settings.multires.len(), settings.width);
        let network = ReluShape { input, trunk: vec![w], heads: settings.heads.iter().map(|h| vec![w, h.width(context.sh_degree)]).collect() };
        let plane = |axes: &[usize; 2]| {
            let mut shape =
                GridShape { dims: 2, features: settings.features, levels: Vec::new(), stagger: 0.0, smooth: false, clamps: true, outside: Outside::Clamp };
            for &factor in &settings.multires {
                let size = axes.map(|axis| if axis == TIME { settings.time_resolution } else { settings.resolution * factor });
                shape.push(&size, &size.map(|s| s as f32 - 1.0), usize::MAX);
            }
            shape
        };
        let shapes = PLANES.each_ref().map(plane);
        bounded(shapes.iter().map(GridShape::parameter_count).chain([network.parameter_count()]))?;
        let seed = context.seed;
        let (mut planes, mut parameters) = (Vec::new(), Vec::new());
        for (p, (axes, shape)) in PLANES.iter().zip(shapes).enumerate() {
            let mut random = seed.child("planes").index(p as u64).rng();
            let values = (0..shape.parameter_count()).map(|_| if axes[1] == TIME { 1.0 } else { random.random_range(0.1f32..0.5) }).collect();
            parameters.push(parameter(format!("grid.{}", ["xy", "xz", "xt", "yz", "yt", "zt"][p]), Part::Grid, GRID, values, device));
            planes.push(Arc::new(shape));
        }
        let mut values = weights::glorot_with_bias(seed.child("trunk"), input, w);
        for (i, head) in network.heads.iter().enumerate() {
            let own = seed.child("heads").index(i as u64);
            values.extend(weights::glorot_with_bias(own.child("first"), w, w));
            // The published layer is random: its first offsets displace all Gaussians, and short runs never recover.
            values.extend(if settings.random_heads { weights::glorot_with_bias(own.child("last"), w, head[1]) } else { weights::zeros(w, head[1]) });
        }
        parameters.push(parameter("net".into(), Part::Net, NET, values, device));
        Ok(Self { settings, context: context.clone(), planes, network: Arc::new(network), parameters })
    }
    fn net(&self) -> Tensor<1> {
        self.parameters[PLANES.len()].value.clone()
    }
    /// The product over the planes of `wanted` at points `[M,4]`.
    fn product(&self, points: &Tensor<2>, wanted: impl Fn(&[usize; 2]) -> bool) -> Result<Option<Tensor<2>>> {
        let mut product: Option<Tensor<2>> = None;
        for ((axes, shape), parameter) in PLANES.iter().zip(&self.planes).zip(&self.parameters) {
            if !wanted(axes) {
                continue;
            }
            let pair = Tensor::cat(axes.map(|axis| points.clone().narrow(1, axis, 1)).to_vec(), 1);
            let found = lookup(parameter.value.clone(), pair, shape)?;
            product = Some(match product {
                Some(sofar) => sofar * found,
                None => found,
            });
        }
        Ok(product)
    }
}

impl Deformer for HexPlane {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let m = means_world.dims()[0];
        let work = DeformerWork { gaussians: m as u64, ..DeformerWork::default() };
        let position = in_box(means_world, &self.context);
        if m == 0 {
            return Ok(SpatialFeatures { values: Tensor::zeros([0, 3 + self.network.input], &position.device()), work });
        }
        // Three of the six planes do not depend on time.
        let still = Tensor::cat(vec![position.clone(), column(&position, 0.0)], 1);
        let product = self.product(&still, |axes| axes[1] != TIME)?;
        Ok(SpatialFeatures { values: Tensor::cat(std::iter::once(position).chain(product).collect(), 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let (m, degree) = (features.dims()[0], self.context.sh_degree);
        if m == 0 {
            let empty = self.network.output_widths().into_iter().map(|width| Tensor::zeros([0, width], &features.device())).collect();
            return Ok(heads::offsets(&self.settings.heads, empty, degree));
        }
        let time = if self.settings.half_time { 0.5 + 0.5 * time_norm } else { time_norm };
        let position = features.clone().narrow(1, 0, 3);
        let points = Tensor::cat(vec![position, column(&features, time)], 1);
        let still = features.narrow(1, 3, self.network.input);
        let all = match self.product(&points, |axes| axes[1] == TIME)? {
            Some(moving) => still * moving,
            None => still,
        };
        Ok(heads::offsets(&self.settings.heads, mlp_relu(all, self.net(), &self.network)?, degree))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let s = &self.settings;
        let group = |name, factor| ParameterGroup { times_extent: s.times_extent, ..ParameterGroup::plain(name, s.lr_start * factor, s.lr_end * factor) };
        vec![group("hexplane net", 1.0), group("hexplane planes", s.grid_rate)]
    }
    /// Smoothness of all planes, and closeness to 1 of planes with time (weights of the published code): squared second differences along a plane's second
    /// axis, which is time if the plane has it.
    fn regularizer(&self, _input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        let s = &self.settings;
        let mut total: Option<Tensor<1>> = None;
        let mut add = |term: Tensor<1>| {
            total = Some(match total.take() {
                Some(sum) => sum + term,
                None => term,
            });
        };
        for ((axes, shape), parameter) in PLANES.iter().zip(&self.planes).zip(&self.parameters) {
            let (is_time, f) = (axes[1] == TIME, s.features);
            let weight = if is_time { s.tv_time } else { s.tv_space };
            for level in &shape.levels {
                let [across, along] = [level.size[0] as usize, level.size[1] as usize];
                let plane = parameter.value.clone().narrow(0, level.first_row * f, level.rows * f).reshape([along, across * f]);
                if weight > 0.0 && along > 2 {
                    let n = along - 2;
                    let bend = plane.clone().narrow(0, 0, n) - plane.clone().narrow(0, 1, n).mul_scalar(2.0) + plane.clone().narrow(0, 2, n);
                    add(mean(bend.clone() * bend).mul_scalar(weight));
                }
                if is_time && s.time_one > 0.0 {
                    add(mean((plane - 1.0).abs()).mul_scalar(s.time_one));
                }
            }
        }
        Ok(total)
    }
}

/// Mean of all `values`, the same bits whatever the number of threads.
fn mean(values: Tensor<2>) -> Tensor<1> {
    let count = values.dims().iter().product::<usize>();
    ordered_sum(values).mul_scalar(1.0 / count as f64)
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(HexPlane::new(config::parse_section("deformer hexplane", section)?, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "hexplane",
            version: "1",
            summary: "six feature planes over space and time at two resolutions, multiplied",
            paper: "4DGS (Wu et al. 2024)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "cached-spatial", "regularized"],
        },
        build,
    }
}
