//! Linear layers forwards and backwards. Weights lie in one flat buffer, W [in, out] row-major and then b [out], at an offset.
//!
//! A unit computes one column of several rows, so that a weight is read once for all of them. Sums over rows are taken per segment and then over the
//! segments, in order.

use crate::cube::tensor::{UNITS, cubes_for, floats};
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Rows a unit computes.
const ROWS: usize = 8;
/// Parts into which sums over rows are cut.
const SEGMENTS: usize = 32;

/// Sizes of a layer and where its weights start.
#[derive(Clone, Copy, Debug)]
pub struct Dense {
    pub input: usize,
    pub output: usize,
    pub at: usize,
}

/// y [rows, out] at `y_at`: x W + b, below zero cut off if `relu`.
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
            sums[r] = bias;
        }
        for i in 0..input {
            let w = weights[at + i * output + column];
            #[unroll]
            for r in 0..8usize {
                // Rows beyond the last repeat it; they are not written.
                let row = select(first + r < rows as usize, first + r, rows as usize - 1);
                sums[r] += x[row * input + i] * w;
            }
        }
        #[unroll]
        for r in 0..8usize {
            if first + r < rows as usize {
                let mut value = sums[r];
                if comptime!(relu) {
                    value = select(value > 0.0, value, 0.0f32);
                }
                y[y_at as usize + (first + r) * output + column] = value;
            }
        }
    }
}

/// dx [rows, in] (+)= dy W^T.
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
                sums[r] += dy[row * output + o] * w;
            }
        }
        #[unroll]
        for r in 0..8usize {
            if first + r < rows as usize {
                let place = (first + r) * input + column;
                if comptime!(accumulate) {
                    dx[place] += sums[r];
                } else {
                    dx[place] = sums[r];
                }
            }
        }
    }
}

/// Per segment of rows: x^T dy, and below it the sums of dy: partial [segments, (in + 1) out].
#[cube(launch)]
fn weight_gradient_parts(x: &[f32], dy: &[f32], partial: &mut [f32], rows: u32, input: u32, output: u32, segment: u32) {
    let (input, output) = (input as usize, output as usize);
    let width = (input + 1) * output;
    if ABSOLUTE_POS < partial.len() {
        let part = ABSOLUTE_POS / width;
        let i = ABSOLUTE_POS % width / output;
        let o = ABSOLUTE_POS % output;
        let start = part * segment as usize;
        let wanted = start + segment as usize;
        let end = select(wanted < rows as usize, wanted, rows as usize);
        let mut sum = 0.0f32;
        for row in start..end {
            let mut factor = 1.0f32;
            if i < input {
                factor = x[row * input + i];
            }
            sum += factor * dy[row * output + o];
        }
        partial[ABSOLUTE_POS] = sum;
    }
}

/// Sums over rows per segment of dz times the normalised values, then of dz alone: partial [segments, 2 out].
#[cube(launch)]
fn norm_gradient_parts(dz: &[f32], normalized: &[f32], partial: &mut [f32], rows: u32, output: u32, segment: u32) {
    let output = output as usize;
    if ABSOLUTE_POS < partial.len() {
        let part = ABSOLUTE_POS / (2 * output);
        let which = ABSOLUTE_POS % (2 * output) / output;
        let o = ABSOLUTE_POS % output;
        let start = part * segment as usize;
        let wanted = start + segment as usize;
        let end = select(wanted < rows as usize, wanted, rows as usize);
        let mut sum = 0.0f32;
        for row in start..end {
            let mut factor = 1.0f32;
            if which == 0 {
                factor = normalized[row * output + o];
            }
            sum += factor * dz[row * output + o];
        }
        partial[ABSOLUTE_POS] = sum;
    }
}

/// Adds the segments up, into `gradient` at `at`.
#[cube(launch)]
pub fn add_segments(partial: &[f32], gradient: &mut [f32], width: u32, segments: u32, at: u32) {
    if ABSOLUTE_POS < width as usize {
        let mut sum = 0.0f32;
        for segment in 0..segments as usize {
            sum += partial[segment * width as usize + ABSOLUTE_POS];
        }
        gradient[at as usize + ABSOLUTE_POS] = sum;
    }
}

/// dy becomes 0 where the output of a ReLU is.
#[cube(launch)]
fn cut_where_off(dy: &mut [f32], y: &[f32]) {
    if ABSOLUTE_POS < dy.len() && y[ABSOLUTE_POS] <= 0.0 {
        dy[ABSOLUTE_POS] = 0.0;
    }
}

