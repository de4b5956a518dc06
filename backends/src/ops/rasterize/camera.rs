//! The camera in the form kernels read, and the gradient of its matrix from sums over Gaussians.

use super::RasterSettings;
use cc4dgs_core::Rules;
use glam::{DMat4, DVec3, DVec4};

/// Smallest opacity factor of the antialiasing compensation.
pub const MIN_COMPENSATION: f32 = 0.005;
/// Squared norms of quaternions beyond this, or below one over it, are rescaled before they are used.
pub const QUATERNION_RANGE: f32 = 1e20;
/// 2^80: short quaternions are multiplied by it, long ones divided.
pub const RESCALE: f32 = 1_208_925_819_614_629_174_706_176.0;
/// Quaternions whose rescaled squared norm is not above this are not drawn. Their length is at most 8.3e-39, so all components are subnormal: some
/// devices take those for zeros, others keep few of their digits. Whatever has a normal component (1.2e-38 and more) is drawn.
pub const SHORTEST_QUATERNION: f32 = 1e-28;
/// A pixel ignores a Gaussian below this alpha: the float32 value of 1/255.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// A pixel stops before its transmittance would fall to this value or below.
pub const TRANSMITTANCE_STOP: f32 = 1e-4;
/// Beyond this depth nothing is drawn.
pub const FAR: f32 = 1e10;

/// The constants in which the rule sets differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RuleConstants {
    /// Smallest camera depth drawn.
    pub near: f32,
    /// Cap of alpha.
    pub alpha_max: f32,
    /// Whether the gradient ignores that alpha was capped.
    pub pass_capped: bool,
    /// Whether a square of 3 sigma in whole tiles limits the footprint (Inria).
    pub square_tiles: bool,
}

impl RuleConstants {
    /// The constants of the rules in `settings`, whose near plane may be its own.
    pub fn new(settings: &RasterSettings) -> Self {
        let near = settings.near.unwrap_or(settings.rules.near());
        match settings.rules {
            Rules::Gsplat099 => Self { near, alpha_max: 0.99, pass_capped: false, square_tiles: false },
            Rules::Gsplat0999 => Self { near, alpha_max: 0.999, pass_capped: false, square_tiles: false },
            Rules::Inria => Self { near, alpha_max: 0.99, pass_capped: true, square_tiles: true },
        }
    }
}

/// Camera numbers in float32.
#[derive(Clone, Copy, Debug)]
pub struct CameraConstants {
    /// Rotation of world to camera, by rows.
    pub rotation: [[f32; 3]; 3],
    /// Translation of world to camera.
    pub translation: [f32; 3],
    /// Camera centre in world units.
    pub center: [f32; 3],
    /// Focal lengths in pixels.
    pub focal: [f32; 2],
    /// Principal point in pixels.
    pub principal: [f32; 2],
    /// Where x/z and y/z are clamped in the Jacobian: (lower, upper) per axis.
    pub ratio_limits: [[f32; 2]; 2],
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels.
    pub blur: f32,
    /// The row of world to camera that gives the depth, unrounded.
    pub depth_row: [f64; 4],
}

impl CameraConstants {
    /// The constants of the camera in `settings`.
    pub fn new(settings: &RasterSettings) -> Self {
        let m = &settings.world_to_camera;
        let center = camera_center(m);
        let size = [settings.width as f64, settings.height as f64];
        let focal = [settings.fx, settings.fy];
        let principal = [settings.cx, settings.cy];
        // 0.15 of the image beyond each border: 1.3 times the tangent of the half angle for a centred camera.
        let limits = |k: usize| {
            let margin = 0.15 * size[k] / focal[k];
            [(-(principal[k] / focal[k] + margin)) as f32, ((size[k] - principal[k]) / focal[k] + margin) as f32]
        };
        Self {
            rotation: std::array::from_fn(|i| std::array::from_fn(|j| m[i][j] as f32)),
            translation: std::array::from_fn(|i| m[i][3] as f32),
            center: center.as_vec3().to_array(),
            focal: focal.map(|v| v as f32),
            principal: principal.map(|v| v as f32),
            ratio_limits: [limits(0), limits(1)],
            blur: settings.blur as f32,
            depth_row: m[2],
        }
    }
    /// The depth by which Gaussians are sorted: computed in float64 and rounded once. With intermediate rounding, two Gaussians within 1e-7 of each other
    /// could be blended in different orders on different devices, which is visible.
    pub fn depth(&self, mean: &[f32]) -> f32 {
        let [x, y, z, t] = self.depth_row;
        (x * f64::from(mean[0]) + y * f64::from(mean[1]) + z * f64::from(mean[2]) + t) as f32
    }
}

/// A row-major 4x4 as a matrix.
fn matrix(m: &[[f64; 4]; 4]) -> DMat4 {
    DMat4::from_cols_array_2d(m).transpose()
}

/// The inverse of a row-major 4x4, row-major and rounded.
pub fn camera_to_world(world_to_camera: &[[f64; 4]; 4]) -> [f32; 16] {
    matrix(world_to_camera).inverse().transpose().to_cols_array().map(|v| v as f32)
}

/// The camera centre: the last column of the inverse.
fn camera_center(m: &[[f64; 4]; 4]) -> DVec3 {
    matrix(m).inverse().col(3).truncate()
}

/// Sums over Gaussians of the gradients of the camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraSums {
    /// d loss / d rotation, by rows.
    pub rotation: [f64; 9],
    /// d loss / d translation.
    pub translation: [f64; 3],
    /// d loss / d camera centre, which reaches the matrix through its inverse.
    pub center: [f64; 3],
}

impl CameraSums {
    /// Adds another part; callers keep a fixed order.
    pub fn add(&mut self, other: &Self) {
        for (a, b) in self.rotation.iter_mut().zip(other.rotation) {
            *a += b;
        }
        for k in 0..3 {
            self.translation[k] += other.translation[k];
            self.center[k] += other.center[k];
        }
    }
    /// d loss / d world_to_camera with its 16 entries as free numbers, row-major.
    pub fn matrix_gradient(&self, world_to_camera: &[[f64; 4]; 4]) -> [f32; 16] {
        let inverse = matrix(world_to_camera).inverse();
        // d inverse = -inverse dM inverse, and only the last column of the inverse is read.
        let left = inverse.transpose() * DVec4::new(self.center[0], self.center[1], self.center[2], 0.0);
        let right = inverse.col(3);
        let mut out = [0.0; 16];
        for i in 0..4 {
            for j in 0..4 {
                let direct = match (i, j) {
                    (3, _) => 0.0,
                    (_, 3) => self.translation[i],
                    _ => self.rotation[3 * i + j],
                };
                out[4 * i + j] = (direct - left[i] * right[j]) as f32;
            }
        }
        out
    }
}
