//! Combinations of shared functions on the CPU. A frame reads every coefficient once, so memory sets the pace.

use crate::ops::basis::BasisShape;
use pulp::Arch;
use rayon::prelude::*;
use std::ops::Range;

/// Rows per task.
const ROWS: usize = 256;
/// Partial sums of a dot product; a fixed number, so that every processor adds in one order.
const PARTS: usize = 16;

/// Outputs [M, W] of `coefficients` [M, C].
pub fn combine(shape: &BasisShape, coefficients: &[f32], functions: &[f32]) -> Vec<f32> {
    let (width, columns) = (shape.outputs(), shape.coefficients());
    let mut out = vec![0.0f32; coefficients.len() / columns * width];
    let arch = Arch::new();
    out.par_chunks_mut(ROWS * width).zip(coefficients.par_chunks(ROWS * columns)).for_each(|(out, coefficients)| {
        arch.dispatch(
            #[inline(always)]
            || {
                for (out, row) in out.chunks_exact_mut(width).zip(coefficients.chunks_exact(columns)) {
                    for_each_output(shape, |o, range, own| out[o] = dot(&row[range], &functions[own]));
                }
            },
        );
    });
    out
}

/// Calls with every output, where its coefficients lie, and where its functions do.
#[inline(always)]
fn for_each_output(shape: &BasisShape, mut each: impl FnMut(usize, Range<usize>, Range<usize>)) {
    let (mut output, mut at, mut function) = (0, 0, 0);
    for &(outputs, count) in &shape.groups {
        for _ in 0..outputs {
            each(output, at..at + count, function..function + count);
            output += 1;
            at += count;
        }
        function += count;
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
    let mut width = PARTS;
    while width > 1 {
        width /= 2;
        for k in 0..width {
            parts[k] += parts[k + width];
        }
    }
    parts[0]
}

/// The gradient [M, C] of the coefficients: every output's, times the functions.
pub fn coefficient_gradient(shape: &BasisShape, functions: &[f32], grad: &[f32]) -> Vec<f32> {
    let (width, columns) = (shape.outputs(), shape.coefficients());
    let mut out = vec![0.0f32; grad.len() / width * columns];
    let arch = Arch::new();
    out.par_chunks_mut(ROWS * columns).zip(grad.par_chunks(ROWS * width)).for_each(|(out, grad)| {
        arch.dispatch(
            #[inline(always)]
            || {
                for (row, d) in out.chunks_exact_mut(columns).zip(grad.chunks_exact(width)) {
                    for_each_output(shape, |o, range, own| {
                        for (c, f) in row[range].iter_mut().zip(&functions[own]) {
                            *c = d[o] * f;
                        }
                    });
                }
            },
        );
    });
    out
}

/// The gradient [F] of the functions. Tasks sum over rows of their own; their sums are added in order.
pub fn function_gradient(shape: &BasisShape, coefficients: &[f32], grad: &[f32]) -> Vec<f32> {
    let (width, columns, count) = (shape.outputs(), shape.coefficients(), shape.functions());
    let arch = Arch::new();
    let tasks: Vec<Vec<f32>> = coefficients
        .par_chunks(ROWS * columns)
        .zip(grad.par_chunks(ROWS * width))
        .map(|(coefficients, grad)| {
            let mut sums = vec![0.0f32; count];
            arch.dispatch(
                #[inline(always)]
                || {
                    for (row, d) in coefficients.chunks_exact(columns).zip(grad.chunks_exact(width)) {
                        for_each_output(shape, |o, range, own| {
                            for (s, c) in sums[own].iter_mut().zip(&row[range]) {
                                *s += d[o] * c;
                            }
                        });
                    }
                },
            );
            sums
        })
        .collect();
    let mut out = vec![0.0f64; count];
    for task in tasks {
        out.iter_mut().zip(task).for_each(|(o, s)| *o += f64::from(s));
    }
    out.into_iter().map(|v| v as f32).collect()
}