/// Copies a stretch of `from`.
#[cube(launch)]
fn copy_from(from: &[f32], to: &mut [f32], at: u32) {
    if ABSOLUTE_POS < to.len() {
        to[ABSOLUTE_POS] = from[at as usize + ABSOLUTE_POS];
    }
}

fn dim() -> CubeDim {
    CubeDim::new_1d(UNITS)
}

/// Layer `l` on `x` [rows, in] into `y` at `y_at`.
pub fn forward(x: &CubeTensor, weights: &CubeTensor, y: &CubeTensor, rows: usize, l: Dense, y_at: usize, relu: bool) {
    let client = x.client.clone();
    let units = rows.div_ceil(ROWS) * l.output;
    let (a, w, b) = (x.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), y.clone().into_buffer_arg());
    linear::launch(&client, cubes_for(units), dim(), a, w, b, rows as u32, l.input as u32, l.output as u32, l.at as u32, y_at as u32, relu);
}

/// Gradient of the input of layer `l`, written or added to `dx`.
pub fn backward_input(dy: &CubeTensor, weights: &CubeTensor, dx: &CubeTensor, rows: usize, l: Dense, accumulate: bool) {
    let client = dy.client.clone();
    let units = rows.div_ceil(ROWS) * l.input;
    let (g, w, d) = (dy.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), dx.clone().into_buffer_arg());
    linear_backward_input::launch(&client, cubes_for(units), dim(), g, w, d, rows as u32, l.input as u32, l.output as u32, l.at as u32, accumulate);
}

/// Gradient of W and b of layer `l`, into `gradient` where the weights lie.
pub fn backward_weights(x: &CubeTensor, dy: &CubeTensor, gradient: &CubeTensor, rows: usize, l: Dense) {
    let client = x.client.clone();
    let width = (l.input + 1) * l.output;
    let (segments, segment) = segments_of(rows);
    let partial = floats(x, [segments * width]);
    let (a, g, p) = (x.clone().into_buffer_arg(), dy.clone().into_buffer_arg(), partial.clone().into_buffer_arg());
    weight_gradient_parts::launch(&client, cubes_for(segments * width), dim(), a, g, p, rows as u32, l.input as u32, l.output as u32, segment as u32);
    let (p, to) = (partial.into_buffer_arg(), gradient.clone().into_buffer_arg());
    add_segments::launch(&client, cubes_for(width), dim(), p, to, width as u32, segments as u32, l.at as u32);
}

/// Gradient of gain and shift [out] each, which follow the bias, into `gradient` at `at`.
pub fn backward_norm(dz: &CubeTensor, normalized: &CubeTensor, gradient: &CubeTensor, rows: usize, output: usize, at: usize) {
    let client = dz.client.clone();
    let (segments, segment) = segments_of(rows);
    let partial = floats(dz, [segments * 2 * output]);
    let (g, x, p) = (dz.clone().into_buffer_arg(), normalized.clone().into_buffer_arg(), partial.clone().into_buffer_arg());
    norm_gradient_parts::launch(&client, cubes_for(segments * 2 * output), dim(), g, x, p, rows as u32, output as u32, segment as u32);
    let (p, to) = (partial.into_buffer_arg(), gradient.clone().into_buffer_arg());
    add_segments::launch(&client, cubes_for(2 * output), dim(), p, to, 2 * output as u32, segments as u32, at as u32);
}

/// dy where a ReLU let something through.
pub fn backward_relu(dy: &CubeTensor, y: &CubeTensor, count: usize) {
    let client = dy.client.clone();
    cut_where_off::launch(&client, cubes_for(count), dim(), dy.clone().into_buffer_arg(), y.clone().into_buffer_arg());
}

/// The stretch of `from` at `at` as a buffer of its own [count].
pub fn stretch(from: &CubeTensor, at: usize, count: usize) -> CubeTensor {
    let out = floats(from, [count]);
    let client = from.client.clone();
    copy_from::launch(&client, cubes_for(count), dim(), from.clone().into_buffer_arg(), out.clone().into_buffer_arg(), at as u32);
    out
}

/// How many segments, and of how many rows.
fn segments_of(rows: usize) -> (usize, usize) {
    let segment = rows.div_ceil(SEGMENTS).max(1);
    (rows.div_ceil(segment).max(1), segment)
}
