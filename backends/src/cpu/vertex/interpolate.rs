//! Trilinear interpolation of vertex features, and its adjoint as a gather in a fixed order.

use crate::cpu::simd::vectorized;
use rayon::prelude::*;

/// Points or vertices per task.
const ROWS: usize = 256;

/// `out` `[M, f]`: each point's weighted sum over the features `[U, f]` of its eight corners.
pub fn forward(features: &[f32], f: usize, corners: &[u32], weights: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0f32; corners.len() / 8 * f];
    if out.is_empty() {
        return out;
    }
    let chunks = out.par_chunks_mut(ROWS * f).zip(corners.par_chunks(8 * ROWS)).zip(weights.par_chunks(8 * ROWS));
    chunks.for_each(|((out, corners), weights)| {
        vectorized(
            #[inline(always)]
            || {
                for ((row, corners), weights) in out.chunks_exact_mut(f).zip(corners.chunks_exact(8)).zip(weights.chunks_exact(8)) {
                    for (&corner, &weight) in corners.iter().zip(weights) {
                        add_scaled(row, &features[corner as usize * f..][..f], weight);
                    }
                }
            },
        );
    });
    out
}

/// The gradient `[U, f]` of the features, given that of the output `[M, f]`: every vertex gathers from its own slots.
pub fn backward(grad: &[f32], f: usize, weights: &[f32], slots: &[u32], starts: &[u32]) -> Vec<f32> {
    let mut out = vec![0.0f32; starts.len().saturating_sub(1) * f];
    if out.is_empty() {
        return out;
    }
    out.par_chunks_mut(ROWS * f).enumerate().for_each(|(task, out)| {
        vectorized(
            #[inline(always)]
            || {
                for (i, row) in out.chunks_exact_mut(f).enumerate() {
                    let vertex = task * ROWS + i;
                    for &slot in &slots[starts[vertex] as usize..starts[vertex + 1] as usize] {
                        add_scaled(row, &grad[slot as usize / 8 * f..][..f], weights[slot as usize]);
                    }
                }
            },
        );
    });
    out
}

#[inline(always)]
fn add_scaled(row: &mut [f32], values: &[f32], scale: f32) {
    for (r, v) in row.iter_mut().zip(values) {
        *r += scale * v;
    }
}
