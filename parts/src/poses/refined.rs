//! A small rotation and translation per training camera, learned with everything else.
//!
//! Camera c turns by the rotation vector w_c - mean w about its own centre, and its centre moves by t_c - mean t, both in world axes. The average motion of the
//! training cameras is zero by construction, so that cameras and model cannot turn or move together, away from the held-out cameras. They could still grow
//! together, which the regularizer holds back.
//!
//! The means are over the cameras that were trained on so far: those with a number that is not zero. The coarse stage may draw from the first frame alone, and
//! `train.time_ramp` lets frames in one after another. With means over all cameras, those that are trained on could move together with the model, against the
//! others, which Adam would move as fast: it divides the small gradient that a mean hands them by its own size. They have no gradient and stay at zero.
//!
//! Rotations are Cayley transforms: with A = \[w\]x, R = I + s (A + A A / 2) where s = 4 / (4 + |w|^2). It is a rotation for every w, by 2 atan(|w| / 2), and
//! its derivative needs no special case at 0.

use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Camera, Error, Parameter, ParameterGroup, Part, Plugin, Posed, Poses, PosesContext, PosesPlugin, Result, config, inventory, ordered_sum};
use glam::{DMat3, DVec3};
use serde::Deserialize;

const SCHEMA: &str = "\
lr = 1e-3                # learning rate: radians, and shares of the extent of the cameras; divided by the root of the number of cameras
lr_end = 1e-5            # learning rate at the end of a stage
warmup = 0.1             # share of a stage in which rates rise from zero
identity = 30.0          # weight of the squared distance from the poses of the dataset, radians and shares of the extent, linear beyond 0.005; mean over cameras, with what is common to all
";

/// From about this distance on the penalty grows linearly: what holds back noise must not hold back poses that are wrong by degrees.
const LINEAR: f64 = 0.005;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    lr: f64,
    lr_end: f64,
    warmup: f64,
    identity: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { lr: 1e-3, lr_end: 1e-5, warmup: 0.1, identity: 30.0 }
    }
}

/// \[v\]x, with which the cross product by v is a matrix product.
fn cross(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// The rotation of a rotation vector, and its derivatives by the vector's components.
fn cayley(w: DVec3) -> (DMat3, [DMat3; 3]) {
    let (a, scale) = (cross(w), 4.0 / (4.0 + w.length_squared()));
    let polynomial = a + a * a * 0.5;
    let derivatives = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| {
        let (e, of_scale) = (cross(axis), -0.5 * scale * scale * w.dot(axis));
        polynomial * of_scale + (e + (e * a + a * e) * 0.5) * scale
    });
    (DMat3::IDENTITY + polynomial * scale, derivatives)
}

/// The upper three rows of a pose, row-major.
type Rows = [f64; 12];

fn rows(rotation: DMat3, translation: DVec3) -> Rows {
    std::array::from_fn(|k| if k % 4 == 3 { translation[k / 4] } else { rotation.row(k / 4)[k % 4] })
}

/// World to camera with the camera turned by the rotation vector `turn` about its centre, which moves by `shift`, both in world axes; and its derivatives by
/// the six numbers.
fn moved(camera: &Camera, turn: DVec3, shift: DVec3) -> (Rows, [Rows; 6]) {
    let (r, t) = camera.rotation_translation();
    let center = shift - r.transpose() * t;
    // The inverse of a turn is that of the opposite vector.
    let (back, by_turn) = cayley(-turn);
    let pose = |rotation: DMat3| rows(rotation, -(rotation * center));
    let turned = r * back;
    let derivatives = std::array::from_fn(|k| match k {
        0..3 => pose(r * by_turn[k] * -1.0),
        _ => rows(DMat3::ZERO, -turned.col(k - 3)),
    });
    (pose(turned), derivatives)
}

/// Rotation vector in radians and translation in units of the scene.
type Numbers = [f64; 6];

/// Whether a camera with these numbers was trained on.
fn is_trained(numbers: &Numbers) -> bool {
    numbers.iter().any(|v| *v != 0.0)
}

