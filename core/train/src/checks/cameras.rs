//! Whether the cameras can see depth at all.

use super::{Finding, Severity, Subject};
use cc4dgs_core::{Scene, Split};
use glam::DVec3;

/// Cameras closer to each other than this share of their distance from what they see stand at one point.
const ONE_POINT: f64 = 1e-5;

/// Scenes without parallax: refused, and doubted where initial points say where surfaces are.
pub(super) fn check(scene: &Scene) -> Vec<Finding> {
    let train = scene.split(Split::Train);
    let centers: Vec<DVec3> = train.iter().map(|&v| DVec3::from(scene.camera(v).center_world())).collect();
    let first = centers.first().copied().unwrap_or_default();
    let apart = centers.iter().map(|c| (*c - first).length()).fold(0.0, f64::max);
    // In the normalised frame what the cameras see is around the origin.
    if apart > ONE_POINT * first.length() + 1e-9 {
        return Vec::new();
    }
    let problem = match train.len() {
        1 => "there is one training image only, and depth cannot be known from a single image".to_string(),
        n => format!("all {n} training images were taken from one point, and without parallax depth cannot be known"),
    };
    let remedy = "Add images from other positions, check that the poses are the right ones, and look for warnings about images that were skipped";
    let severity = if scene.points.is_some() { Severity::Doubt } else { Severity::Refuse };
    vec![Finding::new(severity, Subject::Cameras, problem, remedy)]
}
