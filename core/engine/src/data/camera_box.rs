//! Where a scene without points probably is, judged from its cameras alone.

use cc4dgs_core::{RawCamera, Scene, Split};
use glam::{DMat3, DVec3};

/// A box in world units: around the point the training cameras look at, wide enough to hold what they see.
///
/// The point is the least-squares intersection of the optical axes. Cameras that surround it get a cube with the radius of the rig and a tenth
/// more; cameras on one side get one as deep as their distance.
pub fn camera_box(scene: &Scene) -> ([f32; 3], [f32; 3]) {
    let mut used: Vec<usize> = scene.split(Split::Train).iter().map(|&v| scene.views[v].camera).collect();
    used.sort_unstable();
    used.dedup();
    let rays: Vec<(DVec3, DVec3)> =
        used.iter().map(|&c| (DVec3::from(scene.cameras[c].center_world()), DVec3::from(scene.cameras[c].forward_world()).normalize_or_zero())).collect();
    let (center, half) = look_at_box(&rays);
    let corner = |sign: f64| (center + DVec3::splat(sign * half)).as_vec3().to_array();
    (corner(-1.0), corner(1.0))
}

/// The box around what the cameras see between their near and far depths, from the raw numbers of a LLFF file. The far depth is the median one
/// and at most eight times the median near one: a few points at the horizon must not spread the box over nothing. `None` if depths are unusable.
pub(crate) fn frustum_box(cameras: &[RawCamera], depths: &[(f64, f64)]) -> Option<[[f64; 3]; 2]> {
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v.get(v.len() / 2).copied()
    };
    let near = median(depths.iter().map(|d| d.0).collect())?;
    let far = median(depths.iter().map(|d| d.1).collect())?.min(8.0 * near);
    if !(near > 0.0 && far > near) {
        return None;
    }
    let (mut low, mut high) = (DVec3::splat(f64::INFINITY), DVec3::splat(f64::NEG_INFINITY));
    for c in cameras {
        let m = &c.world_to_camera;
        let [w, h] = c.size.map(f64::from);
        for z in [near, far] {
            for (u, v) in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)] {
                let p = [(u - c.principal[0]) / c.focal[0] * z - m[0][3], (v - c.principal[1]) / c.focal[1] * z - m[1][3], z - m[2][3]];
                let world = DVec3::from(std::array::from_fn::<f64, 3, _>(|j| (0..3).map(|i| m[i][j] * p[i]).sum()));
                (low, high) = (low.min(world), high.max(world));
            }
        }
    }
    (low.is_finite() && high.is_finite()).then(|| [low.to_array(), high.to_array()])
}

/// Centre and half-width from camera centres and unit forward directions.
fn look_at_box(rays: &[(DVec3, DVec3)]) -> (DVec3, f64) {
    let n = rays.len().max(1) as f64;
    let mean = rays.iter().map(|r| r.0).sum::<DVec3>() / n;
    let forward = rays.iter().map(|r| r.1).sum::<DVec3>() / n;
    let spread = (rays.iter().map(|r| (r.0 - mean).length_squared()).sum::<f64>() / n).sqrt();
    let scale = if spread > 1e-6 { spread } else { 1.0 };
    // Axes that hardly converge leave the distance open; a weak pull to a few rig widths ahead keeps it finite.
    let prior = mean + forward * (3.0 * scale);
    let weight = 1e-3 * n;
    let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    let (mut a, mut b) = (DMat3::IDENTITY * weight, prior * weight);
    for &(c, d) in rays {
        let m = DMat3::IDENTITY - outer(d);
        a += m;
        b += m * c;
    }
    let point = a.inverse() * b;
    let behind = rays.iter().filter(|(c, d)| (point - *c).dot(*d) < 0.0).count();
    if !point.is_finite() || 2 * behind > rays.len() {
        // The cameras look outwards.
        return (mean, 3.0 * scale);
    }
    let farthest = rays.iter().map(|r| (r.0 - point).length()).fold(0.0, f64::max);
    let half = if forward.length() < 0.7 { 1.1 * farthest } else { farthest };
    (point, half.max(1e-3))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ring_is_centred() {
        let target = DVec3::new(1.0, 2.0, 3.0);
        let rays: Vec<_> = (0..8)
            .map(|i| {
                let (s, c) = (f64::from(i) * 0.785).sin_cos();
                let eye = target + 4.0 * DVec3::new(c, s, 0.3);
                (eye, (target - eye).normalize())
            })
            .collect();
        let (center, half) = look_at_box(&rays);
        assert!((center - target).length() < 0.02, "{center}");
        assert!((4.0..6.0).contains(&half), "{half}");
    }

    #[test]
    fn parallel_cameras_look_ahead() {
        let rays: Vec<_> = (0..4).map(|i| (DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z)).collect();
        let (center, half) = look_at_box(&rays);
        assert!(center.is_finite() && center.z > 1.0 && half > 0.5, "{center} {half}");
        let (center, half) = look_at_box(&[]);
        assert!(center.is_finite() && half.is_finite());
    }
}
