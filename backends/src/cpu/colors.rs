//! Affine transforms of colours on the CPU: blocks of pixels, whose sums are added up in order.

use crate::ops::colors::NUMBERS;
use rayon::prelude::*;

/// Pixels per task.
const PIXELS: usize = 8192;

/// Pixels `at..` of the three planes from `planes`, `count` pixels each.
fn rgb(planes: &[f32], pixels: usize, at: usize, count: usize) -> [&[f32]; 3] {
    [0, 1, 2].map(|c| &planes[c * pixels + at..][..count])
}

/// Blocks of the red, green and blue of `out`, with their first pixels; planes behind these three are unchanged.
fn blocks(out: &mut [f32], pixels: usize) -> impl IndexedParallelIterator<Item = (usize, [&mut [f32]; 3])> {
    let (red, rest) = out.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    let blue = &mut blue[..pixels];
    let blocks = red.par_chunks_mut(PIXELS).zip(green.par_chunks_mut(PIXELS)).zip(blue.par_chunks_mut(PIXELS)).enumerate();
    blocks.map(|(block, ((red, green), blue))| (block * PIXELS, [red, green, blue]))
}

/// M rgb + b of every pixel; further planes as they are.
pub fn forward(planes: &[f32], transform: &[f32], pixels: usize) -> Vec<f32> {
    let mut out = planes.to_vec();
    blocks(&mut out, pixels).for_each(|(at, out)| {
        let own = rgb(planes, pixels, at, out[0].len());
        for (c, out) in out.into_iter().enumerate() {
            let [a, b, d, offset] = [transform[3 * c], transform[3 * c + 1], transform[3 * c + 2], transform[9 + c]];
            for (((value, r), g), blue) in out.iter_mut().zip(own[0]).zip(own[1]).zip(own[2]) {
                *value = offset + a * r + b * g + d * blue;
            }
        }
    });
    out
}

/// The gradient of the planes from that of the result.
pub fn planes_gradient(transform: &[f32], grad: &[f32], pixels: usize) -> Vec<f32> {
    let mut out = grad.to_vec();
    blocks(&mut out, pixels).for_each(|(at, out)| {
        let own = rgb(grad, pixels, at, out[0].len());
        for (k, out) in out.into_iter().enumerate() {
            let [a, b, d] = [transform[k], transform[3 + k], transform[6 + k]];
            for (((value, r), g), blue) in out.iter_mut().zip(own[0]).zip(own[1]).zip(own[2]) {
                *value = a * r + b * g + d * blue;
            }
        }
    });
    out
}

/// The gradient of the transform from that of the result.
pub fn transform_gradient(planes: &[f32], grad: &[f32], pixels: usize) -> Vec<f32> {
    let parts: Vec<[f64; NUMBERS]> = (0..pixels.div_ceil(PIXELS))
        .into_par_iter()
        .map(|block| {
            let (at, count) = (block * PIXELS, PIXELS.min(pixels - block * PIXELS));
            let (own, of) = (rgb(planes, pixels, at, count), rgb(grad, pixels, at, count));
            let mut sums = [0.0f64; NUMBERS];
            for (c, of) in of.into_iter().enumerate() {
                for (k, own) in own.into_iter().enumerate() {
                    sums[3 * c + k] = sum(of.iter().zip(own).map(|(g, x)| f64::from(*g) * f64::from(*x)));
                }
                sums[9 + c] = sum(of.iter().map(|g| f64::from(*g)));
            }
            sums
        })
        .collect();
    (0..NUMBERS).map(|k| parts.iter().map(|part| part[k]).sum::<f64>() as f32).collect()
}

/// A sum in eight interleaved parts, so that additions do not wait for each other.
fn sum(mut values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let mut parts = [0.0f64; 8];
    while values.len() > 0 {
        for (part, value) in parts.iter_mut().zip(&mut values) {
            *part += value;
        }
    }
    parts.iter().sum()
}
