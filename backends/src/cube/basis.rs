//! Combinations of basis functions on the device.

use super::field::add_segments;
use super::tensor::{THREADS, constant, floats, workgroups_for};
use crate::ops::basis::{BasisBackward, BasisOps, BasisShape, Combinations};
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{DType, FloatDType};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use cubecl::prelude::*;
use std::sync::Arc;

/// Rows over which one thread sums a function's gradient.
const SEGMENT: usize = 128;

/// Words per output in a plan. The following constants are the indices of the words.
const FIELDS: usize = 6;
/// First coefficient of the output in a row.
const COEFFICIENT: usize = 0;
/// First function of the output.
const FUNCTION: usize = 1;
/// Number of functions that the output combines.
const COUNT: usize = 2;
/// Number of outputs of all heads before that of the output.
const BEFORE: usize = 3;
/// Number of outputs of its head.
const OUTPUTS: usize = 4;
/// Index of the output in its head.
const INDEX: usize = 5;

/// The words of every output.
fn plan(shape: &BasisShape) -> Vec<u32> {
    let (mut at, mut function, mut before) = (0, 0, 0);
    let mut words = Vec::new();
    for &(outputs, count) in &shape.groups {
        for index in 0..outputs as u32 {
            let mut fields = [0; FIELDS];
            fields[COEFFICIENT] = at;
            fields[FUNCTION] = function;
            fields[COUNT] = count as u32;
            fields[BEFORE] = before;
            fields[OUTPUTS] = outputs as u32;
            fields[INDEX] = index;
            words.extend(fields);
            at += count as u32;
        }
        function += count as u32;
        before += outputs as u32;
    }
    words
}

/// The index of an output of a row: head after head, each `[rows, outputs]`.
#[cube]
fn output_index(plan: &[u32], output: usize, row: usize, rows: u32) -> usize {
    (plan[FIELDS * output + BEFORE] * rows) as usize + row * plan[FIELDS * output + OUTPUTS] as usize + plan[FIELDS * output + INDEX] as usize
}

/// The index of the first coefficient of an output of a row: head after head, each `[rows, outputs x functions]`.
#[cube]
fn first_coefficient(plan: &[u32], output: usize, row: usize, rows: u32) -> usize {
    let (at, count, within) = (plan[FIELDS * output + COEFFICIENT], plan[FIELDS * output + COUNT], plan[FIELDS * output + INDEX]);
    ((at - within * count) * rows + within * count) as usize + row * (plan[FIELDS * output + OUTPUTS] * count) as usize
}

/// out, head after head. Neighbouring threads read neighbouring coefficients: of one row, or of one column.
#[cube(launch)]
fn combine_outputs(coefficients: &[f32], functions: &[f32], plan: &[u32], out: &mut [f32], rows: u32, width: u32, #[comptime] by_columns: bool) {
    if ABSOLUTE_POS < out.len() {
        let per_run = if by_columns { rows as usize } else { width as usize };
        let (run, within) = (ABSOLUTE_POS / per_run, ABSOLUTE_POS % per_run);
        let row = if by_columns { within } else { run };
        let output = if by_columns { run } else { within };
        let from = if by_columns { plan[FIELDS * output + COEFFICIENT] as usize * rows as usize + row } else { first_coefficient(plan, output, row, rows) };
        let step = if by_columns { rows as usize } else { (1usize).runtime() };
        let own = plan[FIELDS * output + FUNCTION] as usize;
        let mut sum = 0.0f32;
        for k in 0..plan[FIELDS * output + COUNT] as usize {
            sum += coefficients[from + k * step] * functions[own + k];
        }
        out[output_index(plan, output, row, rows)] = sum;
    }
}

/// out, in the order of the coefficients.
#[cube(launch)]
fn spread_gradient(grad: &[f32], functions: &[f32], plan: &[u32], out: &mut [f32], rows: u32, width: u32) {
    if ABSOLUTE_POS < grad.len() {
        let (row, output) = (ABSOLUTE_POS / width as usize, ABSOLUTE_POS % width as usize);
        let from = first_coefficient(plan, output, row, rows);
        let own = plan[FIELDS * output + FUNCTION] as usize;
        let upstream = grad[output_index(plan, output, row, rows)];
        for k in 0..plan[FIELDS * output + COUNT] as usize {
            out[from + k] = upstream * functions[own + k];
        }
    }
}

