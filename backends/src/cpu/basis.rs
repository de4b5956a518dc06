//! Combinations of shared functions on the CPU. A frame reads every coefficient once, so memory sets the pace.
//!
//! Outputs lie head after head, each [M, outputs].

use super::heads::row_blocks;
use crate::cpu::simd::vectorized;
use crate::ops::basis::BasisShape;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 256;
/// Partial sums of a dot product; a fixed number, so that every processor adds in one order.
const PARTS: usize = 4;
/// Rows whose sums are kept in registers at a time.
const LANES: usize = 64;

/// How coefficients [M, C] lie in memory.
pub enum Coefficients<'a> {
    /// Row by row, as networks write them.
    Rows(&'a [f32]),
    /// Column by column, as playback keeps them: neighbouring Gaussians fill the lanes of a register, and nothing is added across lanes.
    Columns(&'a [f32]),
}

/// A head's place: its number, its outputs and functions, its first coefficient and its first function.
struct Head {
    index: usize,
    outputs: usize,
    count: usize,
    column: usize,
    function: usize,
}

fn heads(shape: &BasisShape) -> Vec<Head> {
    let (mut column, mut function) = (0, 0);
    let head = |(index, &(outputs, count)): (usize, &(usize, usize))| {
        let head = Head { index, outputs, count, column, function };
        column += outputs * count;
        function += count;
        head
    };
    shape.groups.iter().enumerate().map(head).collect()
}

/// The outputs of `rows` Gaussians.
pub fn combine(shape: &BasisShape, rows: usize, coefficients: &Coefficients, functions: &[f32]) -> Vec<f32> {
    let (heads, widths) = (heads(shape), shape.widths());
    let mut out = vec![0.0f32; rows * shape.outputs()];
    row_blocks(&mut out, &widths, rows, ROWS).into_par_iter().enumerate().for_each(|(block, mut out)| {
        let first = block * ROWS;
        vectorized(
            #[inline(always)]
            || {
                for head in &heads {
                    let functions = &functions[head.function..][..head.count];
                    match coefficients {
                        Coefficients::Rows(values) => by_rows(out[head.index], head, &values[first * shape.coefficients()..], shape.coefficients(), functions),
                        Coefficients::Columns(values) => by_columns(out[head.index], head, values, (first, rows), functions),
                    }
                }
            },
        );
    });
    out
}

#[inline(always)]
fn by_rows(out: &mut [f32], head: &Head, values: &[f32], columns: usize, functions: &[f32]) {
    for (out, row) in out.chunks_exact_mut(head.outputs).zip(values.chunks_exact(columns)) {
        for (out, own) in out.iter_mut().zip(row[head.column..].chunks_exact(head.count)) {
            *out = dot(own, functions);
        }
    }
}

#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut parts = [0.0f32; PARTS];
    let (a_blocks, a_rest) = a.as_chunks::<PARTS>();
    let (b_blocks, b_rest) = b.as_chunks::<PARTS>();
    for (x, y) in a_blocks.iter().zip(b_blocks) {
        for k in 0..PARTS {
            parts[k] += x[k] * y[k];
        }
    }
    for (k, (x, y)) in a_rest.iter().zip(b_rest).enumerate() {
        parts[k] += x * y;
    }
    (parts[0] + parts[2]) + (parts[1] + parts[3])
}

#[inline(always)]
fn by_columns(out: &mut [f32], head: &Head, values: &[f32], (first, rows): (usize, usize), functions: &[f32]) {
    for (part, out) in out.chunks_mut(LANES * head.outputs).enumerate() {
        let (from, count) = (first + part * LANES, out.len() / head.outputs);
        for o in 0..head.outputs {
            let columns = values[(head.column + o * head.count) * rows..].chunks_exact(rows);
            let mut sums = [0.0f32; LANES];
            for (column, phi) in columns.zip(functions) {
                let column = &column[from..from + count];
                match column.first_chunk::<LANES>() {
                    Some(column) => {
                        for lane in 0..LANES {
                            sums[lane] += column[lane] * phi;
                        }
                    }
                    None => sums.iter_mut().zip(column).for_each(|(sum, c)| *sum += c * phi),
                }
            }
            out.iter_mut().skip(o).step_by(head.outputs).zip(&sums).for_each(|(out, sum)| *out = *sum);
        }
    }
}

/// The gradient [M, C], row by row, of the coefficients: every output's, times the functions.
pub fn coefficient_gradient(shape: &BasisShape, functions: &[f32], grad: &[f32]) -> Vec<f32> {
    let (heads, columns) = (heads(shape), shape.coefficients());
    let rows = grad.len() / shape.outputs();
    let mut out = vec![0.0f32; rows * columns];
    out.par_chunks_mut(ROWS * columns).enumerate().for_each(|(block, out)| {
        vectorized(
            #[inline(always)]
            || {
                let mut at = 0;
                for head in &heads {
                    let grad = &grad[at + block * ROWS * head.outputs..];
                    let functions = &functions[head.function..][..head.count];
                    for (row, d) in out.chunks_exact_mut(columns).zip(grad.chunks_exact(head.outputs)) {
                        for (own, d) in row[head.column..].chunks_exact_mut(head.count).zip(d) {
                            own.iter_mut().zip(functions).for_each(|(c, f)| *c = d * f);
                        }
                    }
                    at += rows * head.outputs;
                }
            },
        );
    });
    out
}

/// The gradient [F] of the functions, from coefficients row by row. Tasks sum over rows of their own; their sums are added in order.
pub fn function_gradient(shape: &BasisShape, coefficients: &[f32], grad: &[f32]) -> Vec<f32> {
    let (heads, columns) = (heads(shape), shape.coefficients());
    let rows = grad.len() / shape.outputs();
    let tasks: Vec<Vec<f32>> = coefficients
        .par_chunks(ROWS * columns)
        .enumerate()
        .map(|(block, coefficients)| {
            let mut sums = vec![0.0f32; shape.functions()];
            vectorized(
                #[inline(always)]
                || {
                    let mut at = 0;
                    for head in &heads {
                        let grad = &grad[at + block * ROWS * head.outputs..];
                        let sums = &mut sums[head.function..][..head.count];
                        for (row, d) in coefficients.chunks_exact(columns).zip(grad.chunks_exact(head.outputs)) {
                            for (own, d) in row[head.column..].chunks_exact(head.count).zip(d) {
                                sums.iter_mut().zip(own).for_each(|(s, c)| *s += d * c);
                            }
                        }
                        at += rows * head.outputs;
                    }
                },
            );
            sums
        })
        .collect();
    let mut out = vec![0.0f64; shape.functions()];
    for task in tasks {
        out.iter_mut().zip(task).for_each(|(o, s)| *o += f64::from(s));
    }
    out.into_iter().map(|v| v as f32).collect()
}
