//! Combinations of basis functions on the CPU. A frame reads every coefficient once, so memory bandwidth is the limit.
//!
//! Outputs are stored head after head, each `[M, outputs]`; so are coefficients and their gradient, each `[M, outputs x functions]`, as networks write them.

use super::heads::row_blocks;
use crate::cpu::simd::vectorized;
use crate::ops::basis::BasisShape;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 256;
/// Partial sums of a dot product; a fixed number, so that every processor adds in one order.
const PARTS: usize = 4;
/// Rows whose sums are in registers at a time.
const LANES: usize = 64;

/// How coefficients `[M, C]` are stored.
pub enum Coefficients<'a> {
    /// Head after head, each row by row.
    Heads(&'a [f32]),
    /// Column by column, as in playback: neighbouring Gaussians fill the lanes of a register, and nothing is added across lanes.
    Columns(&'a [f32]),
}

/// A head: its index, its outputs and functions, its first coefficient and its first function.
struct Head {
    index: usize,
    outputs: usize,
    count: usize,
    column: usize,
    function: usize,
}

impl Head {
    /// Coefficients per row.
    fn width(&self) -> usize {
        self.outputs * self.count
    }
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
                        Coefficients::Heads(values) => by_rows(out[head.index], &values[head.column * rows + first * head.width()..], functions),
                        Coefficients::Columns(values) => by_columns(out[head.index], head, values, (first, rows), functions),
                    }
                }
            },
        );
    });
    out
}

/// Outputs in order and their coefficients in order: one dot product after the other.
#[inline(always)]
fn by_rows(out: &mut [f32], values: &[f32], functions: &[f32]) {
    for (out, own) in out.iter_mut().zip(values.chunks_exact(functions.len())) {
        *out = dot(own, functions);
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

/// The gradient of the coefficients, head after head: the gradient of every output times the functions, summed over `parts` (functions, gradient of outputs).
pub fn coefficient_gradient<'a>(shape: &BasisShape, rows: usize, parts: &[(&'a [f32], &'a [f32])]) -> Vec<f32> {
    let mut out = vec![0.0f32; rows * shape.coefficients()];
    let (mut rest, mut at) = (out.as_mut_slice(), 0);
    for head in heads(shape) {
        let (own, later) = rest.split_at_mut(rows * head.width());
        rest = later;
        let own_part = |(functions, grad): &(&'a [f32], &'a [f32])| (&functions[head.function..][..head.count], &grad[at..at + rows * head.outputs]);
        let parts: Vec<(&[f32], &[f32])> = parts.iter().map(own_part).collect();
        at += rows * head.outputs;
        own.par_chunks_mut(ROWS * head.width()).enumerate().for_each(|(block, out)| {
            let first = block * ROWS * head.outputs;
            vectorized(
                #[inline(always)]
                || {
                    for (k, own) in out.chunks_exact_mut(head.count).enumerate() {
                        for (functions, grad) in &parts {
                            let d = grad[first + k];
                            own.iter_mut().zip(*functions).for_each(|(c, f)| *c += d * f);
                        }
                    }
                },
            );
        });
    }
    out
}

/// The gradient `[F]` of the functions. Tasks sum over rows of their own; their sums are added in order.
pub fn function_gradient(shape: &BasisShape, coefficients: &[f32], grad: &[f32]) -> Vec<f32> {
    let rows = grad.len() / shape.outputs();
    let mut out = Vec::with_capacity(shape.functions());
    let mut at = 0;
    for head in heads(shape) {
        let coefficients = &coefficients[head.column * rows..][..rows * head.width()];
        let grad = &grad[at..at + rows * head.outputs];
        at += grad.len();
        let task = |(coefficients, grad): (&[f32], &[f32])| {
            let mut sums = vec![0.0f32; head.count];
            vectorized(
                #[inline(always)]
                || {
                    for (own, d) in coefficients.chunks_exact(head.count).zip(grad) {
                        sums.iter_mut().zip(own).for_each(|(s, c)| *s += d * c);
                    }
                },
            );
            sums
        };
        let tasks: Vec<Vec<f32>> = coefficients.par_chunks(ROWS * head.width()).zip(grad.par_chunks(ROWS * head.outputs)).map(task).collect();
        let mut total = vec![0.0f64; head.count];
        for task in tasks {
            total.iter_mut().zip(task).for_each(|(t, s)| *t += f64::from(s));
        }
        out.extend(total.into_iter().map(|v| v as f32));
    }
    out
}
