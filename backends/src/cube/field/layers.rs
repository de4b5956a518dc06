//! Linear layers one at a time, for networks that are too wide for [`super::program`]. Weights lie in one flat buffer, W `[in, out]` row-major and then b
//! `[out]`, at an offset. A thread computes one column of several rows, so that a weight is read once for all of them.

use super::activation::relu_is_zero;
use crate::cube::tensor::{THREADS, floats, workgroups_for};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Rows per thread.
const ROWS: usize = 8;

/// Sizes of a layer and where its weights start.
#[derive(Clone, Copy, Debug)]
pub struct Dense {
    pub input: usize,
    pub output: usize,
    pub at: usize,
}

/// y `[rows, out]` at `y_at`: x W + b, with a ReLU if `relu`.
#[cube(launch)]
fn linear(x: &[f32], weights: &[f32], y: &mut [f32], rows: u32, input: u32, output: u32, at: u32, y_at: u32, #[comptime] relu: bool) {
    let (input, output, at) = (input as usize, output as usize, at as usize);
    let first = ABSOLUTE_POS / output * ROWS;
    let column = ABSOLUTE_POS % output;
    if first < rows as usize {
        let mut sums = Array::<f32>::new(8usize);
        let bias = weights[at + input * output + column];
        #[unroll]
        for r in 0..8usize {
            sums[r] = 0.0f32;
        }
        for i in 0..input {
            let w = weights[at + i * output + column];
            #[unroll]
            for r in 0..8usize {
                // Rows beyond the last repeat it; they are not written.
                let row = select(first + r < rows as usize, first + r, rows as usize - 1);
                sums[r] = fma(x[row * input + i], w, sums[r]);
            }
        }
        #[unroll]
        for r in 0..8usize {
            if first + r < rows as usize {
                let mut value = sums[r] + bias;
                if comptime!(relu) {
                    value = select(relu_is_zero(value), 0.0f32, value);
                }
                y[y_at as usize + (first + r) * output + column] = value;
            }
        }
    }
}

/// dx `[rows, in]` (+)= dy W^T.
#[cube(launch)]
fn linear_backward_input(dy: &[f32], weights: &[f32], dx: &mut [f32], rows: u32, input: u32, output: u32, at: u32, #[comptime] accumulate: bool) {
    let (input, output, at) = (input as usize, output as usize, at as usize);
    let first = ABSOLUTE_POS / input * ROWS;
    let column = ABSOLUTE_POS % input;
    if first < rows as usize {
        let mut sums = Array::<f32>::new(8usize);
        #[unroll]
        for r in 0..8usize {
            sums[r] = 0.0;
        }
        for o in 0..output {
            let w = weights[at + column * output + o];
            #[unroll]
            for r in 0..8usize {
                let row = select(first + r < rows as usize, first + r, rows as usize - 1);
                sums[r] = fma(dy[row * output + o], w, sums[r]);
            }
        }
        #[unroll]
        for r in 0..8usize {
            if first + r < rows as usize {
                let index = (first + r) * input + column;
                if comptime!(accumulate) {
                    dx[index] += sums[r];
                } else {
                    dx[index] = sums[r];
                }
            }
        }
    }
}

/// dy becomes 0 where the output of a ReLU is.
#[cube(launch)]
fn mask_relu(dy: &mut [f32], y: &[f32]) {
    if ABSOLUTE_POS < dy.len() {
        if relu_is_zero(y[ABSOLUTE_POS]) {
            dy[ABSOLUTE_POS] = 0.0;
        }
    }
}

#[cube(launch)]
fn copy_stretch(from: &[f32], to: &mut [f32], from_at: u32, to_at: u32, count: u32) {
    if ABSOLUTE_POS < count as usize {
        to[to_at as usize + ABSOLUTE_POS] = from[from_at as usize + ABSOLUTE_POS];
    }
}

fn dim() -> CubeDim {
    CubeDim::new_1d(THREADS)
}

/// Layer `l` on `x` `[rows, in]` into `y` at `y_at`.
pub fn forward(x: &CubeTensor, weights: &CubeTensor, y: &CubeTensor, rows: usize, l: Dense, y_at: usize, relu: bool) {
    let client = x.client.clone();
    let threads = rows.div_ceil(ROWS) * l.output;
    let (a, w, b) = (x.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), y.clone().into_buffer_arg());
    linear::launch(&client, workgroups_for(threads), dim(), a, w, b, rows as u32, l.input as u32, l.output as u32, l.at as u32, y_at as u32, relu);
}

/// Gradient of the input of layer `l`, written or added to `dx`.
pub fn backward_input(dy: &CubeTensor, weights: &CubeTensor, dx: &CubeTensor, rows: usize, l: Dense, accumulate: bool) {
    let client = dy.client.clone();
    let threads = rows.div_ceil(ROWS) * l.input;
    let (g, w, d) = (dy.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), dx.clone().into_buffer_arg());
    linear_backward_input::launch(&client, workgroups_for(threads), dim(), g, w, d, rows as u32, l.input as u32, l.output as u32, l.at as u32, accumulate);
}

/// Sets dy to zero where the output of a ReLU is zero.
pub fn backward_relu(dy: &CubeTensor, y: &CubeTensor, count: usize) {
    let client = dy.client.clone();
    mask_relu::launch(&client, workgroups_for(count), dim(), dy.clone().into_buffer_arg(), y.clone().into_buffer_arg());
}

/// Copies `count` values of `from` from index `from_at` on to `to` from index `to_at` on.
pub fn copy(from: &CubeTensor, to: &CubeTensor, from_at: usize, to_at: usize, count: usize) {
    let client = from.client.clone();
    let (a, b) = (from.clone().into_buffer_arg(), to.clone().into_buffer_arg());
    copy_stretch::launch(&client, workgroups_for(count), dim(), a, b, from_at as u32, to_at as u32, count as u32);
}

/// The stretch of `from` at `at` as a buffer of its own `[count]`.
pub fn stretch(from: &CubeTensor, at: usize, count: usize) -> CubeTensor {
    let out = floats(from, [count]);
    copy(from, &out, at, 0, count);
    out
}
