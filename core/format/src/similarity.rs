//! Similarities (scale and translation) between a dataset and the normalised frame in which it is trained.

use crate::{Camera, Error, HostGaussians, Result};
use serde::{Deserialize, Serialize};

/// The map x -> scale * x + translation. The directions of axes do not change, so quaternions, viewing directions and spherical harmonics do not either.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Similarity {
    /// Units of the target per unit of the source, positive.
    pub scale: f64,
    /// The source's origin, in the target's coordinates.
    pub translation: [f64; 3],
}

impl Default for Similarity {
    fn default() -> Self {
        Self::IDENTITY
    }
}

impl std::fmt::Display for Similarity {
    /// All digits: two similarities may differ in the last ones alone.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [x, y, z] = self.translation;
        write!(f, "scale {} and translation ({x}, {y}, {z})", self.scale)
    }
}

impl Similarity {
    /// The identity.
    pub const IDENTITY: Self = Self { scale: 1.0, translation: [0.0; 3] };

    /// The map of `center` to the origin that multiplies lengths by `scale`.
    pub fn centred(center: [f64; 3], scale: f64) -> Self {
        Self { scale, translation: center.map(|c| -scale * c) }
    }
    /// Refuses numbers that are not finite, scales that are not positive, and scales too far from 1 for float32 positions; `object` names
    /// the file in the error.
    pub fn validate(&self, object: &str) -> Result<()> {
        let sound = (1e-15..=1e15).contains(&self.scale) && self.translation.iter().all(|v| v.is_finite());
        if sound {
            return Ok(());
        }
        Err(Error::data(object, format!("{self} are not a change of unit and origin"), "The file is damaged; fetch or write it again"))
    }
    /// A point's coordinates in the target.
    pub fn apply(&self, point: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| self.scale * point[k] + self.translation[k])
    }
    /// The inverse map.
    pub fn inverse(&self) -> Self {
        Self { scale: 1.0 / self.scale, translation: self.translation.map(|t| -t / self.scale) }
    }
    /// The composition: `first`, then this map.
    pub fn compose(&self, first: &Self) -> Self {
        Self { scale: self.scale * first.scale, translation: self.apply(first.translation) }
    }
    /// The camera whose image of the mapped scene equals `camera`'s image of the original; depths are multiplied by the scale.
    pub fn apply_camera(&self, camera: &Camera) -> Camera {
        let mut out = camera.clone();
        let center = self.apply(camera.center_world());
        for row in out.world_to_camera.iter_mut().take(3) {
            row[3] = -(0..3).map(|k| row[k] * center[k]).sum::<f64>();
        }
        out
    }
    /// Maps Gaussians: centres are mapped, the logarithm of the scale is added to log-scales. Attributes of plug-ins are unchanged.
    pub fn apply_gaussians(&self, gaussians: &mut HostGaussians) {
        if *self == Self::IDENTITY {
            return;
        }
        for (index, value) in gaussians.means.iter_mut().enumerate() {
            *value = (self.scale * f64::from(*value) + self.translation[index % 3]) as f32;
        }
        let shift = self.scale.ln();
        gaussians.log_scales.iter_mut().for_each(|v| *v = (f64::from(*v) + shift) as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: Similarity = Similarity { scale: 0.25, translation: [3.0, -1.0, 0.5] };

    #[test]
    fn inverse_and_composition_agree() {
        let p = [2.0, -7.0, 11.0];
        let close = |a: [f64; 3], b: [f64; 3]| assert!((0..3).all(|k| (a[k] - b[k]).abs() < 1e-12), "{a:?} {b:?}");
        close(S.inverse().apply(S.apply(p)), p);
        let other = Similarity::centred([1.0, 2.0, 3.0], 5.0);
        close(other.apply([1.0, 2.0, 3.0]), [0.0; 3]);
        close(S.compose(&other).apply(p), S.apply(other.apply(p)));
        assert_eq!(S.compose(&Similarity::IDENTITY), S);
    }

    #[test]
    fn a_moved_camera_sees_the_moved_scene() {
        let camera = Camera::look_at("t", (64, 48), 0.8, [4.0, 1.0, 2.0], [0.2, 0.1, 0.0], [0.0, 0.0, 1.0]);
        let moved = S.apply_camera(&camera);
        moved.validate().unwrap();
        let seen = |camera: &Camera, p: [f64; 3]| -> [f64; 3] {
            let m = &camera.world_to_camera;
            std::array::from_fn(|i| (0..3).map(|k| m[i][k] * p[k]).sum::<f64>() + m[i][3])
        };
        for p in [[0.0; 3], [1.0, -2.0, 0.3]] {
            let (before, after) = (seen(&camera, p), seen(&moved, S.apply(p)));
            assert!((0..3).all(|k| (after[k] - S.scale * before[k]).abs() < 1e-12), "{before:?} {after:?}");
        }
    }

    #[test]
    fn gaussians_come_back() {
        let mut g = HostGaussians { means: vec![1.0, 2.0, 3.0], log_scales: vec![-2.0; 3], ..Default::default() };
        let start = g.clone();
        S.apply_gaussians(&mut g);
        assert_eq!(g.means, [3.25, -0.5, 1.25]);
        assert!((g.log_scales[0] - (-2.0 + 0.25f32.ln())).abs() < 1e-6);
        S.inverse().apply_gaussians(&mut g);
        assert!(g.means.iter().zip(&start.means).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn nonsense_is_refused() {
        for bad in [
            Similarity { scale: 0.0, ..S },
            Similarity { scale: -1.0, ..S },
            Similarity { scale: f64::NAN, ..S },
            Similarity { translation: [f64::INFINITY; 3], ..S },
        ] {
            assert!(bad.validate("t").is_err(), "{bad:?}");
        }
        assert!(S.validate("t").is_ok());
    }
}
