//! Random numbers, cameras and Gaussians of fresh cases.

use crate::raster_fixtures::{narrow, settings, widen};
use cc4dgs_backends::ops::rasterize::RasterSettings;
use cc4dgs_backends::rasterizers::reference::ReferenceInput;
use cc4dgs_core::Seed;
use std::array::from_fn;

/// Least distance of two depths, over the depth, that the golden files keep; float32 has their order.
const DEPTH_GAP: f64 = 3e-5;
/// World to camera that moves nothing.
pub const STRAIGHT: [[f64; 4]; 4] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// Gaussians, a camera, and the gradient of a loss.
pub struct Case {
    pub means: Vec<f32>,
    pub scales: Vec<f32>,
    pub quaternions: Vec<f32>,
    pub opacities: Vec<f32>,
    pub colors: Vec<f32>,
    pub sh_rest: Vec<f32>,
    pub background: [f32; 3],
    pub settings: RasterSettings,
    /// Of the planes `[5,H,W]`.
    pub upstream: Vec<f64>,
}

impl Case {
    /// The Gaussians for the reference.
    pub fn input(&self) -> ReferenceInput {
        let [means, scales, quaternions, opacities, colors, sh_rest] =
            [&self.means, &self.scales, &self.quaternions, &self.opacities, &self.colors, &self.sh_rest].map(|v| widen(v));
        ReferenceInput { means, scales, quaternions, opacities, colors, sh_rest, background: self.background.map(f64::from) }
    }
}

/// Random numbers of one case, by name.
pub struct Draw {
    pub node: Seed,
    /// Which case of its kind.
    pub seed: u64,
}

impl Draw {
    /// Uniform in 0..1.
    pub fn numbers(&self, name: &str, len: usize) -> Vec<f64> {
        let child = self.node.child(name);
        (0..len as u64).map(|k| (child.index(k).value() >> 11) as f64 / (1u64 << 53) as f64).collect()
    }
    pub fn between(&self, name: &str, low: f64, high: f64, len: usize) -> Vec<f64> {
        self.numbers(name, len).into_iter().map(|v| low + (high - low) * v).collect()
    }
    /// The sum of twelve uniform numbers, minus six, is nearly standard normal.
    pub fn normal(&self, name: &str, len: usize) -> Vec<f64> {
        self.numbers(name, 12 * len).chunks(12).map(|c| c.iter().sum::<f64>() - 6.0).collect()
    }
    /// Normal with this deviation.
    pub fn spread(&self, name: &str, deviation: f64, len: usize) -> Vec<f64> {
        self.normal(name, len).into_iter().map(|v| deviation * v).collect()
    }
    /// Numbers around a median whose logarithms are normal.
    pub fn log_normal(&self, name: &str, median: f64, deviation: f64, len: usize) -> Vec<f64> {
        self.normal(name, len).into_iter().map(|v| median * (deviation * v).exp()).collect()
    }
    pub fn shuffled(&self, name: &str, values: &[f64]) -> Vec<f64> {
        let keys = self.numbers(name, values.len());
        let mut order: Vec<usize> = (0..values.len()).collect();
        order.sort_by(|&a, &b| keys[a].total_cmp(&keys[b]));
        order.into_iter().map(|i| values[i]).collect()
    }
    /// Degree-0 coefficients of the ordinary golden scenes.
    pub fn colors(&self, len: usize) -> Vec<f64> {
        self.between("colors", -1.6, 1.9, len)
    }
    /// A camera that looks anywhere, the world's origin at `origin`.
    pub fn turned(&self, origin: [f64; 3]) -> [[f64; 4]; 4] {
        let turn = self.normal("camera", 4);
        rigid(from_fn(|k| turn[k]), origin)
    }
}

/// World to camera with a rotation along a quaternion, in numbers that float32 holds.
pub fn rigid(quaternion: [f64; 4], origin: [f64; 3]) -> [[f64; 4]; 4] {
    let [w, x, y, z] = quaternion;
    let unit = (w * w + x * x + y * y + z * z).sqrt();
    let [w, x, y, z] = [w, x, y, z].map(|v| v / unit);
    let rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y), origin[0]],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x), origin[1]],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y), origin[2]],
        [0.0, 0.0, 0.0, 1.0],
    ];
    rows.map(|row| row.map(|v| f64::from(v as f32)))
}

/// Depths that no two rules or precisions order or cut off differently: apart from each other, and away from near planes.
pub fn apart(mut depths: Vec<f64>) -> Vec<f64> {
    for z in &mut depths {
        for near in [0.01, 0.2] {
            if (*z - near).abs() < 1e-3 {
                *z = near + 2e-3;
            }
        }
    }
    let mut order: Vec<usize> = (0..depths.len()).collect();
    order.sort_by(|&a, &b| depths[a].total_cmp(&depths[b]));
    for pair in order.windows(2) {
        let before = depths[pair[0]];
        depths[pair[1]] = depths[pair[1]].max(before + DEPTH_GAP * before.abs().max(0.01));
    }
    depths
}

/// A camera.
pub struct View {
    pub size: [usize; 2],
    pub focal: [f64; 2],
    pub principal: [f64; 2],
    pub world_to_camera: [[f64; 4]; 4],
}

impl View {
    pub fn centered(size: [usize; 2], focal: f64, world_to_camera: [[f64; 4]; 4]) -> Self {
        Self { size, focal: [focal; 2], principal: size.map(|s| s as f64 / 2.0), world_to_camera }
    }
    /// A point in camera axes, in the world.
    pub fn world(&self, point: [f64; 3]) -> [f64; 3] {
        let m = &self.world_to_camera;
        let moved: [f64; 3] = from_fn(|i| point[i] - m[i][3]);
        from_fn(|k| m[0][k] * moved[0] + m[1][k] * moved[1] + m[2][k] * moved[2])
    }
    /// The point in the world at a depth and at these shares of the image's width and height.
    pub fn behind(&self, shares: &[f64], depth: f64) -> [f64; 3] {
        let [x, y]: [f64; 2] = from_fn(|k| (shares[k] * self.size[k] as f64 - self.principal[k]) / self.focal[k] * depth);
        self.world([x, y, depth])
    }
}

/// What a kind chooses.
pub struct Parts {
    pub means: Vec<f64>,
    pub scales: Vec<f64>,
    pub quaternions: Vec<f64>,
    pub opacities: Vec<f64>,
    pub colors: Vec<f64>,
    pub degree: usize,
    /// Deviation of the coefficients beyond degree 0.
    pub harmonics: f64,
    pub background: [f64; 3],
}

impl Parts {
    pub fn case(self, draw: &Draw, view: &View) -> Case {
        let ([width, height], [fx, fy], [cx, cy]) = (view.size, view.focal, view.principal);
        let rest = 3 * ((self.degree + 1) * (self.degree + 1) - 1);
        let mut upstream = draw.normal("upstream", 4 * width * height);
        upstream.resize(5 * width * height, 0.0);
        let camera = settings(width, height, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], view.world_to_camera.as_flattened());
        Case {
            means: narrow(&self.means),
            scales: narrow(&self.scales),
            quaternions: narrow(&self.quaternions),
            opacities: narrow(&self.opacities),
            colors: narrow(&self.colors),
            sh_rest: narrow(&draw.spread("harmonics", self.harmonics, rest * self.opacities.len())),
            background: self.background.map(|v| v as f32),
            settings: RasterSettings { sh_degree: Some(self.degree), ..camera },
            upstream: widen(&narrow(&upstream)),
        }
    }
}