/// The factors of all cameras' numbers in the correction of camera `index`: 1 for its own, minus 1/n for each of the n cameras that were trained on, it
/// included.
fn factors(all: &[Numbers], index: usize) -> Vec<f64> {
    let counts: Vec<bool> = all.iter().enumerate().map(|(i, numbers)| i == index || is_trained(numbers)).collect();
    let count = counts.iter().filter(|counts| **counts).count() as f64;
    // The very first camera would be its own mean and have no gradient.
    let share = if all.iter().any(is_trained) { 1.0 / count } else { 0.0 };
    counts.iter().enumerate().map(|(i, counts)| f64::from(u8::from(i == index)) - if *counts { share } else { 0.0 }).collect()
}

struct Refined {
    settings: Settings,
    context: PosesContext,
    /// Rotation vectors in radians, and translations in units of the scene, `[cameras, 3]` each, flat.
    parameters: Vec<Parameter>,
}

impl Refined {
    /// The numbers of all cameras `[cameras, 6]`, with gradients, and their values.
    fn numbers(&self) -> Result<(Tensor<2>, Vec<Numbers>)> {
        let of = |which: usize| self.parameters[which].value.clone().reshape([self.context.cameras, 3]);
        let all = Tensor::cat(vec![of(0), of(1)], 1);
        let values = to_vec(all.clone(), "poses")?;
        Ok((all, values.chunks_exact(6).map(|row| std::array::from_fn(|k| f64::from(row[k]))).collect()))
    }
}

impl Poses for Refined {
    fn corrected(&self, camera: &Camera, index: usize) -> Result<Option<Posed>> {
        let cameras = self.context.cameras;
        if index >= cameras {
            return Err(Error::parameter("poses refined", format!("camera {index} of {cameras}"), "Report this as a defect"));
        }
        // A single camera is the mean.
        if cameras < 2 {
            return Ok(None);
        }
        let (all, values) = self.numbers()?;
        let factors = factors(&values, index);
        let own: Numbers = std::array::from_fn(|k| values.iter().zip(&factors).map(|(numbers, factor)| numbers[k] * factor).sum());
        let (pose, derivatives) = moved(camera, DVec3::new(own[0], own[1], own[2]), DVec3::new(own[3], own[4], own[5]));
        let mut world_to_camera = camera.world_to_camera;
        for (k, value) in pose.into_iter().enumerate() {
            world_to_camera[k / 4][k % 4] = value;
        }
        // The product with the derivatives has the gradient that the pose has.
        let jacobian: Vec<f32> = derivatives.iter().flat_map(|row| row.iter().copied().chain([0.0; 4])).map(|v| v as f32).collect();
        let device = all.device();
        let jacobian = Tensor::<2>::from_data(TensorData::new(jacobian, [6, 16]), &device);
        let factors: Vec<f32> = factors.into_iter().map(|v| v as f32).collect();
        let own = (all * Tensor::<2>::from_data(TensorData::new(factors, [cameras, 1]), &device)).sum_dim(0);
        let probe = (own.reshape([6, 1]) * jacobian).sum_dim(0).reshape([4, 4]);
        Ok(Some(Posed { camera: Camera { world_to_camera, ..camera.clone() }, probe }))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        // A camera has a gradient in one of n iterations; Adam then moves it by about the root of n times the rate.
        let share = 1.0 / (self.context.cameras as f64).sqrt();
        let Settings { lr, lr_end, warmup, .. } = self.settings;
        let group = |name: &str| ParameterGroup { epsilon: 1e-8, warmup, ..ParameterGroup::plain(name, lr * share, lr_end * share) };
        vec![group("rotations of cameras"), ParameterGroup { times_extent: true, ..group("centres of cameras") }]
    }
    fn regularizer(&self) -> Result<Option<Tensor<1>>> {
        if self.settings.identity == 0.0 {
            return Ok(None);
        }
        let squares = |which: usize, unit: f64| {
            let own = self.parameters[which].value.clone().reshape([self.context.cameras, 3]).div_scalar(LINEAR * unit);
            (own.clone() * own).sum_dim(1)
        };
        // 2 (sqrt(1 + s) - 1) is s where s is small.
        let penalties = (squares(0, 1.0) + squares(1, self.context.extent) + 1.0).sqrt() - 1.0;
        Ok(Some(ordered_sum(penalties).mul_scalar(2.0 * LINEAR * LINEAR * self.settings.identity / self.context.cameras as f64)))
    }
    fn summary(&self) -> Result<Option<String>> {
        if self.context.cameras < 2 {
            return Ok(Some("a single training camera keeps its pose".into()));
        }
        let (_, values) = self.numbers()?;
        let trained = values.iter().filter(|numbers| is_trained(numbers)).count().max(1) as f64;
        let mean: Numbers = std::array::from_fn(|k| values.iter().map(|numbers| numbers[k]).sum::<f64>() / trained);
        // Median and largest length of three numbers from `first` on.
        let lengths = |first: usize| {
            let length = |numbers: &Numbers| (first..first + 3).map(|k| (numbers[k] - mean[k]).powi(2)).sum::<f64>().sqrt();
            let mut lengths: Vec<f64> = values.iter().map(|numbers| if is_trained(numbers) { length(numbers) } else { 0.0 }).collect();
            lengths.sort_unstable_by(f64::total_cmp);
            (lengths.get(lengths.len() / 2).copied().unwrap_or(0.0), lengths.last().copied().unwrap_or(0.0))
        };
        let ((turn, most_turn), (shift, most_shift)) = (lengths(0), lengths(3));
        let [shift, most_shift] = [shift, most_shift].map(|v| 100.0 * v / self.context.extent);
        let (turn, most_turn) = (turn.to_degrees(), most_turn.to_degrees());
        Ok(Some(format!(
            "{} training cameras: the median turn is {turn:.3} degrees, the median move {shift:.3} % of their extent; at most {most_turn:.3} degrees and {most_shift:.3} %",
            self.context.cameras
        )))
    }
}

