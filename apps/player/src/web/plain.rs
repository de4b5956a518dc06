//! A scene in memory, for drawing with WebGL2: its arrays, the uniforms of a frame, and the order of blending.

use crate::content::{GAUSSIAN_FLOATS, Scene};
use crate::render::{Frame, View, functions};
use cc4dgs_format::playback::Head;

/// Keys of the counting sort.
const KEYS: usize = 1 << 16;

/// The uniforms of `view`, as bytes.
pub(super) fn frame(scene: &Scene, view: &View) -> Vec<u8> {
    let (_, heads) = functions(scene, view.time);
    bytemuck::bytes_of(&Frame::new(scene, view, view.background.unwrap_or(scene.background), heads)).to_vec()
}

/// Indices of the Gaussians before the camera, farthest first.
pub(super) fn order(scene: &Scene, view: &View) -> Vec<u32> {
    let row = view.camera.world_to_camera[2].map(|v| v as f32);
    let (values, heads) = functions(scene, view.time);
    let [starts, coefficients, function, width] = heads[Head::Means as usize].map(|v| v as usize);
    let depth = |i: usize, mean: &[f32]| -> f32 {
        let mut sum = row[0] * mean[0] + row[1] * mean[1] + row[2] * mean[2] + row[3];
        if width > 0 && i < scene.moving {
            let (first, end) = (scene.starts[starts + i] as usize, scene.starts[starts + i + 1] as usize);
            for (k, c) in scene.coefficients[coefficients + 3 * first..coefficients + 3 * end].chunks_exact(3).enumerate() {
                sum += values[function + k] * (row[0] * c[0] + row[1] * c[1] + row[2] * c[2]);
            }
        }
        sum
    };
    let depths: Vec<f32> = scene.gaussians.chunks_exact(GAUSSIAN_FLOATS).enumerate().map(|(i, g)| depth(i, g)).collect();
    let seen = || depths.iter().copied().filter(|z| *z > scene.near && z.is_finite());
    let (low, high) = seen().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
    let per_ln = (KEYS - 1) as f32 / (high / low).ln().max(1e-6);
    // Farthest first, and of equal keys the later Gaussian first, as on the GPU.
    let key = |z: f32| KEYS - 1 - (((z / low).ln() * per_ln) as usize).min(KEYS - 1);
    let mut next = vec![0u32; KEYS + 1];
    seen().for_each(|z| next[key(z) + 1] += 1);
    for k in 0..KEYS {
        next[k + 1] += next[k];
    }
    let mut out = vec![0u32; next[KEYS] as usize];
    for (i, &z) in depths.iter().enumerate().rev() {
        if z > scene.near && z.is_finite() {
            let at = &mut next[key(z)];
            out[*at as usize] = i as u32;
            *at += 1;
        }
    }
    out
}