/// partial `[segments, F]`.
#[cube(launch)]
fn function_parts(coefficients: &[f32], grad: &[f32], plan: &[u32], partial: &mut [f32], rows: u32, width: u32, functions: u32) {
    if ABSOLUTE_POS < partial.len() {
        let (segment, k) = (ABSOLUTE_POS / functions as usize, ABSOLUTE_POS % functions as usize);
        let start = segment * SEGMENT;
        let end = select(start + SEGMENT < rows as usize, start + SEGMENT, rows as usize);
        let mut sum = 0.0f32;
        for row in start..end {
            for output in 0..width as usize {
                let (own, count) = (plan[FIELDS * output + FUNCTION] as usize, plan[FIELDS * output + COUNT] as usize);
                if k >= own && k < own + count {
                    sum += grad[output_index(plan, output, row, rows)] * coefficients[first_coefficient(plan, output, row, rows) + k - own];
                }
            }
        }
        partial[ABSOLUTE_POS] = sum;
    }
}

impl BasisOps for CubeBackend {
    fn coefficients(coefficients: FloatTensor<Self>, _: Arc<Combinations>) -> FloatTensor<Self> {
        coefficients
    }
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, combinations: Arc<Combinations>, _: usize) -> FloatTensor<Self> {
        let shape = combinations.shape();
        let functions = into_contiguous(functions);
        let rows = coefficients.meta.shape()[0];
        let by_columns = coefficients.meta.strides()[..] == [1, rows] && shape.coefficients() > 1;
        let coefficients = if by_columns { coefficients } else { into_contiguous(coefficients) };
        let out = floats(&coefficients, [rows * shape.outputs()]);
        let client = coefficients.client.clone();
        let plan = constant(&coefficients, &plan(shape), DType::U32);
        let (count, dim) = (workgroups_for(rows * shape.outputs()), CubeDim::new_1d(THREADS));
        let (c, f, p, o) = (coefficients.into_buffer_arg(), functions.into_buffer_arg(), plan.into_buffer_arg(), out.clone().into_buffer_arg());
        combine_outputs::launch(&client, count, dim, c, f, p, o, rows as u32, shape.outputs() as u32, by_columns);
        out
    }
}

/// The gradient of the coefficients of one combination.
fn coefficient_gradient(functions: FloatTensor<CubeBackend>, grad: FloatTensor<CubeBackend>, rows: usize, shape: &BasisShape) -> FloatTensor<CubeBackend> {
    let (functions, grad) = (into_contiguous(functions), into_contiguous(grad));
    let client = grad.client.clone();
    let plan = constant(&grad, &plan(shape), DType::U32);
    let out = floats(&grad, [rows, shape.coefficients()]);
    let (count, dim) = (workgroups_for(rows * shape.outputs()), CubeDim::new_1d(THREADS));
    let (g, f, p, o) = (grad.into_buffer_arg(), functions.into_buffer_arg(), plan.into_buffer_arg(), out.clone().into_buffer_arg());
    spread_gradient::launch(&client, count, dim, g, f, p, o, rows as u32, shape.outputs() as u32);
    out
}

impl BasisBackward for CubeBackend {
    fn coefficient_gradient(parts: Vec<(FloatTensor<Self>, FloatTensor<Self>)>, rows: usize, shape: &BasisShape) -> FloatTensor<Self> {
        let gradients = parts.into_iter().map(|(functions, grad)| coefficient_gradient(functions, grad, rows, shape));
        let zeros = || Self::float_zeros([rows, shape.coefficients()].into(), &Default::default(), FloatDType::F32);
        gradients.reduce(Self::float_add).unwrap_or_else(zeros)
    }
    fn function_gradient(coefficients: FloatTensor<Self>, shape: &BasisShape, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let (coefficients, grad) = (into_contiguous(coefficients), into_contiguous(grad));
        let (rows, count) = (coefficients.meta.shape()[0], shape.functions());
        let client = coefficients.client.clone();
        let dim = CubeDim::new_1d(THREADS);
        let plan = constant(&coefficients, &plan(shape), DType::U32);
        let segments = rows.div_ceil(SEGMENT);
        let (partial, out) = (floats(&grad, [segments, count]), floats(&grad, [count]));
        let (c, g) = (coefficients.into_buffer_arg(), grad.into_buffer_arg());
        let (p, parts) = (plan.into_buffer_arg(), partial.clone().into_buffer_arg());
        function_parts::launch(&client, workgroups_for(segments * count), dim, c, g, p, parts, rows as u32, shape.outputs() as u32, count as u32);
        add_segments(partial, &out, count, segments, 0, false);
        out
    }
}
