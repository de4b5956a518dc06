//! The deformer of Grid4D: a spatial hash grid whose features, turned into attention, weigh those of three grids over pairs of axes and time (Xu et al. 2024).
//!
//! Motion is rigid and additive, R(q) x + t; scale changes are added after the exponential, rotations to the normalised quaternion. Positions are normalised by
//! the deformer's box rather than by a fixed bound per dataset, and so are the perturbations of the smoothness term. R(q) passes no gradient to the canonical
//! centre. The published term begins when Gaussians no longer grow on N3DV, for which there is `smooth_from`. It also perturbs times on most D-NeRF scenes,
//! which is omitted. The last layers start at zero, so that nothing moves at first; the published ones are random, as with `random_heads`.

use crate::parts::centres::{check_time, column, finite, in_box};
use crate::parts::settings::{bounded, not_negative, within};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_backends::ops::lookup::{GridShape, Outside, lookup};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput,
    config, inventory, ordered_sum,
};
use rand::Rng;
use serde::Deserialize;
use std::sync::Arc;

const SCHEMA: &str = r#"log2_rows = 19           # upper bound on the rows of a level's table, as a power of two
space_levels = 16        # levels of the spatial grid
space_base = 16          # vertices per axis of its first level
space_final = 2048       # vertices per axis of its last level
time_levels = 32         # levels of the three grids with time
time_base = [8, 8, 8]    # vertices per axis of their first level
time_final = [32, 32, 16]    # vertices per axis of their last level (published: [512, 512, 128] or [64, 64, 128] on N3DV)
features = 2             # per level
width = 256
depth = 0                # hidden layers after the attention
random_heads = false     # start the last layers at random, as published, in place of zero: the first offsets displace all Gaussians
smooth_weight = 0.5      # weight of the squared difference of features at perturbed centres
smooth_delta = 1e-3      # the largest perturbation per axis, as a share of the box (published: 8e-5 on N3DV, 3e-3 on D-NeRF)
smooth_from = 0.0        # share of the main stage after which smoothness counts (published: 0.706 on N3DV, where Gaussians grow until then)
lr_grid_start = 8e-3     # Adam on the tables
lr_grid_end = 8e-5
lr_start = 8e-4          # Adam on the network
lr_end = 1.6e-6
"#;

/// The axes of the three grids with time (3).
const PLANES: [[usize; 3]; 3] = [[0, 1, 3], [1, 2, 3], [0, 2, 3]];
const NAMES: [&str; 3] = ["xyt", "yzt", "xzt"];
/// Times are mapped to the middle of their axis, to this share of its length.
const TIME_SHARE: f32 = 0.9;
/// Initial table entries are uniform in ± this.
const TABLE: f32 = 1e-4;
/// Widths of the heads: rotation and translation, quaternion, scales.
const OUTPUTS: [usize; 3] = [7, 4, 3];
/// Parameter groups by index.
const NET: usize = 0;
const GRID: usize = 1;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    log2_rows: u32,
    space_levels: usize,
    space_base: u32,
    space_final: u32,
    time_levels: usize,
    time_base: [u32; 3],
    time_final: [u32; 3],
    features: usize,
    width: usize,
    depth: usize,
    random_heads: bool,
    smooth_weight: f32,
    smooth_delta: f32,
    smooth_from: f32,
    lr_grid_start: f64,
    lr_grid_end: f64,
    lr_start: f64,
    lr_end: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            log2_rows: 19,
            space_levels: 16,
            space_base: 16,
            space_final: 2048,
            time_levels: 32,
            time_base: [8; 3],
            time_final: [32, 32, 16],
            features: 2,
            width: 256,
            depth: 0,
            random_heads: false,
            smooth_weight: 0.5,
            smooth_delta: 1e-3,
            smooth_from: 0.0,
            lr_grid_start: 8e-3,
            lr_grid_end: 8e-5,
            lr_start: 8e-4,
            lr_end: 1.6e-6,
        }
    }
}

/// A 3D grid whose axes grow geometrically from `base` to `last`.
fn grid(levels: usize, features: usize, base: [u32; 3], last: [u32; 3], log2_rows: u32) -> GridShape {
    let mut shape = GridShape { dims: 3, features, levels: Vec::new(), stagger: 0.0, smooth: true, clamps: false, outside: Outside::Zero };
    for level in 0..levels {
        let share = level as f64 / (levels - 1).max(1) as f64;
        let scale: [f64; 3] = std::array::from_fn(|d| f64::from(base[d]) * (f64::from(last[d]) / f64::from(base[d])).powf(share) - 1.0);
        shape.push(&scale.map(|s| s.ceil() as u32 + 1), &scale.map(|s| s as f32), 1 << log2_rows);
    }
    shape
}

