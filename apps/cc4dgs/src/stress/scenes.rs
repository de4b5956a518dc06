//! Gaussians and cameras that break floating point.

use cc4dgs_core::format::conformance::uniform;
use cc4dgs_core::{Camera, HostGaussians, Seed};

/// Image size in pixels.
pub const SIZE: (u32, u32) = (40, 28);
/// Distance of the camera from the origin.
const DISTANCE: f64 = 4.0;
/// A scene and a camera whose axes are those of the world are moved and rounded to float32. The oracle draws them unmoved.
const MOVED: &str = "moved scene against the unmoved";
/// The same with the camera at [`TURNED`]: its rotation is not exact in float32, and is multiplied by the large coordinates.
const MOVED_TURNED: &str = "moved scene, turned camera";
/// Centre of a camera that looks at the origin along no axis, [`DISTANCE`] away.
const TURNED: [f64; 3] = [DISTANCE * 2.0 / 3.0, -DISTANCE / 3.0, -DISTANCE * 2.0 / 3.0];
/// Gaussians of an ordinary scene.
const COUNT: usize = 60;
/// Gaussians of equal depth.
const MANY: usize = 3000;

/// Conditions and levels that are ordinary: every device must draw them. Of conditions with several levels the mild ones, such as the first decade; of moved
/// scenes those at which float32 coordinates are finer than a hundredth of a pixel.
const ORDINARY: [(&str, &str); 15] = [
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
    (MOVED, "1e2"),
    (MOVED, "1e3"),
    (MOVED_TURNED, "1e2"),
    (MOVED_TURNED, "1e3"),
];

/// A condition at one level.
pub struct Hard {
    pub condition: &'static str,
    pub level: String,
    /// Whether it is one of [`ORDINARY`].
    pub ordinary: bool,
    /// What the rasterizer under test draws.
    pub drawn: Drawn,
    /// What the oracle draws, where it is not the same.
    pub exact: Option<Drawn>,
}

/// Gaussians, and the camera that sees them.
pub struct Drawn {
    pub gaussians: HostGaussians,
    pub camera: Camera,
}

impl Hard {
    fn new(condition: &'static str, level: String, drawn: Drawn, exact: Option<Drawn>) -> Self {
        let ordinary = ORDINARY.contains(&(condition, level.as_str()));
        Self { condition, level, ordinary, drawn, exact }
    }
}

/// A camera at the origin's front, moved by `offset` along every axis.
fn camera(offset: f64) -> Camera {
    camera_at([0.0, 0.0, -DISTANCE], offset)
}

/// A camera at `eye` that looks at the origin, moved by `offset` along every axis.
fn camera_at(eye: [f64; 3], offset: f64) -> Camera {
    Camera::look_at("stress", SIZE, 0.9, eye.map(|v| v + offset), [offset; 3], [0.0, -1.0, 0.0])
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
        list.push(Hard::new(condition, level, Drawn { gaussians, camera }, None));
    };
    add("an ordinary scene", "-".into(), camera(0.0), &|_| {});
    // The oracle gets the rounded centres, too, and the camera looks along an axis, so nothing large is rounded after that. `moved` shows what is lost.
    for decade in 2..=6 {
        let offset = 10f64.powi(decade);
        add("coordinates far from the origin", format!("1e{decade}"), camera(offset), &|g| g.means.iter_mut().for_each(|v| *v += offset as f32));
    }
    for decade in [-8, -6, -4, -2, 0, 1, 2, 3, 4] {
        let log = (10f32.powi(decade)).ln();
        // Not spheres: the gradients of their rotation are zero, and would be noise alone.
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
    list.extend(moved());
    list
}

/// The ordinary scene and a camera, moved in float64 and rounded to float32; the oracle draws them as they were. The rounding of coordinates does not cancel.
fn moved() -> Vec<Hard> {
    let mut list = Vec::new();
    for (condition, eye) in [(MOVED, [0.0, 0.0, -DISTANCE]), (MOVED_TURNED, TURNED)] {
        for decade in 2..=6 {
            let offset = 10f64.powi(decade);
            let mut gaussians = cloud(COUNT);
            gaussians.means.iter_mut().for_each(|v| *v = (f64::from(*v) + offset) as f32);
            let drawn = Drawn { gaussians, camera: camera_at(eye, offset) };
            let exact = Drawn { gaussians: cloud(COUNT), camera: camera_at(eye, 0.0) };
            list.push(Hard::new(condition, format!("1e{decade}"), drawn, Some(exact)));
        }
    }
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

    #[test]
    fn moved_scenes_are_ordinary_where_float32_is_finer_than_a_hundredth_of_a_pixel() {
        let list = moved();
        assert_eq!(list.len(), 10);
        for hard in &list {
            let offset: f64 = hard.level.parse().unwrap();
            let pixel = DISTANCE / hard.drawn.camera.fx;
            assert_eq!(hard.ordinary, offset * f64::from(f32::EPSILON) < 0.01 * pixel, "{}, {}", hard.condition, hard.level);
            // The oracle draws the same scene at the origin: only the positions of Gaussians and camera differ.
            let exact = hard.exact.as_ref().unwrap();
            let means = HostGaussians { means: exact.gaussians.means.clone(), ..hard.drawn.gaussians.clone() };
            assert_eq!(means, exact.gaussians);
            let (here, there) = (exact.camera.center_world(), hard.drawn.camera.center_world());
            assert!((0..3).all(|k| (there[k] - here[k] - offset).abs() < 1e-6), "{here:?} {there:?}");
        }
    }
}
