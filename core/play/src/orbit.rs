//! A circle of cameras around a model.

use cc4dgs_core::{Camera, Error, HostGaussians, Result};

/// Height of the circle over the model's middle, in radians.
const ELEVATION: f64 = 0.35;
/// Full horizontal angle of the cameras, in radians.
pub(crate) const FOV_X: f64 = 0.9;
/// Gaussians fainter than this are haze and say nothing of where the model is.
const FAINT_LOGIT: f32 = -2.0;
/// The share of the Gaussians that lie within the radius of a model.
const SHARE: f64 = 0.7;
/// Standard deviations from the centre of a Gaussian to where it is hardly seen.
const EXTENT: f64 = 3.0;

/// A circle of cameras that look at the middle of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct Orbit {
    /// Width and height of the images in pixels.
    pub size: (u32, u32),
    /// Cameras, evenly spread over the turns.
    pub frames: usize,
    /// Full turns.
    pub turns: f64,
    /// The signed unit axis of the world that points up.
    pub up: [f64; 3],
}

impl Default for Orbit {
    fn default() -> Self {
        Self { size: (800, 600), frames: 60, turns: 1.0, up: [0.0, 0.0, 1.0] }
    }
}

impl Orbit {
    /// The cameras, far enough to see most of what `gaussians` show.
    ///
    /// # Errors
    /// [`Error::Parameter`] for turns or an axis that are no numbers and for empty images, [`Error::Data`] for Gaussians so far away that no camera can look
    /// at them.
    pub fn around(&self, gaussians: &HostGaussians) -> Result<Vec<Camera>> {
        let bad = |problem: String, remedy: &str| Err(Error::parameter("orbit", problem, remedy));
        if !self.turns.is_finite() {
            return bad(format!("{} turns are not a number", self.turns), "Give the number of full turns, such as 1");
        }
        let Some(axis) = self.up.iter().position(|c| c.abs() == 1.0).filter(|_| self.up.iter().map(|c| c.abs()).sum::<f64>() == 1.0) else {
            return bad(format!("{:?} is no signed axis", self.up), "Give one of x, y and z with its sign, such as [0, 0, 1]");
        };
        let (middle, distance) = middle_and_distance(gaussians, self.size)?;
        // Two axes perpendicular to `up`.
        let (mut side, mut front) = ([0.0; 3], [0.0; 3]);
        side[(axis + 1) % 3] = 1.0;
        front[(axis + 2) % 3] = 1.0;
        let camera = |i: usize| {
            let (s, c) = (self.turns * std::f64::consts::TAU * i as f64 / self.frames.max(1) as f64).sin_cos();
            let flat = distance * ELEVATION.cos();
            let eye: [f64; 3] = std::array::from_fn(|k| middle[k] + flat * (c * side[k] + s * front[k]) + distance * ELEVATION.sin() * self.up[k]);
            Camera::look_at(&format!("orbit{i:05}"), self.size, FOV_X, eye, middle, self.up)
        };
        checked((0..self.frames).map(camera).collect(), middle, distance)
    }
    /// Normalised time of a frame, so that time runs from 0 to 1 over the orbit.
    pub fn time(&self, frame: usize) -> f32 {
        if self.frames > 1 { frame as f32 / (self.frames - 1) as f32 } else { 0.0 }
    }
}

/// The middle of `gaussians`, and how far from it a camera sees most of what they show in images of `size` (width and height in pixels).
///
/// # Errors
/// [`Error::Parameter`] for empty images.
pub(crate) fn middle_and_distance(gaussians: &HostGaussians, (width, height): (u32, u32)) -> Result<([f64; 3], f64)> {
    if width == 0 || height == 0 {
        return Err(Error::parameter("orbit", format!("images of {width}x{height} pixels are empty"), "Give a size such as 800x600"));
    }
    let (middle, radius) = middle_and_radius(gaussians);
    // Far enough for a sphere of the radius to fill most of the narrower field of view.
    let narrow = 0.5 * FOV_X * f64::from(height.min(width)) / f64::from(width);
    Ok((middle, 1.1 * radius / narrow.sin()))
}

/// `cameras` that look at `middle` from `distance` away.
///
/// # Errors
/// [`Error::Data`] where that is so far away that no camera can look at it.
pub(crate) fn checked(cameras: Vec<Camera>, middle: [f64; 3], distance: f64) -> Result<Vec<Camera>> {
    cameras.iter().try_for_each(Camera::validate).map_err(|_| {
        let problem = format!("no camera can look at Gaussians around {middle:?} from {distance:e} away; such numbers are too far apart for float64");
        Error::data("orbit", problem, "Move the model to the origin, or remove Gaussians that are far away")
    })?;
    Ok(cameras)
}

