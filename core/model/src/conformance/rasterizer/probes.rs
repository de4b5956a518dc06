//! Gradients of probes: of projected centres and of the camera pose.

use super::{COUNT, SIZE, Suite, agrees, camera, cloud};
use crate::conformance::uniform;
use crate::gaussians::to_vec;
use crate::{Camera, Gaussians, HostGaussians, RenderSettings, Result, Seed, Splats};
use burn::tensor::{Tensor, TensorData};
use glam::{DMat4, DQuat, DVec3};

/// Steps of finite differences in pixels. Short ones may be below the rounding error, long ones may cross a threshold.
const PIXEL_STEPS: [f64; 3] = [1e-3, 3e-3, 1e-2];
/// The same for a pose: world units and radians. A pose moves all Gaussians at once, so thresholds are near and steps are short.
const POSE_STEPS: [f64; 3] = [2e-5, 5e-5, 1.5e-4];
/// Gaussians in the test of the camera pose.
const POSE_COUNT: usize = 4;
/// Largest difference between a gradient and a finite difference, as a share of the absolute gradient.
const TOLERANCE: f64 = 0.05;

/// The gradients that the probes received.
struct Probed {
    /// `[N,2]`
    screen: Vec<f32>,
    /// `[N,2]`
    absolute: Vec<f32>,
    /// `[4,4]`
    camera: Vec<f32>,
}

/// The Gaussian at `index` alone.
fn one_of(host: &HostGaussians, index: usize) -> HostGaussians {
    let mut one = host.clone();
    for (_, width, values) in one.columns_mut() {
        *values = values[index * width..(index + 1) * width].to_vec();
    }
    one
}

/// `camera` after `step` times a rotation and translation of camera space: `pose` is axis times angle in radians, then world units.
fn moved(camera: &Camera, pose: [f64; 6], step: f64) -> Camera {
    let [rotation, translation] = [0, 3].map(|k| DVec3::new(pose[k], pose[k + 1], pose[k + 2]) * step);
    let matrix = DMat4::from_cols_array_2d(&camera.world_to_camera).transpose();
    let matrix = DMat4::from_rotation_translation(DQuat::from_scaled_axis(rotation), translation) * matrix;
    Camera { world_to_camera: matrix.transpose().to_cols_array_2d(), ..camera.clone() }
}

/// Converts the gradient of the 16 entries of world_to_camera to that of a rotation and translation of camera space.
fn pose_gradient(camera: &Camera, entries: &[f32]) -> [f64; 6] {
    std::array::from_fn(|k| {
        let axis = [DVec3::X, DVec3::Y, DVec3::Z][k % 3];
        (0..4)
            .map(|column| {
                let [x, y, z, w] = [0, 1, 2, 3].map(|row| camera.world_to_camera[row][column]);
                let change = if k < 3 { axis.cross(DVec3::new(x, y, z)) } else { axis * w };
                change.to_array().iter().enumerate().map(|(row, v)| v * f64::from(entries[4 * row + column])).sum::<f64>()
            })
            .sum()
    })
}

