//! Gaussians and cameras that break floating point.

use cc4dgs_core::format::conformance::uniform;
use cc4dgs_core::{Camera, HostGaussians, Seed};

/// Image size in pixels.
pub const SIZE: (u32, u32) = (40, 28);
/// Distance of the camera from the origin.
const DISTANCE: f64 = 4.0;
/// Gaussians of an ordinary scene.
const COUNT: usize = 60;
/// Gaussians of equal depth.
const MANY: usize = 3000;

/// Conditions and levels that are ordinary: every device must draw them. Of families of levels those that nothing speaks against, such as the first decade.
const ORDINARY: [(&str, &str); 11] = [
    ("an ordinary scene", "-"),
    ("coordinates far from the origin", "1e2"),
    ("scales", "1e-2"),
    ("scales", "1e0"),
    ("needles", "1e1"),
    ("opacity at a threshold", "0.99 +0 ulp"),
    ("opacity of 0 and 1", "logit 1e2"),
    ("a near plane crossed", "behind the camera"),
    ("equal depths", "3000"),
    ("saturated harmonics", "1e3"),
    ("degenerate cameras", "inside the scene"),
];

/// A condition at one level.
pub struct Hard {
    pub condition: &'static str,
    pub level: String,
    /// Whether it is one of [`ORDINARY`].
    pub ordinary: bool,
    pub gaussians: HostGaussians,
    pub camera: Camera,
}

/// A camera at the origin's front, moved by `offset` along every axis.
fn camera(offset: f64) -> Camera {
    Camera::look_at("stress", SIZE, 0.9, [offset, offset, offset - DISTANCE], [offset; 3], [0.0, -1.0, 0.0])
}

/// Gaussians of ordinary size in front of the camera.
fn cloud(count: usize) -> HostGaussians {
    let mut g = HostGaussians { sh_degree: 1, ..Default::default() };
    for i in 0..count {
        let draw = |k: usize| uniform(Seed::root(77).index(i as u64), k);
        g.means.extend([1.3 * draw(0), 0.9 * draw(1), draw(2)]);
        g.log_scales.extend([-1.6 + 0.4 * draw(3), -1.6 + 0.4 * draw(4), -1.6 + 0.4 * draw(5)]);
        g.quaternions.extend([1.0 + 0.3 * draw(6), draw(7), draw(8), draw(9)]);
        g.opacity_logits.push(1.5 * draw(10));
        g.sh_dc.extend([0.3 + 0.5 * draw(11), 0.3 + 0.5 * draw(12), 0.3 + 0.5 * draw(13)]);
        g.sh_rest.extend((0..9).map(|c| 0.1 * draw(14 + c)));
        g.dynamic_scores.push(0.0);
    }
    g
}

/// The value `steps` representable numbers above (below, if negative) `value`.
fn nudged(value: f32, steps: i32) -> f32 {
    let mut value = value;
    for _ in 0..steps.abs() {
        value = if steps > 0 { value.next_up() } else { value.next_down() };
    }
    value
}

fn logit(opacity: f64) -> f32 {
    (opacity / (1.0 - opacity)).ln() as f32
}

