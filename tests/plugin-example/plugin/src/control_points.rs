//! `control-points`: a few points move, and every Gaussian follows the nearest of them. The points start on the first Gaussians, as those of SC-GS
//! (Huang et al. 2024), which also turn and are moved by a network.

use cc4dgs_core::burn::tensor::{Device, Tensor, TensorData, activation::relu};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, HostGaussians, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures,
    SpatialInput, config, inventory, toml,
};
use rand::Rng;
use std::f32::consts::TAU;

/// Largest absolute coordinate, world units.
const FAR: f32 = 1e4;
/// A squared distance beyond all.
const BEYOND: f32 = 1e12;

#[derive(Deserialize)]
#[serde(crate = "self::serde", default, deny_unknown_fields)]
struct Settings {
    points: usize,
    nearest: usize,
    cycles: f32,
    lr: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { points: 32, nearest: 3, cycles: 1.0, lr: 1e-3 }
    }
}

/// The offset of point j is A_j φ(t) with φ = (t, sin, cos - 1). A Gaussian's is the mean of those of the nearest points, weighted by distance.
struct ControlPoints {
    settings: Settings,
    /// Where the points are [K, 3], world units; A [K, 3, 3].
    parameters: Vec<Parameter>,
}

impl Deformer for ControlPoints {
    fn start_from(&mut self, first: &HostGaussians) -> Result<()> {
        let value = &mut self.parameters[0].value;
        let mut positions = to_vec(value.clone(), "control points")?;
        // Where there are fewer Gaussians than points, the others stay where they are.
        for (position, row) in positions.chunks_exact_mut(3).zip(farthest(&first.means, self.settings.points)) {
            position.copy_from_slice(&first.means[3 * row..3 * row + 3]);
        }
        positions.iter_mut().for_each(|v| *v = v.clamp(-FAR, FAR));
        let count = positions.len();
        *value = Tensor::from_data(TensorData::new(positions, [count]), &value.device());
        Ok(())
    }
    /// The weight of each point for each Gaussian [M, K].
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let (m, points) = (input.len(), self.settings.points);
        let work = DeformerWork { gaussians: m as u64, ..Default::default() };
        let means_world = input.means_world.clone();
        if m == 0 {
            return Ok(SpatialFeatures { values: Tensor::zeros([0, points], &means_world.device()), work });
        }
        // Coordinates that are not numbers count as 0.
        let odd = means_world.clone().is_nan();
        let centres = means_world.mask_fill(odd, 0.0).clamp(-FAR, FAR);
        let positions = self.parameters[0].value.clone().reshape([points, 3]);
        let [x, y, z] = [0, 1, 2].map(|axis| {
            let difference = centres.clone().narrow(1, axis, 1) - positions.clone().narrow(1, axis, 1).transpose();
            difference.clone() * difference
        });
        let squares = x + y + z;
        // The squared distance of the nearest point that does not count. Weights fall to zero there, so that none of them jumps when points change their order.
        let mut left = squares.clone();
        for _ in 0..self.settings.nearest {
            let taken = (left.clone() - left.clone().min_dim(1)).lower_equal_elem(0.0);
            left = left.mask_fill(taken, BEYOND);
        }
        let reach = left.min_dim(1).clamp_min(1e-12);
        let closeness = relu((squares / reach).neg().add_scalar(1.0));
        let weights = closeness.clone() * closeness;
        let sum = weights.clone().sum_dim(1).add_scalar(1e-6);
        Ok(SpatialFeatures { values: weights / sum, work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let device = features.device();
        if features.dims()[0] == 0 {
            return Ok(Offsets { means: Some(Tensor::zeros([0, 3], &device)), ..Default::default() });
        }
        let (points, angle) = (self.settings.points, TAU * self.settings.cycles * time_norm);
        let phi = Tensor::<2>::from_data(TensorData::new(vec![time_norm, angle.sin(), angle.cos() - 1.0], [3, 1]), &device);
        let moved = self.parameters[1].value.clone().reshape([3 * points, 3]).matmul(phi).reshape([points, 3]);
        Ok(Offsets { means: Some(features.matmul(moved)), ..Default::default() })
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![ParameterGroup { times_extent: true, ..ParameterGroup::plain("control-points", self.settings.lr, 0.1 * self.settings.lr) }]
    }
}

/// Rows of at most `count` of the centres `means` [3 N]: row 0, and then always the one that is farthest from those before it, of equals the first.
fn farthest(means: &[f32], count: usize) -> Vec<usize> {
    let centres = means.as_chunks::<3>().0;
    let (mut rows, mut next, mut squares) = (Vec::new(), 0, vec![f32::INFINITY; centres.len()]);
    while rows.len() < count.min(centres.len()) {
        rows.push(next);
        let [x, y, z] = centres[next];
        for (square, centre) in squares.iter_mut().zip(centres) {
            *square = square.min((centre[0] - x).powi(2) + (centre[1] - y).powi(2) + (centre[2] - z).powi(2));
        }
        next = (0..centres.len()).fold(0, |most, row| if squares[row] > squares[most] { row } else { most });
    }
    rows
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let settings: Settings = config::parse_section("deformer control-points", section)?;
    let Settings { points, nearest, cycles, lr } = settings;
    if !(2..=4096).contains(&points) || !(1..points).contains(&nearest) {
        let problem = format!("{points} points, of which {nearest} count");
        return Err(Error::parameter("deformer control-points", problem, "Give 2 to 4096 points, and nearest from 1 to less than that"));
    }
    if !cycles.is_finite() || !lr.is_finite() {
        return Err(Error::parameter("deformer control-points", format!("cycles {cycles}, lr {lr}"), "Give numbers such as the defaults"));
    }
    // Anywhere in the box: a training puts them onto its first Gaussians, a stored model brings its own.
    let mut random = context.seed.child("control points").rng();
    let positions = (0..3 * points).map(|i| (context.box_min[i % 3], context.box_max[i % 3]));
    let positions: Vec<f32> = positions.map(|(low, high)| low + (high - low) * random.random::<f32>()).collect();
    let value = Tensor::<1>::from_data(TensorData::new(positions, [3 * points]), device);
    let positions = Parameter { name: "positions".into(), part: Part::Net, shape: vec![points, 3], value, group: 0 };
    let motion = Parameter { name: "motion".into(), part: Part::Net, shape: vec![points, 3, 3], value: Tensor::zeros([9 * points], device), group: 0 };
    Ok(Box::new(ControlPoints { settings, parameters: vec![positions, motion] }))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "control-points",
            version: "1",
            summary: "points that start on the first Gaussians, and whose motion the others follow",
            paper: "after SC-GS (Huang et al. 2024)",
            schema: "points = 32              # control points\nnearest = 3              # of which a Gaussian follows\ncycles = 1.0             # per sequence\nlr = 1e-3                # Adam, times the extent of the cameras in the normalised frame\n",
            capabilities: &["differentiable", "starts-as-identity"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Seed, parse_device, start_deformer};

    #[test]
    fn points_start_on_the_first_gaussians_and_learn_their_motion() {
        let device = parse_device("flex").unwrap();
        let context = DeformerContext { box_min: [-9.0; 3], box_max: [9.0; 3], frame_count: 5, sh_degree: 0, seed: Seed::root(1) };
        let mut field = build(&"points = 8\nnearest = 2".parse::<toml::Table>().unwrap(), &context, &device).unwrap();
        // Two groups, of which the second rises by 1.
        let means: Vec<f32> = (0..20).flat_map(|i| [if i < 10 { -5.0 } else { 5.0 }, 0.1 * (i % 10) as f32, 0.0]).collect();
        let first = HostGaussians { means: means.clone(), opacity_logits: vec![0.0; 20], ..Default::default() };
        start_deformer("control-points", field.as_mut(), &first).unwrap();
        let positions = to_vec(field.parameters()[0].value.clone(), "positions").unwrap();
        assert!(positions.chunks_exact(3).all(|position| means.chunks_exact(3).any(|mean| mean == position)), "{positions:?}");

        let on_device = |values: Vec<f32>| Tensor::<2>::from_inner(Tensor::from_data(TensorData::new(values, [20, 3]), &device));
        let input = SpatialInput::new(on_device(means));
        let target = on_device((0..20).flat_map(|i| [0.0, 0.0, if i < 10 { 0.0 } else { 1.0 }]).collect());
        let mut last = Vec::new();
        for _ in 0..200 {
            for parameter in field.parameters_mut() {
                parameter.value = Tensor::from_inner(parameter.value.clone()).require_grad();
            }
            let moved = field.deform(field.spatial(&input).unwrap().values, 1.0).unwrap().means.unwrap();
            last = to_vec(moved.clone().inner(), "offsets").unwrap();
            let gradients = (moved - target.clone()).powi_scalar(2).sum().backward();
            for (parameter, rate) in field.parameters_mut().into_iter().zip([1e-4, 0.1]) {
                let step = parameter.value.grad(&gradients).unwrap().mul_scalar(rate);
                parameter.value = parameter.value.clone().inner() - step;
            }
        }
        let rise = |row: usize| last[3 * row + 2];
        assert!((0..10).all(|row| rise(row).abs() < 1e-3) && (10..20).all(|row| (rise(row) - 1.0).abs() < 0.1), "{last:?}");
    }
}
