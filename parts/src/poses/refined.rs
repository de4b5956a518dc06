//! A small rotation and translation per training camera, learned with everything else.
//!
//! Camera c turns by the rotation vector w_c - mean w about its own centre, and its centre moves by t_c - mean t, both in world axes. The means over the training cameras are
//! zero by construction, so that cameras and model cannot turn or move together, away from the held-out cameras. They could still grow together, which the
//! regularizer holds back.
//!
//! Rotations are Cayley transforms: with A = \[w\]x, R = I + s (A + A A / 2) where s = 4 / (4 + |w|^2). It is a rotation for every w, by 2 atan(|w| / 2), and its
//! derivative needs no special case at 0.

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

/// World to camera with the camera turned by the rotation vector `turn` about its centre, which moves by `shift`, both in world axes; and its derivatives by the six
/// numbers.
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

struct Refined {
    settings: Settings,
    context: PosesContext,
    /// Rotation vectors in radians, and translations in units of the scene, `[cameras, 3]` each, flat.
    parameters: Vec<Parameter>,
}

impl Refined {
    /// Differences from the mean `[cameras, 3]`: of rotation vectors, or of translations.
    fn differences(&self, which: usize) -> Tensor<2> {
        let all = self.parameters[which].value.clone().reshape([self.context.cameras, 3]);
        all.clone() - all.mean_dim(0)
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
        let own = Tensor::cat([0, 1].map(|which| self.differences(which).narrow(0, index, 1)).to_vec(), 1);
        let host = to_vec(own.clone(), "pose")?;
        let vector = |first: usize| DVec3::from_array([0, 1, 2].map(|k| host.get(first + k).copied().map_or(f64::NAN, f64::from)));
        let (pose, derivatives) = moved(camera, vector(0), vector(3));
        let mut world_to_camera = camera.world_to_camera;
        for (k, value) in pose.into_iter().enumerate() {
            world_to_camera[k / 4][k % 4] = value;
        }
        // The product with the derivatives has the gradient that the pose has.
        let jacobian: Vec<f32> = derivatives.iter().flat_map(|row| row.iter().copied().chain([0.0; 4])).map(|v| v as f32).collect();
        let jacobian = Tensor::<2>::from_data(TensorData::new(jacobian, [6, 16]), &own.device());
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
        let lengths = |which: usize| -> Result<(f64, f64)> {
            let values = to_vec(self.differences(which), &self.parameters[which].name)?;
            let mut lengths: Vec<f64> = values.chunks_exact(3).map(|v| v.iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt()).collect();
            lengths.sort_unstable_by(f64::total_cmp);
            Ok((lengths.get(lengths.len() / 2).copied().unwrap_or(0.0), lengths.last().copied().unwrap_or(0.0)))
        };
        if self.context.cameras < 2 {
            return Ok(Some("a single training camera keeps its pose".into()));
        }
        let ((turn, most_turn), (shift, most_shift)) = (lengths(0)?, lengths(1)?);
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