/// Parameters: four tables, attention layer, temporal layer, layers behind the attention with the heads.
struct Grid4d {
    settings: Settings,
    context: DeformerContext,
    space: Arc<GridShape>,
    time: Arc<GridShape>,
    attention: Arc<ReluShape>,
    temporal: Arc<ReluShape>,
    network: Arc<ReluShape>,
    parameters: Vec<Parameter>,
    /// Progress of the main stage, 0..1.
    progress: f32,
}

impl Grid4d {
    fn new(settings: Settings, context: &DeformerContext, device: &Device) -> Result<Self> {
        let s = &settings;
        within("log2_rows", s.log2_rows as usize, 4, 24)?;
        within("space_levels", s.space_levels, 1, 64)?;
        within("time_levels", s.time_levels, 1, 64)?;
        within("features", s.features, 1, 16)?;
        within("width", s.width, 1, 4096)?;
        within("depth", s.depth, 0, 16)?;
        for (name, base, last) in
            [("space_base", s.space_base, s.space_final)].into_iter().chain((0..3).map(|d| ("time_base", s.time_base[d], s.time_final[d])))
        {
            within(name, base as usize, 2, last.max(2) as usize)?;
            within(name, last as usize, 2, 65_536)?;
        }
        for (name, value, most) in [("smooth_weight", s.smooth_weight, 1e6), ("smooth_delta", s.smooth_delta, 1.0), ("smooth_from", s.smooth_from, 1.0)] {
            if !(0.0..=most).contains(&value) {
                return Err(Error::parameter(format!("deformer.{name}"), format!("{value} is not in 0..{most}"), "Choose a value in this range"));
            }
        }
        not_negative(&[("lr_grid_start", s.lr_grid_start), ("lr_grid_end", s.lr_grid_end), ("lr_start", s.lr_start), ("lr_end", s.lr_end)])?;
        let space = grid(s.space_levels, s.features, [s.space_base; 3], [s.space_final; 3], s.log2_rows);
        let time = grid(s.time_levels, s.features, s.time_base, s.time_final, s.log2_rows);
        let attention = ReluShape::chain(&[space.width(), s.width]);
        let temporal = ReluShape { input: 3 * time.width(), trunk: vec![s.width], heads: Vec::new() };
        let network = ReluShape { input: s.width, trunk: vec![s.width; s.depth], heads: OUTPUTS.iter().map(|&out| vec![out]).collect() };
        let of_network = [&attention, &temporal, &network].map(ReluShape::parameter_count);
        bounded([space.parameter_count(), time.parameter_count().saturating_mul(NAMES.len())].into_iter().chain(of_network))?;
        let seed = context.seed;
        let table = |name: &str, shape: &GridShape| {
            parameter(format!("grid.{name}"), Part::Grid, GRID, weights::uniform(seed.child(name), shape.parameter_count(), TABLE), device)
        };
        let mut parameters = vec![table("xyz", &space)];
        parameters.extend(NAMES.map(|name| table(name, &time)));
        let layers = |name: &str, pairs: &[(usize, usize)]| -> Vec<f32> {
            pairs.iter().enumerate().flat_map(|(i, &(a, b))| weights::torch(seed.child(name).index(i as u64), a, b)).collect()
        };
        // Published heads are random: their first offsets move static parts of the scene, and short runs never undo it.
        let mut heads = layers("heads", &vec![(s.width, s.width); s.depth]);
        if s.random_heads {
            heads.extend(layers("last", &OUTPUTS.map(|out| (s.width, out))));
        } else {
            heads.extend(OUTPUTS.iter().flat_map(|&out| weights::zeros(s.width, out)));
        }
        for (name, values) in [
            ("attention", layers("attention", &[(space.width(), s.width)])),
            ("temporal", layers("temporal", &[(3 * time.width(), s.width)])),
            ("heads", heads),
        ] {
            parameters.push(parameter(format!("net.{name}"), Part::Net, NET, values, device));
        }
        let (space, time, attention, temporal, network) = (Arc::new(space), Arc::new(time), Arc::new(attention), Arc::new(temporal), Arc::new(network));
        Ok(Self { context: context.clone(), space, time, attention, temporal, network, parameters, settings, progress: 1.0 })
    }
    fn weight(&self, index: usize) -> Tensor<1> {
        self.parameters[index].value.clone()
    }
    /// Features of the three grids with time at positions `[M,3]` in 0..1 of the box, concatenated.
    fn with_time(&self, position: &Tensor<2>, time_norm: f32) -> Result<Tensor<2>> {
        let time = column(position, 0.5 + TIME_SHARE * (time_norm - 0.5));
        let points = Tensor::cat(vec![position.clone(), time], 1);
        let found = PLANES.iter().enumerate().map(|(p, axes)| {
            let own = Tensor::cat(axes.map(|axis| points.clone().narrow(1, axis, 1)).to_vec(), 1);
            lookup(self.weight(1 + p), own, &self.time)
        });
        Ok(Tensor::cat(found.collect::<Result<Vec<_>>>()?, 1))
    }
}

