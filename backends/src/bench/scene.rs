//! A synthetic scene (people in a room), of the size of published scenes: Gaussians on walls, floor and moving bodies, with the statistics of a trained scene.

use super::workload::uniform;
use super::{StepCase, Workload};
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Camera, HostGaussians, Seed};
use std::borrow::Cow;

/// Size of a synthetic scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneCase {
    /// For tables.
    pub name: Cow<'static, str>,
    /// Size of the images and number of Gaussians.
    pub size: StepCase,
    /// Share of the Gaussians that moves.
    pub dynamic_share: f32,
}

/// Synthetic scenes of the size of published scenes.
pub const SCENE_CASES: [SceneCase; 2] = [
    SceneCase { name: Cow::Borrowed("n3dv"), size: StepCase { width: 1352, height: 1014, gaussians: 335_000 }, dynamic_share: 0.12 },
    SceneCase { name: Cow::Borrowed("technicolor"), size: StepCase { width: 2048, height: 1088, gaussians: 335_000 }, dynamic_share: 0.12 },
];

/// Numbers of Gaussians, and megapixels, for which [`growth`] makes cases.
const GROWTH: ([usize; 8], [f64; 6]) = ([10_000, 30_000, 100_000, 335_000, 1_000_000, 2_000_000, 3_000_000, 5_000_000], [0.1, 0.3, 1.0, 2.0, 4.0, 8.0]);

/// The first scene with ever more Gaussians, then with ever larger images.
pub fn growth() -> Vec<SceneCase> {
    let [first, _] = SCENE_CASES;
    let gaussians = GROWTH.0.map(|n| SceneCase { name: format!("{}k", n / 1000).into(), size: StepCase { gaussians: n, ..first.size }, ..first });
    let pixels = GROWTH.1.map(|megapixels| {
        let width = (megapixels * 1e6 * 4.0 / 3.0).sqrt().round();
        let size = StepCase { width: width as u32, height: (megapixels * 1e6 / width).round() as u32, ..first.size };
        SceneCase { name: format!("{megapixels} MP").into(), size, ..first }
    });
    gaussians.into_iter().chain(pixels).collect()
}

/// `case` with a share of its pixels and Gaussians.
pub fn shrunk(case: &SceneCase, share: f64) -> SceneCase {
    let shrink = |v: f64, by: f64| (v * by).round().max(1.0);
    let side = share.sqrt();
    let size = StepCase {
        width: shrink(f64::from(case.size.width), side) as u32,
        height: shrink(f64::from(case.size.height), side) as u32,
        gaussians: shrink(case.size.gaussians as f64, share) as usize,
    };
    SceneCase { size, ..case.clone() }
}

/// Number of Gaussians on which the statistics below were measured: `panoptic_basketball` trained for 12,000 iterations.
const MEASURED: f32 = 50_000.0;
/// Mean and standard deviation of the log-scale of the longest axis.
const LONGEST: (f32, f32) = (-3.24, 0.9);
/// Difference of the log-scales of the other axes from the longest one: mean and standard deviation.
const SHORTER: [(f32, f32); 2] = [(0.6, 0.5), (1.9, 1.4)];
/// Mean and standard deviation of the opacity logit.
const LOGIT: (f32, f32) = (0.1, 2.9);
/// Half the width and the height of the room, its depth, world units; the camera stands at the origin and looks along z.
const HALF_WIDTH: f32 = 3.0;
const HEIGHT: f32 = 3.0;
const DEPTH: f32 = 6.0;
/// Bodies that move.
const BODIES: u64 = 4;
/// Dynamic scores of moving and of static Gaussians.
const SCORES: [f32; 2] = [10.0, -10.0];

/// The scene of `case`; the same for the same seed. Gaussians that move come first.
pub fn synthetic_scene(case: &SceneCase, seed: Seed) -> Workload {
    let n = case.size.gaussians;
    let moving = (n as f32 * case.dynamic_share).round() as usize;
    let normal = |seed: Seed, k: u64| {
        // Box-Muller; the radius stays finite.
        let (u, v) = (0.5 + 0.5 * uniform(seed, 2 * k), uniform(seed, 2 * k + 1));
        (-2.0 * u.max(1e-7).ln()).sqrt() * (std::f32::consts::PI * v).cos()
    };
    let positions = seed.child("place");
    let body_of = seed.child("bodies");
    let mut means = Vec::with_capacity(3 * n);
    for i in 0..n as u64 {
        let [u, v, w] = std::array::from_fn(|k| uniform(positions, 3 * i + k as u64));
        if (i as usize) < moving {
            // An ellipsoid's surface per body: 0.3 wide, 1.7 high.
            let body = i % BODIES;
            let [bx, bz] = std::array::from_fn(|k| uniform(body_of, 2 * body + k as u64));
            let length = (u * u + v * v + w * w).sqrt().max(1e-3);
            means.extend([1.8 * bx + 0.3 * u / length, 0.35 + 0.85 * v / length, 3.8 + 0.8 * bz + 0.3 * w / length]);
        } else {
            let (x, y, z) = (HALF_WIDTH * u, 0.5 * HEIGHT * v - 0.3, 0.5 * DEPTH * (w + 1.0));
            means.extend(match i % 5 {
                0 | 1 => [x, y, DEPTH],
                2 => [x, 0.5 * HEIGHT - 0.3, z],
                3 => [-HALF_WIDTH, y, z],
                _ => [HALF_WIDTH, y, z],
            });
        }
    }
    // More Gaussians share the same surfaces, so each is smaller.
    let shrink = 0.5 * (n as f32 / MEASURED).ln();
    let (size, shape) = (seed.child("size"), seed.child("shape"));
    let mut log_scales = Vec::with_capacity(3 * n);
    for i in 0..n as u64 {
        let longest = LONGEST.0 - shrink + LONGEST.1 * normal(size, i);
        let [a, b] = std::array::from_fn(|k| longest - (SHORTER[k].0 + SHORTER[k].1 * normal(shape, 2 * i + k as u64)).max(0.0));
        log_scales.extend([longest, a, b]);
    }
    let stream = |name: &str, len: usize, scale: f32| -> Vec<f32> {
        let seed = seed.child(name);
        (0..len as u64).map(|k| scale * uniform(seed, k)).collect()
    };
    let opacity = seed.child("opacity");
    let degree = 3;
    let gaussians = HostGaussians {
        sh_degree: degree,
        means,
        log_scales,
        quaternions: stream("quaternions", 4 * n, 1.0),
        opacity_logits: (0..n as u64).map(|i| LOGIT.0 + LOGIT.1 * normal(opacity, i)).collect(),
        sh_dc: stream("sh_dc", 3 * n, 1.5),
        sh_rest: stream("sh_rest", 3 * sh_rest_len(degree) * n, 0.2),
        dynamic_scores: (0..n).map(|i| SCORES[usize::from(i >= moving)]).collect(),
        extra: Default::default(),
    };
    let camera = Camera::look_at("room", (case.size.width, case.size.height), 1.2, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]);
    Workload { name: case.name.to_string(), gaussians, camera }
}