impl Suite<'_> {
    fn upstream(&self) -> Vec<f32> {
        (0..5 * (SIZE.0 * SIZE.1) as usize).map(|k| uniform(Seed::root(6), k)).collect()
    }
    fn loss_of_pixels(&self, host: &HostGaussians, camera: &Camera) -> Result<Vec<f64>> {
        let planes = to_vec(self.draw(host, camera, &RenderSettings::default())?.planes, "planes")?;
        let weighted: Vec<f64> = planes.iter().zip(self.upstream()).map(|(a, b)| f64::from(*a) * f64::from(b)).collect();
        let pixels = weighted.len() / 5;
        Ok((0..pixels).map(|pixel| weighted.iter().skip(pixel).step_by(pixels).sum()).collect())
    }
    /// The inner `Err` names a probe that received no gradient, or one of another shape.
    fn probed(&self, host: &HostGaussians, camera: &Camera) -> Result<std::result::Result<Probed, String>> {
        let tracked = self.device.clone().autodiff();
        let g = Gaussians::from_host(host, &tracked);
        let zeros = |shape: [usize; 2]| Tensor::<2>::zeros(shape, &tracked).require_grad();
        let n = host.opacity_logits.len();
        let (screen, absolute, pose) = (zeros([n, 2]), zeros([n, 2]), zeros([4, 4]));
        let splats = Splats {
            screen_probe: Some(screen.clone()),
            absolute_screen_probe: Some(absolute.clone()),
            camera_probe: Some(pose.clone()),
            ..Splats::from_gaussians(&g, g.sh_degree)
        };
        let output = self.rasterizer.render(&splats, camera, &RenderSettings::default())?;
        let weights = Tensor::<3>::from_data(TensorData::new(self.upstream(), [5, SIZE.1 as usize, SIZE.0 as usize]), &tracked);
        let gradients = (output.planes * weights).sum().backward();
        let mut values = Vec::new();
        for (name, probe) in [("screen_probe", screen), ("absolute_screen_probe", absolute), ("camera_probe", pose)] {
            let shape = probe.dims();
            match probe.grad(&gradients) {
                Some(gradient) if gradient.dims() == shape => values.push(to_vec(gradient, name)?),
                Some(gradient) => return Ok(Err(format!("{name} of shape {shape:?} receives a gradient of shape {:?}", gradient.dims()))),
                None => return Ok(Err(format!("no gradient reaches {name}"))),
            }
        }
        let [screen, absolute, camera] = [0, 1, 2].map(|k: usize| std::mem::take(&mut values[k]));
        Ok(Ok(Probed { screen, absolute, camera }))
    }
    /// Moving the principal point moves only the projected centres. So for one Gaussian, the finite difference by the principal point is the gradient of the
    /// centre.
    pub(super) fn screen_probes_are_slopes(&self) -> Result<Option<String>> {
        let (host, camera) = (cloud(COUNT), camera());
        for index in 0..4 {
            let one = one_of(&host, index);
            let probed = match self.probed(&one, &camera)? {
                Ok(probed) => probed,
                Err(finding) => return Ok(Some(finding)),
            };
            for axis in 0..2 {
                let (signed, absolute) = (f64::from(probed.screen[axis]), f64::from(probed.absolute[axis]));
                let mut found = Vec::new();
                for step in PIXEL_STEPS {
                    let at = |step: f64| {
                        let mut moved = camera.clone();
                        *(if axis == 0 { &mut moved.cx } else { &mut moved.cy }) += step;
                        self.loss_of_pixels(&one, &moved)
                    };
                    let slopes: Vec<f64> = at(step)?.iter().zip(at(-step)?).map(|(a, b)| (a - b) / (2.0 * step)).collect();
                    found.push((slopes.iter().sum::<f64>(), slopes.iter().map(|s| s.abs()).sum::<f64>()));
                }
                let close = |a: f64, b: f64| (a - b).abs() <= TOLERANCE * absolute;
                let axis = ["x", "y"][axis];
                if !found.iter().any(|(slope, _)| close(*slope, signed)) {
                    return Ok(Some(format!("screen_probe received {signed:.5} along {axis}; finite differences give {found:.5?} (second: absolute)")));
                }
                if absolute == 0.0 || !found.iter().any(|(_, slope)| close(*slope, absolute)) {
                    return Ok(Some(format!(
                        "absolute_screen_probe received {absolute:.5} along {axis}; finite differences give {found:.5?} (second: absolute)"
                    )));
                }
            }
        }
        Ok(match self.probed(&host, &camera)? {
            Err(finding) => Some(finding),
            Ok(Probed { screen, absolute, .. }) => screen
                .iter()
                .zip(&absolute)
                .position(|(s, a)| s.is_nan() || a.is_nan() || s.abs() > a * (1.0 + 1e-3) + 1e-6)
                .map(|k| format!("Gaussian {} has an absolute gradient of {} on the screen, below its signed one of {}", k / 2, absolute[k], screen[k])),
        })
    }
    /// The slope of the loss along the gradient of the camera pose equals the gradient's norm.
    pub(super) fn camera_probe_is_a_slope(&self) -> Result<Option<String>> {
        let (host, camera) = (cloud(POSE_COUNT), camera());
        let probed = match self.probed(&host, &camera)? {
            Ok(probed) => probed,
            Err(finding) => return Ok(Some(finding)),
        };
        let gradient = pose_gradient(&camera, &probed.camera);
        let norm = gradient.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !norm.is_finite() || norm == 0.0 {
            return Ok(Some(format!("the gradient of the pose has norm {norm}")));
        }
        let direction = gradient.map(|v| v / norm);
        let mut slopes = Vec::new();
        for step in POSE_STEPS {
            let [up, down] = [step, -step].map(|step| self.loss_of_pixels(&host, &moved(&camera, direction, step)));
            slopes.push((up?.iter().sum::<f64>() - down?.iter().sum::<f64>()) / (2.0 * step));
        }
        Ok((!agrees(&slopes, norm)).then(|| format!("camera_probe: the loss rises by {slopes:.5?} per unit along the gradient of the pose of norm {norm:.5}")))
    }
}