/// The median of the centres and the distance within which [`SHARE`] of them lie: a background far away must not push the camera out. If the Gaussians
/// themselves are larger than that, such as a single one, it is their size instead. 1 for models without either.
pub(crate) fn middle_and_radius(gaussians: &HostGaussians) -> ([f64; 3], f64) {
    let mut kept: Vec<usize> = (0..gaussians.len()).filter(|&i| gaussians.opacity_logits[i] > FAINT_LOGIT).collect();
    if kept.is_empty() {
        kept = (0..gaussians.len()).collect();
    }
    let centres: Vec<[f64; 3]> = kept.iter().map(|&i| std::array::from_fn(|k| f64::from(gaussians.means[3 * i + k]))).collect();
    let size = |&i: &usize| {
        let own = gaussians.log_scales.get(3 * i..3 * i + 3)?;
        Some(EXTENT * own.iter().map(|v| f64::from(*v).exp()).fold(0.0, f64::max)).filter(|size| size.is_finite())
    };
    let quantile = |mut values: Vec<f64>, q: f64| {
        values.sort_unstable_by(f64::total_cmp);
        values.get((q * values.len() as f64) as usize).copied().unwrap_or(0.0)
    };
    let middle: [f64; 3] = std::array::from_fn(|k| quantile(centres.iter().map(|p| p[k]).collect(), 0.5));
    let distance = |p: &[f64; 3]| (0..3).map(|k| (p[k] - middle[k]).powi(2)).sum::<f64>().sqrt();
    let radius = quantile(centres.iter().map(distance).collect(), SHARE).max(quantile(kept.iter().filter_map(size).collect(), SHARE));
    (middle, if radius > 0.0 { radius } else { 1.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(offset: f32) -> HostGaussians {
        let corners = (0..8).flat_map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|b| offset + b as f32));
        HostGaussians { means: corners.collect(), opacity_logits: vec![2.0; 8], ..Default::default() }
    }

    #[test]
    fn cameras_circle_the_middle_and_look_at_it() {
        for up in [[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]] {
            let cameras = Orbit { size: (80, 60), frames: 12, up, ..Orbit::default() }.around(&cube(5.0)).unwrap();
            for camera in &cameras {
                let seen: [f64; 3] = std::array::from_fn(|r| (0..3).map(|c| camera.world_to_camera[r][c] * 5.5).sum::<f64>() + camera.world_to_camera[r][3]);
                assert!(seen[2] > 1.0 && (seen[0] / seen[2]).abs() < 0.3 && (seen[1] / seen[2]).abs() < 0.3, "{seen:?}");
                let above: f64 = camera.center_world().iter().zip(up).map(|(c, u)| (c - 5.5) * u).sum();
                assert!(above > 0.0);
            }
            assert_ne!(cameras[0], cameras[6]);
        }
    }

    #[test]
    fn a_single_gaussian_is_seen_from_outside_whatever_its_size() {
        let small = Orbit { size: (80, 60), frames: 1, ..Orbit::default() };
        let distance = |count: usize, size: f64| {
            let log_scales = [size.ln() as f32, -60.0, -70.0].repeat(count);
            let model = HostGaussians { means: vec![3.0; 3 * count], log_scales, opacity_logits: vec![2.0; count], ..Default::default() };
            let eye = small.around(&model).unwrap()[0].center_world();
            eye.iter().map(|v| (v - 3.0).powi(2)).sum::<f64>().sqrt()
        };
        // All at one place have no distance from each other either.
        for (count, size) in [(1, 1e-5), (1, 1.0), (1, 1e5), (4, 1e-5), (4, 1e5)] {
            let ratio = distance(count, size) / size;
            assert!((5.0..20.0).contains(&ratio), "{count} of size {size}: seen from {ratio} times as far");
        }
        let tiny = HostGaussians { log_scales: vec![-20.0; 24], ..cube(5.0) };
        assert_eq!(small.around(&tiny).unwrap(), small.around(&cube(5.0)).unwrap(), "sizes below the distances change nothing");
        let broken = HostGaussians { means: vec![3.0; 3], log_scales: vec![f32::INFINITY; 3], opacity_logits: vec![2.0], ..Default::default() };
        assert_eq!(middle_and_radius(&broken).1, 1.0);
    }

    #[test]
    fn degenerate_models_still_get_cameras() {
        let one = HostGaussians { means: vec![3.0; 3], opacity_logits: vec![-9.0], ..Default::default() };
        let small = Orbit { size: (8, 8), frames: 2, ..Orbit::default() };
        assert_eq!(small.around(&one).unwrap().len(), 2);
        assert_eq!(small.around(&HostGaussians::default()).unwrap().len(), 2);
        assert!(Orbit { turns: f64::NAN, ..small.clone() }.around(&one).is_err());
        assert!(Orbit { up: [0.0, 0.5, 0.5], ..small.clone() }.around(&one).is_err());
        let far = HostGaussians { means: vec![1e30; 3], opacity_logits: vec![2.0], ..Default::default() };
        let message = small.around(&far).unwrap_err().to_string();
        assert!(message.contains("no camera can look"), "{message}");
        assert!(Orbit { size: (0, 8), ..small }.around(&one).is_err());
    }
}