/// All conditions of the rasterizer.
pub fn all() -> Vec<Hard> {
    let mut list = Vec::new();
    let mut add = |condition: &'static str, level: String, camera: Camera, change: &dyn Fn(&mut HostGaussians)| {
        let mut gaussians = cloud(COUNT);
        change(&mut gaussians);
        let ordinary = ORDINARY.contains(&(condition, level.as_str()));
        list.push(Hard { condition, level, ordinary, gaussians, camera });
    };
    add("an ordinary scene", "-".into(), camera(0.0), &|_| {});
    for decade in 2..=6 {
        let offset = 10f64.powi(decade);
        add("coordinates far from the origin", format!("1e{decade}"), camera(offset), &|g| g.means.iter_mut().for_each(|v| *v += offset as f32));
    }
    for decade in [-8, -6, -4, -2, 0, 1, 2, 3, 4] {
        let log = (10f32.powi(decade)).ln();
        // Not round: the gradients of a sphere's rotation are zero, and their noise says nothing.
        add("scales", format!("1e{decade}"), camera(0.0), &|g| {
            g.log_scales.as_chunks_mut::<3>().0.iter_mut().for_each(|scales| *scales = [log, log - 0.4, log + 0.3]);
        });
    }
    for decade in 1..=6 {
        let aspect = 10f32.powi(decade).ln();
        add("needles", format!("1e{decade}"), camera(0.0), &|g| {
            for scales in g.log_scales.as_chunks_mut::<3>().0 {
                *scales = [-0.7, -0.7 - aspect, -0.7 - aspect];
            }
        });
    }
    for (name, opacity) in [("1/255", 1.0 / 255.0), ("0.99", 0.99)] {
        for steps in [-1, 0, 1] {
            let logit = nudged(logit(opacity), steps);
            add("opacity at a threshold", format!("{name} {steps:+} ulp"), camera(0.0), &|g| g.opacity_logits.fill(logit));
        }
    }
    for logit in [-1e30f32, -100.0, 100.0, 1e30] {
        add("opacity of 0 and 1", format!("logit {logit:e}"), camera(0.0), &|g| g.opacity_logits.fill(logit));
    }
    // The near planes of the rules are 0.01 and 0.2.
    for near in [0.01f64, 0.2] {
        for steps in [-1, 0, 1] {
            let depth = nudged((near - DISTANCE) as f32, steps);
            add("a near plane crossed", format!("{near} {steps:+} ulp"), camera(0.0), &|g| g.means.iter_mut().skip(2).step_by(9).for_each(|z| *z = depth));
        }
    }
    for (name, z) in [("in the camera", -DISTANCE as f32), ("behind the camera", -2.0 * DISTANCE as f32), ("just behind", -DISTANCE as f32 - 1e-6)] {
        add("a near plane crossed", name.into(), camera(0.0), &|g| g.means.iter_mut().skip(2).step_by(6).for_each(|v| *v = z));
    }
    add("equal depths", format!("{MANY}"), camera(0.0), &|g| {
        *g = cloud(MANY);
        g.means.iter_mut().skip(2).step_by(3).for_each(|z| *z = 0.25);
        g.opacity_logits.fill(-2.0);
    });
    add("equal Gaussians", format!("{MANY}"), camera(0.0), &|g| *g = cloud(1).select(&vec![0; MANY]));
    // The second is subnormal; the kernels leave such quaternions out, the oracle draws them.
    for value in [0.0f32, 1e-39, 1e-30, 1e-15, 1e15, 1e19, f32::MAX, f32::NAN] {
        add("quaternions", format!("{value:e}"), camera(0.0), &|g| g.quaternions.iter_mut().skip(8).step_by(2).for_each(|q| *q = value));
        add("quaternions of equal components", format!("{value:e}"), camera(0.0), &|g| g.quaternions.fill(value));
    }
    for value in [1e3f32, 1e10, 1e30, -1e30] {
        add("saturated harmonics", format!("{value:e}"), camera(0.0), &|g| {
            g.sh_dc.iter_mut().step_by(4).for_each(|c| *c = value);
            g.sh_rest.iter_mut().step_by(5).for_each(|c| *c = value);
        });
    }
    for (name, value) in [("NaN", f32::NAN), ("infinity", f32::INFINITY), ("the largest float", f32::MAX)] {
        for (column, attribute) in ["centres", "log-scales", "quaternions", "opacities", "colours"].into_iter().enumerate() {
            add("an attribute that is no number", format!("{attribute}: {name}"), camera(0.0), &|g| {
                if let Some((_, width, values)) = g.columns_mut().into_iter().nth(column) {
                    values.iter_mut().step_by(7 * width).for_each(|v| *v = value);
                }
            });
        }
    }
    for focal in [1e-4f64, 1e-2, 1e4, 1e6, 1e9] {
        let camera = Camera { fx: focal, fy: focal, ..camera(0.0) };
        add("degenerate cameras", format!("focal length {focal:e}"), camera, &|_| {});
    }
    for at in [-1e4f64, 1e4, 1e7] {
        let camera = Camera { cx: at, ..camera(0.0) };
        add("degenerate cameras", format!("principal point at {at:e}"), camera, &|_| {});
    }
    for (width, height) in [(1, 1), (1, 400), (257, 1)] {
        let camera = Camera { width, height, ..camera(0.0) };
        add("degenerate cameras", format!("{width}x{height} pixels"), camera, &|_| {});
    }
    let inside = Camera::look_at("inside", SIZE, 0.9, [0.05, 0.02, 0.1], [0.0, 0.3, 1.0], [0.0, -1.0, 0.0]);
    add("degenerate cameras", "inside the scene".into(), inside, &|_| {});
    list
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_ordinary_condition_is_tried() {
        let tried: Vec<Hard> = all();
        for (condition, level) in ORDINARY {
            assert_eq!(tried.iter().filter(|hard| hard.ordinary && hard.condition == condition && hard.level == level).count(), 1, "{condition}, {level}");
        }
        assert_eq!(tried.iter().filter(|hard| hard.ordinary).count(), ORDINARY.len());
    }
}
