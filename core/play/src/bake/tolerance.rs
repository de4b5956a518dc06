//! How far each Gaussian may be off.

use cc4dgs_core::Camera;
use cc4dgs_core::playback::{Head, MaxError};

/// Shares of the bound: errors of centre, scale and rotation add up.
const SHARES: [f32; 3] = [0.5, 0.25, 0.25];
/// Standard deviations to the edge of what is drawn.
const EDGE: f32 = 3.0;
/// Bounds on tolerances that follow from the size of a Gaussian: tiny ones may not lose their shape altogether, huge ones need not be exact beyond float32.
const LOG_SCALE: [f32; 2] = [1e-5, 0.05];
const ROTATION: [f32; 2] = [1e-5, 0.02];
/// Errors of opacity, 0..1, and of spherical-harmonics coefficients that cannot be seen.
const OPACITY: f32 = 1.5 / 255.0;
const COLOR: f32 = 1.5 / 255.0;
/// Share of the image beyond its borders in which a Gaussian still counts as seen.
const MARGIN: f64 = 0.15;
/// Smallest depth that counts, units of the model.
const NEAR: f64 = 0.01;

/// Tolerances by Gaussian and head.
pub(super) struct Tolerances {
    bound: MaxError,
    cameras: Vec<Camera>,
}

impl Tolerances {
    pub(super) fn new(bound: MaxError, cameras: &[Camera]) -> Self {
        Self { bound, cameras: cameras.to_vec() }
    }
    /// The length at `positions` of a Gaussian that may be off.
    fn length(&self, positions: &[[f32; 3]]) -> f32 {
        match self.bound {
            MaxError::Length(length) => length,
            MaxError::Pixels(pixels) => {
                let seen = positions.iter().flat_map(|p| self.cameras.iter().filter_map(|c| pixel_length(c, *p, true))).fold(f64::INFINITY, f64::min);
                let far = || positions.iter().flat_map(|p| self.cameras.iter().filter_map(|c| pixel_length(c, *p, false))).fold(f64::INFINITY, f64::min);
                let length = if seen.is_finite() { seen } else { far() };
                pixels * if length.is_finite() { length as f32 } else { 1e-3 }
            }
        }
    }
    /// The tolerances of the heads in the order of [`Head::ALL`], for a Gaussian that is at `positions` over time, whose largest scale over time is `scale`,
    /// and whose quaternions, as they are stored, are at least `shortest` long, which is at most 1.
    pub(super) fn of(&self, positions: &[[f32; 3]], scale: f32, shortest: f32) -> [f32; 5] {
        let length = self.length(positions);
        let reach = (EDGE * scale).max(f32::MIN_POSITIVE);
        Head::ALL.map(|head| match head {
            Head::Means => SHARES[0] * length,
            Head::LogScales => (SHARES[1] * length / reach).clamp(LOG_SCALE[0], LOG_SCALE[1]),
            // An angle is twice the error of a unit quaternion.
            Head::Rotations => (shortest * SHARES[2] * length / (2.0 * reach)).clamp(ROTATION[0], ROTATION[1]),
            Head::Opacities => OPACITY,
            Head::Colors => COLOR,
        })
    }
}

/// Length of a pixel at `point`, units of the model; `None` where the camera does not see it (`inside`) or where the point is not before it.
fn pixel_length(camera: &Camera, point: [f32; 3], inside: bool) -> Option<f64> {
    let m = &camera.world_to_camera;
    let seen: [f64; 3] = std::array::from_fn(|r| (0..3).map(|c| m[r][c] * f64::from(point[c])).sum::<f64>() + m[r][3]);
    let focal = camera.fx.max(camera.fy);
    if !inside {
        return Some(seen.iter().map(|v| v * v).sum::<f64>().sqrt().max(NEAR) / focal);
    }
    let within = |at: f64, size: u32| at > -MARGIN * f64::from(size) && at < (1.0 + MARGIN) * f64::from(size);
    let z = seen[2];
    let visible = z > NEAR && within(camera.fx * seen[0] / z + camera.cx, camera.width) && within(camera.fy * seen[1] / z + camera.cy, camera.height);
    visible.then_some(z / focal)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_camera_that_sees_a_gaussian_counts() {
        let camera = |eye: [f64; 3]| Camera::look_at("t", (100, 100), 1.0, eye, [0.0; 3], [0.0, 0.0, 1.0]);
        let both = [camera([4.0, 0.0, 0.0]), camera([0.0, 2.0, 0.0])];
        let focal = both[0].fx;
        let tolerances = Tolerances::new(MaxError::Pixels(0.1), &both);
        let at = |point: [f32; 3]| f64::from(tolerances.of(&[point], 0.1, 1.0)[0]) / 0.5 / 0.1 * focal;
        assert!((at([0.0; 3]) - 2.0).abs() < 1e-4);
        // Behind the second camera: only the first sees it, from afar.
        assert!(at([0.0, 2.1, 0.0]) > 3.0);
        // Larger Gaussians need finer rotations.
        assert!(tolerances.of(&[[0.0; 3]], 1.0, 1.0)[2] < tolerances.of(&[[0.0; 3]], 0.1, 1.0)[2]);
        // So do shorter quaternions.
        assert!((tolerances.of(&[[0.0; 3]], 0.1, 0.5)[2] / tolerances.of(&[[0.0; 3]], 0.1, 1.0)[2] - 0.5).abs() < 1e-6);
    }
}
