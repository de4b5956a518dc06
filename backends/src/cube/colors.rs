//! Affine transforms of colours on a GPU: one thread per pixel, and sums by segments of pixels.

use super::field::add_segments;
use super::tensor::{THREADS, floats, spread, workgroups_for};
use crate::ops::colors::{ColorBackward, ColorOps, NUMBERS};
use burn::backend::tensor::FloatTensor;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Pixels per thread, and threads per workgroup, of the kernels that sum over pixels.
const PER_THREAD: usize = 8;
const SUMMING: usize = 64;

/// M rgb + b per pixel, or M transposed times the gradient of it; other planes are copied.
#[cube(launch)]
fn transform_colors(planes: &[f32], transform: &[f32], out: &mut [f32], pixels: u32, #[comptime] backwards: bool) {
    let pixels = pixels as usize;
    let index = ABSOLUTE_POS;
    if index < out.len() {
        let (c, pixel) = (index / pixels, index % pixels);
        let mut value = planes[index];
        if c < 3 {
            value = 0.0f32;
            if comptime!(!backwards) {
                value = transform[9 + c];
            }
            #[unroll]
            for k in 0..3usize {
                let mut factor = transform[3 * c + k];
                if comptime!(backwards) {
                    factor = transform[3 * k + c];
                }
                value = fma(factor, planes[k * pixels + pixel], value);
            }
        }
        out[index] = value;
    }
}

/// Per workgroup: the sums of gradients times colours, then of gradients: partial `[workgroups, 12]`.
#[cube(launch)]
fn transform_parts(planes: &[f32], grad: &[f32], partial: &mut [f32], pixels: u32, segments: u32) {
    let mut shared = Shared::<[f32]>::new_slice(comptime!(NUMBERS * SUMMING));
    let pixels = pixels as usize;
    let (segment, thread) = (CUBE_POS, UNIT_POS as usize);
    let mut sums = Array::<f32>::new(NUMBERS);
    #[unroll]
    for k in 0..NUMBERS {
        sums[k] = 0.0f32;
    }
    for step in 0..PER_THREAD {
        let pixel = segment * comptime!(SUMMING * PER_THREAD) + step * SUMMING + thread;
        if pixel < pixels {
            #[unroll]
            for c in 0..3usize {
                let own = grad[c * pixels + pixel];
                sums[9 + c] += own;
                #[unroll]
                for k in 0..3usize {
                    sums[3 * c + k] = fma(own, planes[k * pixels + pixel], sums[3 * c + k]);
                }
            }
        }
    }
    #[unroll]
    for k in 0..NUMBERS {
        shared[k * SUMMING + thread] = sums[k];
    }
    sync_cube();
    if thread < NUMBERS && segment < segments as usize {
        let mut total = 0.0f32;
        for other in 0..SUMMING {
            total += shared[thread * SUMMING + other];
        }
        partial[segment * NUMBERS + thread] = total;
    }
}

/// [`transform_colors`] for planes or their gradient `[C,H,W]`.
fn transformed(planes: CubeTensor, transform: CubeTensor, backwards: bool) -> CubeTensor {
    let (planes, transform) = (into_contiguous(planes), into_contiguous(transform));
    let shape = planes.meta.shape().clone();
    let (count, pixels) = (shape.num_elements(), shape[1] * shape[2]);
    let out = floats(&planes, shape);
    let client = planes.client.clone();
    let (p, t, o) = (planes.into_buffer_arg(), transform.into_buffer_arg(), out.clone().into_buffer_arg());
    transform_colors::launch(&client, workgroups_for(count), CubeDim::new_1d(THREADS), p, t, o, pixels as u32, backwards);
    out
}

impl ColorOps for CubeBackend {
    fn colors(planes: FloatTensor<Self>, transform: FloatTensor<Self>) -> FloatTensor<Self> {
        transformed(planes, transform, false)
    }
}

impl ColorBackward for CubeBackend {
    fn planes_gradient(transform: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        transformed(grad, transform, true)
    }
    fn transform_gradient(planes: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let (planes, grad) = (into_contiguous(planes), into_contiguous(grad));
        let pixels = grad.meta.shape()[1] * grad.meta.shape()[2];
        let segments = pixels.div_ceil(SUMMING * PER_THREAD);
        let (partial, out) = (floats(&grad, [segments, NUMBERS]), floats(&grad, [NUMBERS]));
        let client = grad.client.clone();
        let (p, g, parts) = (planes.into_buffer_arg(), grad.into_buffer_arg(), partial.clone().into_buffer_arg());
        transform_parts::launch(&client, spread(segments), CubeDim::new_1d(SUMMING as u32), p, g, parts, pixels as u32, segments as u32);
        add_segments(partial, &out, NUMBERS, segments, 0, false);
        out
    }
}
