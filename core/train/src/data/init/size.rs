//! Sizes and opacities that leave the image open: no first Gaussian covers much of a view, and uncertain ones do not pile up.

use crate::sample::spread_from_first;
use cc4dgs_core::{Camera, HostGaussians, Scene, Split};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::ops::Range;

/// The most cameras that are asked.
const MAX_CAMERAS: usize = 64;
/// Largest standard deviation of a Gaussian, as a share of the width of the image, at the nearest camera that sees it.
const MAX_WIDTH_SHARE: f64 = 0.04;
/// Where Gaussians are few, they may be as large as this over the root of their number, to cover the image.
const COVER: f64 = 4.0;
/// Largest optical depth of uncertain Gaussians, averaged over the pixels of all cameras.
const MAX_OPTICAL_DEPTH: f64 = 2.0;
/// No opacity is reduced further: fainter Gaussians learn little and are pruned.
const MIN_OPACITY: f64 = 0.02;

/// A training camera.
struct Eye {
    rotation: DMat3,
    translation: DVec3,
    camera: Camera,
}

impl Eye {
    /// Focal length over depth times width, for a point in the image: the share of the width that a unit of length covers.
    fn magnification(&self, p: DVec3) -> Option<f64> {
        let c = self.rotation * p + self.translation;
        let (w, h) = (f64::from(self.camera.width), f64::from(self.camera.height));
        let (u, v) = (self.camera.fx * c.x / c.z + self.camera.cx, self.camera.fy * c.y / c.z + self.camera.cy);
        (c.z > 1e-6 && u >= 0.0 && v >= 0.0 && u <= w && v <= h).then(|| self.camera.fx / (c.z * w))
    }
    fn distance(&self, p: DVec3) -> f64 {
        (self.rotation * p + self.translation).length().max(1e-6)
    }
}

fn eyes(scene: &Scene) -> Vec<Eye> {
    let mut used: Vec<usize> = scene.split(Split::Train).iter().map(|&v| scene.views[v].camera).collect();
    used.sort_unstable();
    used.dedup();
    let eye = |c: usize| {
        let (rotation, translation) = scene.cameras[c].rotation_translation();
        Eye { rotation, translation, camera: scene.cameras[c].clone() }
    };
    spread_from_first(&used, MAX_CAMERAS).into_iter().map(eye).collect()
}

fn mean(host: &HostGaussians, row: usize) -> DVec3 {
    DVec3::from(std::array::from_fn(|k| f64::from(host.means[3 * row + k])))
}

/// Caps the scales of first Gaussians of a whole scene at 4 % of the width of the image in the nearest training camera that sees each (in the nearest camera,
/// if none does; more if there are fewer than 10,000 Gaussians), and returns how many were larger.
pub fn limit_sizes(scene: &Scene, host: &mut HostGaussians) -> usize {
    limit_sizes_to(scene, host, MAX_WIDTH_SHARE.max(COVER / (host.len().max(1) as f64).sqrt()))
}

/// Caps the scales of `host` at `share` of the width of the image, as [`limit_sizes`] does.
pub(crate) fn limit_sizes_to(scene: &Scene, host: &mut HostGaussians, share: f64) -> usize {
    let eyes = eyes(scene);
    let most: Vec<f32> = (0..host.len())
        .into_par_iter()
        .map(|row| {
            let p = mean(host, row);
            let seen = eyes.iter().filter_map(|e| e.magnification(p)).fold(0.0, f64::max);
            let near = || eyes.iter().map(|e| e.camera.fx / (f64::from(e.camera.width) * e.distance(p))).fold(1e-12, f64::max);
            (share / if seen > 0.0 { seen } else { near() }).ln() as f32
        })
        .collect();
    let mut capped = 0;
    for (scales, most) in host.log_scales.chunks_exact_mut(3).zip(most) {
        capped += usize::from(scales.iter().any(|s| *s > most));
        scales.iter_mut().for_each(|s| *s = s.min(most));
    }
    capped
}

/// Lowers the opacities of the Gaussians `rows` together until light that crosses them is dimmed by a factor of e² on average, or they are 0.02; returns the
/// new opacity if they were lowered. Their opacities must be equal.
pub fn limit_opacities(scene: &Scene, host: &mut HostGaussians, rows: Range<usize>) -> Option<f32> {
    let eyes = eyes(scene);
    let first = *host.opacity_logits.get(rows.start)?;
    let opacity = 1.0 / (1.0 + (-f64::from(first)).exp());
    let area = |row: usize| {
        let (p, size) = (mean(host, row), f64::from(host.log_scales[3 * row]).exp());
        let shares = eyes.iter().map(|e| {
            let aspect = f64::from(e.camera.width) / f64::from(e.camera.height);
            e.magnification(p).map_or(0.0, |m| std::f64::consts::TAU * (size * m).powi(2) * aspect)
        });
        shares.sum::<f64>() / eyes.len().max(1) as f64
    };
    // Collected first, so that the order of the sum is fixed.
    let areas: Vec<f64> = rows.clone().into_par_iter().map(area).collect();
    let depth = opacity * areas.iter().sum::<f64>();
    if depth <= MAX_OPTICAL_DEPTH {
        return None;
    }
    let lowered = (opacity * MAX_OPTICAL_DEPTH / depth).max(MIN_OPACITY.min(opacity));
    host.opacity_logits[rows].fill((lowered / (1.0 - lowered)).ln() as f32);
    Some(lowered as f32)
}