fn only(outputs: Vec<Tensor<2>>) -> Result<Tensor<2>> {
    outputs.into_iter().next().ok_or_else(|| Error::backend("deformer grid4d", "a network returned no output", "Report this as a defect"))
}

/// R(q) x for quaternions `[M,4]` (w,x,y,z), divided by their squared norm, and points `[M,3]`.
fn rotate(q: Tensor<2>, x: Tensor<2>) -> Tensor<2> {
    let part = |t: &Tensor<2>, k: usize| t.clone().narrow(1, k, 1);
    let [w, a, b, c] = std::array::from_fn(|k| part(&q, k));
    let [x0, x1, x2] = std::array::from_fn(|k| part(&x, k));
    let norm = q.clone().powi_scalar(2).sum_dim(1).clamp_min(1e-12);
    // x + 2 w (v × x) + 2 v × (v × x), with v the vector part.
    let cross = |p: [&Tensor<2>; 3], r: [&Tensor<2>; 3]| -> [Tensor<2>; 3] {
        std::array::from_fn(|k| p[(k + 1) % 3].clone() * r[(k + 2) % 3].clone() - p[(k + 2) % 3].clone() * r[(k + 1) % 3].clone())
    };
    let once = cross([&a, &b, &c], [&x0, &x1, &x2]);
    let twice = cross([&a, &b, &c], [&once[0], &once[1], &once[2]]);
    let turn = once.into_iter().zip(twice).map(|(once, twice)| (w.clone() * once + twice).mul_scalar(2.0) / norm.clone());
    x + Tensor::cat(turn.collect(), 1)
}

