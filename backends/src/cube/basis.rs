//! Combinations of shared functions on the device.

use super::field::add_segments;
use super::tensor::{UNITS, cubes_for, floats, upload};
use crate::ops::basis::{BasisBackward, BasisOps, BasisShape};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use cubecl::prelude::*;
use std::sync::Arc;

/// Rows whose share of the functions' gradient one unit adds up.
const SEGMENT: usize = 128;

/// Numbers per output in a plan.
const FIELDS: usize = 3;

/// Per output, where its coefficients start, where its functions do, and how many they are.
fn plan(shape: &BasisShape) -> Vec<u32> {
    let (mut at, mut function) = (0, 0);
    let mut words = Vec::new();
    for &(outputs, count) in &shape.groups {
        for _ in 0..outputs {
            words.extend([at, function, count as u32]);
            at += count as u32;
        }
        function += count as u32;
    }
    words
}

/// out [M, W].
#[cube(launch)]
fn combine_rows(coefficients: &[f32], functions: &[f32], plan: &[u32], out: &mut [f32], width: u32, columns: u32) {
    if ABSOLUTE_POS < out.len() {
        let (row, output) = (ABSOLUTE_POS / width as usize, ABSOLUTE_POS % width as usize);
        let from = row * columns as usize + plan[FIELDS * output] as usize;
        let own = plan[FIELDS * output + 1] as usize;
        let mut sum = 0.0f32;
        for k in 0..plan[FIELDS * output + 2] as usize {
            sum += coefficients[from + k] * functions[own + k];
        }
        out[ABSOLUTE_POS] = sum;
    }
}

/// out [M, C].
#[cube(launch)]
fn spread_gradient(grad: &[f32], functions: &[f32], plan: &[u32], out: &mut [f32], width: u32, columns: u32) {
    if ABSOLUTE_POS < grad.len() {
        let (row, output) = (ABSOLUTE_POS / width as usize, ABSOLUTE_POS % width as usize);
        let from = row * columns as usize + plan[FIELDS * output] as usize;
        let own = plan[FIELDS * output + 1] as usize;
        for k in 0..plan[FIELDS * output + 2] as usize {
            out[from + k] = grad[ABSOLUTE_POS] * functions[own + k];
        }
    }
}

/// partial [segments, F].
#[cube(launch)]
fn function_parts(coefficients: &[f32], grad: &[f32], plan: &[u32], partial: &mut [f32], rows: u32, width: u32, columns: u32, functions: u32) {
    if ABSOLUTE_POS < partial.len() {
        let (segment, k) = (ABSOLUTE_POS / functions as usize, ABSOLUTE_POS % functions as usize);
        let start = segment * SEGMENT;
        let end = select(start + SEGMENT < rows as usize, start + SEGMENT, rows as usize);
        let mut sum = 0.0f32;
        for row in start..end {
            for output in 0..width as usize {
                let (first, own, count) = (plan[FIELDS * output] as usize, plan[FIELDS * output + 1] as usize, plan[FIELDS * output + 2] as usize);
                if k >= own && k < own + count {
                    sum += grad[row * width as usize + output] * coefficients[row * columns as usize + first + k - own];
                }
            }
        }
        partial[ABSOLUTE_POS] = sum;
    }
}

impl BasisOps for CubeBackend {
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, shape: Arc<BasisShape>) -> FloatTensor<Self> {
        let (coefficients, functions) = (into_contiguous(coefficients), into_contiguous(functions));
        let rows = coefficients.meta.shape()[0];
        let out = floats(&coefficients, [rows, shape.outputs()]);
        let client = coefficients.client.clone();
        let plan = upload(&coefficients, &plan(&shape), DType::U32);
        let (width, columns) = (shape.outputs() as u32, shape.coefficients() as u32);
        let (c, f, p, o) = (coefficients.into_buffer_arg(), functions.into_buffer_arg(), plan.into_buffer_arg(), out.clone().into_buffer_arg());
        combine_rows::launch(&client, cubes_for(rows * shape.outputs()), CubeDim::new_1d(UNITS), c, f, p, o, width, columns);
        out
    }
}

impl BasisBackward for CubeBackend {
    fn combine_backward(
        coefficients: FloatTensor<Self>,
        functions: FloatTensor<Self>,
        shape: &BasisShape,
        grad: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2] {
        let (coefficients, functions, grad) = (into_contiguous(coefficients), into_contiguous(functions), into_contiguous(grad));
        let (rows, count) = (coefficients.meta.shape()[0], functions.meta.shape()[0]);
        let client = coefficients.client.clone();
        let dim = CubeDim::new_1d(UNITS);
        let plan = upload(&coefficients, &plan(shape), DType::U32);
        let (width, columns) = (shape.outputs() as u32, shape.coefficients() as u32);
        let of_coefficients = wanted[0].then(|| {
            let out = floats(&grad, [rows, shape.coefficients()]);
            let (g, f) = (grad.clone().into_buffer_arg(), functions.clone().into_buffer_arg());
            let (p, o) = (plan.clone().into_buffer_arg(), out.clone().into_buffer_arg());
            spread_gradient::launch(&client, cubes_for(rows * shape.outputs()), dim, g, f, p, o, width, columns);
            out
        });
        let of_functions = wanted[1].then(|| {
            let segments = rows.div_ceil(SEGMENT);
            let (partial, out) = (floats(&grad, [segments, count]), floats(&grad, [count]));
            let (c, g) = (coefficients.clone().into_buffer_arg(), grad.clone().into_buffer_arg());
            let (p, parts) = (plan.clone().into_buffer_arg(), partial.clone().into_buffer_arg());
            function_parts::launch(&client, cubes_for(segments * count), dim, c, g, p, parts, rows as u32, width, columns, count as u32);
            add_segments::launch(&client, cubes_for(count), dim, partial.into_buffer_arg(), out.clone().into_buffer_arg(), count as u32, segments as u32, 0);
            out
        });
        [of_coefficients, of_functions]
    }
}