fn build(section: &toml::Table, context: &PosesContext, device: &Device) -> Result<Box<dyn Poses>> {
    let settings: Settings = config::parse_section("poses refined", section)?;
    for (name, value, most) in
        [("lr", settings.lr, 1.0), ("lr_end", settings.lr_end, 1.0), ("warmup", settings.warmup, 1.0), ("identity", settings.identity, 1e6)]
    {
        if !(0.0..=most).contains(&value) {
            return Err(Error::parameter(format!("poses refined: {name}"), format!("{value} cannot be used"), format!("Give a number from 0 to {most}")));
        }
    }
    let context = PosesContext { cameras: context.cameras.max(1), ..*context };
    let parameter = |name: &str, group: usize| {
        let value = Tensor::<1>::zeros([3 * context.cameras], device);
        Parameter { name: name.into(), part: Part::Net, shape: vec![context.cameras, 3], value, group }
    };
    let parameters = vec![parameter("rotations", 0), parameter("centres", 1)];
    Ok(Box::new(Refined { settings, context, parameters }))
}

inventory::submit! {
    PosesPlugin {
        info: Plugin {
            name: "refined",
            version: "1",
            summary: "a small rotation and translation per training camera, zero on average",
            paper: "poses learned with the scene as in BARF (Lin et al. 2021)",
            schema: SCHEMA,
            capabilities: &["differentiable"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;

    /// Gradients of rotations and centres of four cameras, three numbers each, where camera `index` is trained on and every camera has one of `numbers` six
    /// times.
    fn gradients(numbers: [f32; 4], index: usize) -> [Vec<f32>; 2] {
        let device = Device::flex().autodiff();
        let context = PosesContext { cameras: 4, extent: 2.0, seed: Seed::root(1) };
        let mut poses = build(&toml::Table::new(), &context, &device).unwrap();
        for parameter in poses.parameters_mut() {
            let values: Vec<f32> = numbers.iter().flat_map(|v| [*v; 3]).collect();
            parameter.value = Tensor::<1>::from_data(TensorData::new(values, [12]), &device).require_grad();
        }
        let world_to_camera = [[1.0, 0.0, 0.0, 0.3], [0.0, 1.0, 0.0, -0.2], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];
        let camera = Camera { name: "c".into(), width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0, world_to_camera };
        let probe = poses.corrected(&camera, index).unwrap().unwrap().probe;
        let upstream: Vec<f32> = (0..16).map(|k| (k as f32).sin()).collect();
        let of_images = (probe * Tensor::<2>::from_data(TensorData::new(upstream, [4, 4]), &device)).sum();
        let gradients = (of_images + poses.regularizer().unwrap().unwrap()).backward();
        [0, 1].map(|which| to_vec(poses.parameters()[which].value.grad(&gradients).unwrap(), "gradient").unwrap())
    }

    #[test]
    fn cameras_that_were_not_trained_on_have_no_gradient() {
        let is_moved = |of: &[Vec<f32>; 2], camera: usize| of.iter().any(|array| array[3 * camera..3 * camera + 3].iter().any(|v| *v != 0.0));
        // A camera, the numbers before, and whose numbers change.
        for (index, numbers, expected) in [
            (1, [0.0; 4], [false, true, false, false]),
            (1, [0.002, 0.0, 0.0, 0.0], [true, true, false, false]),
            (0, [0.002, -0.001, 0.0, 0.0], [true, true, false, false]),
            (2, [0.002, -0.001, 0.001, 0.003], [true; 4]),
        ] {
            let found = gradients(numbers, index);
            assert_eq!([0, 1, 2, 3].map(|camera| is_moved(&found, camera)), expected, "camera {index} of {numbers:?}: {found:?}");
        }
    }

    #[test]
    fn cameras_that_were_trained_on_do_not_move_together() {
        for (numbers, cameras) in
            [(vec![[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.0; 6], [0.3, 0.0, 0.1, 0.0, 0.0, 0.2]], vec![0, 2]), (vec![[0.1; 6]; 3], vec![0, 1, 2])]
        {
            let of = |index: usize, k: usize| numbers.iter().zip(factors(&numbers, index)).map(|(n, factor)| n[k] * factor).sum::<f64>();
            for k in 0..6 {
                assert!(cameras.iter().map(|index| of(*index, k)).sum::<f64>().abs() < 1e-15, "{numbers:?}");
            }
        }
        assert_eq!(factors(&[[0.0; 6], [0.1; 6], [0.2; 6]], 1), [0.0, 0.5, -0.5]);
    }

    #[test]
    fn derivatives_of_poses_are_slopes_at_small_and_large_turns() {
        let world_to_camera = [[0.8, -0.6, 0.0, 0.3], [0.6, 0.8, 0.0, -0.2], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]];
        let camera = Camera { name: "c".into(), width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0, world_to_camera };
        for scale in [0.0, 1e-9, 1e-3, 0.7, 30.0] {
            let at = [0.3, -0.5, 0.7, 0.2, 0.1, -0.4].map(|v: f64| v * scale);
            let of = |v: [f64; 6]| moved(&camera, DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
            let (pose, derivatives) = of(at);
            let rotation = DMat3::from_cols_array(&std::array::from_fn(|k| pose[4 * (k / 3) + k % 3])).transpose();
            assert!((rotation * rotation.transpose() - DMat3::IDENTITY).to_cols_array().iter().all(|v| v.abs() < 1e-12), "{rotation}");
            assert!((rotation.determinant() - 1.0).abs() < 1e-12);
            for (k, derivative) in derivatives.iter().enumerate() {
                let step = 1e-6;
                let shifted = |sign: f64| of(std::array::from_fn(|i| at[i] + if i == k { sign * step } else { 0.0 })).0;
                for ((up, down), slope) in shifted(1.0).iter().zip(shifted(-1.0)).zip(derivative) {
                    assert!(((up - down) / (2.0 * step) - slope).abs() < 1e-6, "component {k} at {scale}: {up} {down} {slope}");
                }
            }
        }
        let turned = |turn: DVec3| moved(&camera, turn, DVec3::ZERO).0;
        let center = |pose: Rows| {
            let moved = Camera {
                world_to_camera: [pose[0..4].try_into().unwrap(), pose[4..8].try_into().unwrap(), pose[8..12].try_into().unwrap(), [0.0, 0.0, 0.0, 1.0]],
                ..camera.clone()
            };
            DVec3::from_array(moved.center_world())
        };
        // In world axes: a quarter turn about world z.
        let quarter = turned(DVec3::new(0.0, 0.0, 2.0));
        let ahead = |pose: Rows| DVec3::new(pose[8], pose[9], pose[10]);
        let right = |pose: Rows| DVec3::new(pose[0], pose[1], pose[2]);
        let before = rows(camera.rotation_translation().0, DVec3::ZERO);
        let expected = |v: DVec3| DVec3::new(-v.y, v.x, v.z);
        assert!((ahead(quarter) - expected(ahead(before))).length() < 1e-12 && (right(quarter) - expected(right(before))).length() < 1e-12, "{quarter:?}");
        assert!((center(turned(DVec3::new(0.2, 0.1, -0.3))) - DVec3::from_array(camera.center_world())).length() < 1e-12, "a turn moves the centre");
    }
}