impl Deformer for Grid4d {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let m = means_world.dims()[0];
        let work = DeformerWork { gaussians: m as u64, ..DeformerWork::default() };
        if m == 0 {
            return Ok(SpatialFeatures { values: Tensor::zeros([0, 6 + self.settings.width], &means_world.device()), work });
        }
        let position = in_box(means_world.clone(), &self.context);
        let encoded = lookup(self.weight(0), position.clone(), &self.space)?;
        let attention = sigmoid(only(mlp_relu(encoded, self.weight(4), &self.attention)?)?).mul_scalar(2.0) - 1.0;
        Ok(SpatialFeatures { values: Tensor::cat(vec![finite(means_world), position, attention], 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let m = features.dims()[0];
        if m == 0 {
            let [means, quaternions, scales] = [3, 4, 3].map(|width| Some(Tensor::zeros([0, width], &features.device())));
            return Ok(Offsets { means, quaternions, unit_quaternions: true, scales, ..Offsets::default() });
        }
        let (x, position) = (features.clone().narrow(1, 0, 3), features.clone().narrow(1, 3, 3));
        let attention = features.narrow(1, 6, self.settings.width);
        let temporal = only(mlp_relu(self.with_time(&position, time_norm)?, self.weight(5), &self.temporal)?)?;
        let outputs = mlp_relu(attention * temporal, self.weight(6), &self.network)?;
        let [motion, quaternions, scales]: [Tensor<2>; 3] =
            outputs.try_into().map_err(|_| Error::backend("deformer grid4d", "the network returned another number of heads", "Report this as a defect"))?;
        let identity = Tensor::<2>::from_data(TensorData::new(vec![1.0f32, 0.0, 0.0, 0.0], [1, 4]), &motion.device());
        let turned = rotate(motion.clone().narrow(1, 0, 4) + identity, x.clone());
        let means = turned - x + motion.narrow(1, 4, 3);
        Ok(Offsets { means: Some(means), quaternions: Some(quaternions), unit_quaternions: true, scales: Some(scales), ..Offsets::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let s = &self.settings;
        vec![ParameterGroup::plain("grid4d net", s.lr_start, s.lr_end), ParameterGroup::plain("grid4d tables", s.lr_grid_start, s.lr_grid_end)]
    }
    /// Smoothness: squared differences of features at centres and at slightly perturbed centres, both at `time_norm`, summed over channels and averaged over
    /// centres. None before the share `smooth_from` of the main stage; a trained deformer that is trained further has it.
    fn regularizer(&self, input: &SpatialInput, time_norm: f32, progress: f32) -> Result<Option<Tensor<1>>> {
        let s = &self.settings;
        let m = input.len();
        if m == 0 || s.smooth_weight <= 0.0 || self.progress < s.smooth_from {
            return Ok(None);
        }
        let mut random = self.context.seed.child("perturb").index(u64::from(progress.to_bits())).rng();
        let shift: Vec<f32> = (0..3 * m).map(|_| random.random_range(-s.smooth_delta..=s.smooth_delta)).collect();
        let here = in_box(input.means_world.clone(), &self.context);
        let there = here.clone() + Tensor::<2>::from_data(TensorData::new(shift, [m, 3]), &here.device());
        let squares = |a: Tensor<2>, b: Tensor<2>| ordered_sum((a - b).powi_scalar(2)).mul_scalar(s.smooth_weight / m as f32);
        let still = squares(lookup(self.weight(0), here.clone(), &self.space)?, lookup(self.weight(0), there.clone(), &self.space)?);
        Ok(Some(still + squares(self.with_time(&here, time_norm)?, self.with_time(&there, time_norm)?)))
    }
    fn set_progress(&mut self, progress: f32) {
        self.progress = progress;
    }
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Grid4d::new(config::parse_section("deformer grid4d", section)?, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "grid4d",
            version: "1",
            summary: "four 3D hash grids, spatial attention over temporal features, rigid motion",
            paper: "Grid4D (Xu et al. 2024)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "cached-spatial", "regularized"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;

    #[test]
    fn perturbations_that_cannot_be_drawn_are_refused() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let build = |smooth_delta: f32, smooth_weight: f32| {
            let small = Settings { log2_rows: 4, space_levels: 1, time_levels: 1, width: 4, ..Settings::default() };
            Grid4d::new(Settings { smooth_delta, smooth_weight, ..small }, &context, &Device::flex())
        };
        for (smooth_delta, smooth_weight) in [(-1e-3, 0.5), (f32::NAN, 0.5), (f32::INFINITY, 0.5), (5e-3, f32::NAN), (5e-3, -0.5)] {
            assert!(build(smooth_delta, smooth_weight).is_err(), "{smooth_delta}, {smooth_weight}");
        }
        assert!(build(0.0, 0.0).is_ok() && build(5e-3, 0.5).is_ok());
    }

    #[test]
    fn smoothness_begins_at_its_share_of_the_main_stage() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let small = Settings { log2_rows: 4, space_levels: 1, time_levels: 1, width: 4, smooth_from: 0.7, ..Settings::default() };
        let mut deformer = Grid4d::new(small, &context, &Device::flex()).unwrap();
        let input = SpatialInput::new(Tensor::from_floats([[0.3, -0.2, 0.1]], &Device::flex()));
        let counts = |deformer: &Grid4d, progress: f32| deformer.regularizer(&input, 0.5, progress).unwrap().is_some();
        assert!(counts(&deformer, 0.5), "a trained deformer that is trained further is smoothed");
        for (progress, wanted) in [(0.001, false), (0.69, false), (0.71, true), (1.0, true)] {
            deformer.set_progress(progress);
            assert_eq!(counts(&deformer, progress), wanted, "at {progress}");
        }
        for smooth_from in [-0.1, 1.1, f32::NAN] {
            let error = Grid4d::new(Settings { smooth_from, ..Settings::default() }, &context, &Device::flex()).err().map(|e| e.to_string());
            assert!(error.is_some_and(|e| e.contains("smooth_from")), "{smooth_from}");
        }
    }

    #[test]
    fn smoothness_compares_features_of_one_time() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let of = |smooth_delta: f32, time_norm: f32| {
            let small = Settings { log2_rows: 4, space_levels: 1, time_levels: 1, width: 4, smooth_delta, ..Settings::default() };
            let deformer = Grid4d::new(small, &context, &Device::flex()).unwrap();
            let input = SpatialInput::new(Tensor::from_floats([[0.3, -0.2, 0.1]], &Device::flex()));
            deformer.regularizer(&input, time_norm, 0.5).unwrap().unwrap().into_scalar::<f32>()
        };
        for time_norm in [0.0, 0.5, 1.0] {
            assert_eq!(of(0.0, time_norm), 0.0, "without perturbed centres there is no difference at {time_norm}");
            assert!(of(0.01, time_norm) > 0.0, "{time_norm}");
        }
    }
}
