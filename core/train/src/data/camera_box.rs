//! Where a scene without points probably is, judged from its cameras alone.

use super::focus::focus;
use cc4dgs_core::{InitBox, RawCamera, Scene, Split};
use glam::DVec3;

/// A box in the scene's units: around the point the training cameras look at, wide enough to hold what they see.
///
/// The point is the least-squares intersection of the optical axes. Cameras that surround it get a cube with the radius of the rig and a tenth
/// more; cameras on one side get one as deep as their distance.
pub fn camera_box(scene: &Scene) -> ([f32; 3], [f32; 3]) {
    let mut used: Vec<usize> = scene.split(Split::Train).iter().map(|&v| scene.views[v].camera).collect();
    used.sort_unstable();
    used.dedup();
    let rays: Vec<(DVec3, DVec3)> =
        used.iter().map(|&c| (DVec3::from(scene.cameras[c].center_world()), DVec3::from(scene.cameras[c].forward_world()).normalize_or_zero())).collect();
    let found = focus(&rays, None);
    let corner = |sign: f64| (found.point + DVec3::splat(sign * found.half)).as_vec3().to_array();
    (corner(-1.0), corner(1.0))
}

/// The box around what the cameras see between their near and far depths, from the raw numbers of a LLFF file. The far depth is the median one
/// and at most eight times the median near one: a few points at the horizon must not spread the box over nothing. `None` if depths are unusable.
pub(crate) fn frustum_box(cameras: &[RawCamera], depths: &[(f64, f64)]) -> Option<InitBox> {
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
    (low.is_finite() && high.is_finite()).then(|| InitBox::Corners { low: low.to_array(), high: high.to_array() })
}
