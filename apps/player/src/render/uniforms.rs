//! The uniforms of a frame.

use super::View;
use super::pipelines::Pipelines;
use crate::scene::Scene;
use bytemuck::{Pod, Zeroable};
use cc4dgs_format::{Camera, blur_at};

/// Beyond this depth nothing is drawn.
const FAR: f32 = 1e10;
/// Least ratio of farthest to nearest depth of the keys.
const LEAST_RANGE: f32 = 1.01;
/// Largest value of a depth key.
const LAST_KEY: f32 = 65535.0;

/// `Frame` of `shaders/frame.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Zeroable, Pod)]
pub(crate) struct Frame {
    world_to_camera: [[f32; 4]; 3],
    center: [f32; 4],
    intrinsics: [f32; 4],
    ratio_limits: [f32; 4],
    size: [f32; 4],
    depth: [f32; 4],
    background: [f32; 4],
    counts: [u32; 4],
    flags: [u32; 4],
    heads: [[u32; 4]; 5],
}

impl Frame {
    /// The frame of `view`; `heads` are what [`functions`] returned.
    pub(crate) fn new(scene: &Scene, view: &View, background: [f32; 3], heads: [[u32; 4]; 5]) -> Self {
        let camera = &view.camera;
        let m = &camera.world_to_camera;
        let center = camera.center_world();
        let size = [f64::from(camera.width), f64::from(camera.height)];
        // 0.15 of the image beyond each border.
        let limits = |k: usize, focal: f64, principal: f64| {
            let margin = 0.15 * size[k] / focal;
            [(-(principal / focal + margin)) as f32, ((size[k] - principal) / focal + margin) as f32]
        };
        let ([x0, x1], [y0, y1]) = (limits(0, camera.fx, camera.cx), limits(1, camera.fy, camera.cy));
        let (near, far) = depth_range(scene, camera);
        let per_ln = LAST_KEY / (far / near).ln();
        Self {
            world_to_camera: std::array::from_fn(|i| std::array::from_fn(|j| m[i][j] as f32)),
            center: [center[0] as f32, center[1] as f32, center[2] as f32, blur_at(f64::from(scene.blur), scene.focal, camera.fx, camera.fy) as f32],
            intrinsics: [camera.fx as f32, camera.fy as f32, camera.cx as f32, camera.cy as f32],
            ratio_limits: [x0, x1, y0, y1],
            size: [size[0] as f32, size[1] as f32, scene.near, FAR],
            depth: [near.ln(), per_ln, view.scale, scene.alpha_max],
            background: [background[0], background[1], background[2], 1.0],
            counts: [scene.count as u32, scene.moving as u32, scene.harmonics_words() as u32, view.sh_degree.min(scene.drawn_degree) as u32],
            flags: [u32::from(scene.antialiased), u32::from(view.mode == super::Mode::Depth), u32::from(view.tint), u32::from(scene.square)],
            heads,
        }
    }
}

/// The nearest and farthest depth that `camera` can see of the box of all centres at all times.
fn depth_range(scene: &Scene, camera: &Camera) -> (f32, f32) {
    let row = camera.world_to_camera[2];
    let corner = |i: usize| (0..3).map(|k| row[k] * f64::from(scene.reach[(i >> k) & 1][k])).sum::<f64>() + row[3];
    let (low, high) = (0..8).map(corner).fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
    let near = (low as f32).clamp(scene.near, 0.5 * FAR);
    (near, (high as f32).min(FAR).max(near * LEAST_RANGE))
}

/// φ of every head at `time`, one after the other, and per head: first start, first coefficient, first function, and its width (0: it does not change).
pub(crate) fn functions(scene: &Scene, time: f32) -> (Vec<f32>, [[u32; 4]; 5]) {
    let (mut out, mut heads) = (Vec::new(), [[0u32; 4]; 5]);
    let Some(layer) = &scene.layer else { return (out, heads) };
    let at = layer.weights_at(time);
    let segment = &layer.segments[at.segment];
    let used = scene.tracks[at.segment].iter().enumerate().filter_map(|(head, index)| Some((head, (*index)?)));
    for ((head, (starts, coefficients)), track) in used.zip(&segment.tracks) {
        heads[head] = [starts, coefficients, out.len() as u32, track.head.width(scene.sh_degree) as u32];
        out.extend(track.functions_at(&at));
    }
    (out, heads)
}

/// Uniforms of an image without a scene.
pub(super) fn write_empty(queue: &wgpu::Queue, pipelines: &Pipelines, background: [f32; 3]) {
    let frame = Frame { background: [background[0], background[1], background[2], 1.0], ..Frame::zeroed() };
    queue.write_buffer(&pipelines.frame, 0, bytemuck::bytes_of(&frame));
}
