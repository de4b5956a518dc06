//! A pinhole camera in OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

use crate::{Error, Result};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// A calibrated camera. Lens distortion is undone by the readers, so none is stored.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Display name, as in the dataset.
    pub name: String,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x, in pixels.
    pub fx: f64,
    /// Focal length along y, in pixels.
    pub fy: f64,
    /// Principal point x; the centre of column j lies at j + 0.5.
    pub cx: f64,
    /// Principal point y; the centre of row i lies at i + 0.5.
    pub cy: f64,
    /// Rigid transform of world points to camera points, row-major 4x4.
    pub world_to_camera: [[f64; 4]; 4],
}

impl Camera {
    /// The camera centre in world coordinates.
    pub fn center_world(&self) -> [f64; 3] {
        let (r, t) = self.rotation_translation();
        (-(r.transpose() * t)).to_array()
    }
    /// Rotation and translation of [`Camera::world_to_camera`].
    pub fn rotation_translation(&self) -> (DMat3, DVec3) {
        let m = &self.world_to_camera;
        let rows = DMat3::from_cols_array_2d(&[[m[0][0], m[0][1], m[0][2]], [m[1][0], m[1][1], m[1][2]], [m[2][0], m[2][1], m[2][2]]]);
        (rows.transpose(), DVec3::new(m[0][3], m[1][3], m[2][3]))
    }
    /// The unit viewing direction (+z of the camera) in world coordinates.
    pub fn forward_world(&self) -> [f64; 3] {
        let m = &self.world_to_camera;
        [m[2][0], m[2][1], m[2][2]]
    }
    /// A camera at `eye_world` that looks at `target_world`; `up_world` points up in the image. `size` is width and height in pixels, `fov_x_rad` the full
    /// horizontal angle. Where the eye is the target, or `up_world` is along the line between them, the transform is not finite, which [`Camera::validate`]
    /// refuses.
    pub fn look_at(name: &str, size: (u32, u32), fov_x_rad: f64, eye_world: [f64; 3], target_world: [f64; 3], up_world: [f64; 3]) -> Self {
        let eye = DVec3::from(eye_world);
        let forward = (DVec3::from(target_world) - eye).normalize();
        let right = forward.cross(DVec3::from(up_world)).normalize();
        let down = forward.cross(right);
        let row = |a: DVec3| [a.x, a.y, a.z, -a.dot(eye)];
        let f = 0.5 * f64::from(size.0) / (0.5 * fov_x_rad).tan();
        Self {
            name: name.to_string(),
            width: size.0,
            height: size.1,
            fx: f,
            fy: f,
            cx: 0.5 * f64::from(size.0),
            cy: 0.5 * f64::from(size.1),
            world_to_camera: [row(right), row(down), row(forward), [0.0, 0.0, 0.0, 1.0]],
        }
    }
    /// The same camera for its whole image resampled to `width` x `height` pixels.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, ..self.clone() }
    }
    /// Refuses non-finite numbers, empty images, focal lengths that are not positive, and transforms that are not rigid.
    ///
    /// # Errors
    /// [`Error::Data`] that names the camera.
    pub fn validate(&self) -> Result<()> {
        let Some(problem) = self.problem() else { return Ok(()) };
        Err(Error::data(format!("camera {}", self.name), problem, "Check the dataset's calibration file"))
    }
    /// What [`Camera::validate`] refuses.
    pub(crate) fn problem(&self) -> Option<String> {
        if self.width == 0 || self.height == 0 {
            return Some(format!("image size {}x{} is empty", self.width, self.height));
        }
        let numbers = [self.fx, self.fy, self.cx, self.cy];
        if numbers.iter().chain(self.world_to_camera.iter().flatten()).any(|v| !v.is_finite()) {
            return Some("a parameter is not finite".into());
        }
        if self.fx <= 0.0 || self.fy <= 0.0 {
            return Some(format!("focal length ({}, {}) is not positive", self.fx, self.fy));
        }
        let (r, _) = self.rotation_translation();
        let error = (r * r.transpose() - DMat3::IDENTITY).to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
        if error > 1e-3 || r.determinant() < 0.0 {
            return Some(format!("world_to_camera is not rigid (orthogonality error {error:.2e}, determinant {:.3})", r.determinant()));
        }
        None
    }
}
