//! Interpolated lookups in grids of stored features: dense, or hashed where a level has more vertices than rows (Müller et al. 2022).

use crate::cpu::simd::vectorized;
use crate::ops::lookup::{GridLevel, GridShape};
use cc4dgs_fields::lookup::{add_scaled, cell, corner, gather};
use cc4dgs_fields::with_dims;
use rayon::prelude::*;

/// Points per task.
const ROWS: usize = 128;
/// Features a backward task adds up: several tasks share a level where it has many.
const FEATURES: usize = 8;

/// Rows of the table and weights of all corners of `points` `[M, dims]` on one level, each `[M, 2^dims]`; weight 0 outside the grid. For
/// comparisons: the operation stores neither.
pub fn corners(shape: &GridShape, level: &GridLevel, points: &[f32]) -> (Vec<i64>, Vec<f32>) {
    fn of<const D: usize>(shape: &GridShape, level: &GridLevel, points: &[f32]) -> (Vec<i64>, Vec<f32>) {
        let one = |x: &[f32; D]| {
            let cell = cell(x, level, shape);
            let at = |c| cell.as_ref().map_or((0, 0.0), |cell| corner(cell, c, level));
            (0..1 << D).map(at).map(|(row, weight)| ((level.first_row + row) as i64, weight)).collect::<Vec<_>>()
        };
        points.as_chunks::<D>().0.iter().flat_map(one).unzip()
    }
    with_dims!(shape.dims, D => of::<D>(shape, level, points))
}

/// Features `[M, levels * features]` of `points` `[M, dims]`.
pub fn forward(shape: &GridShape, table: &[f32], points: &[f32]) -> Vec<f32> {
    let (dims, f) = (shape.dims, shape.features);
    let width = shape.levels.len() * f;
    let mut out = vec![0.0f32; points.len() / dims * width];
    if out.is_empty() {
        return out;
    }
    out.par_chunks_mut(ROWS * width).zip(points.par_chunks(ROWS * dims)).for_each(|(out, points)| {
        vectorized(
            #[inline(always)]
            || gather(shape, table, points, out),
        );
    });
    out
}

/// The gradient of the table, given that of the features. A task owns some features of one level and visits the points in order, so that no two tasks write the
/// same element.
pub fn backward(shape: &GridShape, points: &[f32], grad: &[f32]) -> Vec<f32> {
    let f = shape.features;
    let width = shape.levels.len() * f;
    let mut out = vec![0.0f32; shape.rows() * f];
    let mut tasks = Vec::new();
    let mut rest = out.as_mut_slice();
    for (l, level) in shape.levels.iter().enumerate() {
        let (own, later) = rest.split_at_mut(level.rows * f);
        tasks.push((l, level, own));
        rest = later;
    }
    let parts = f.div_ceil(FEATURES);
    if tasks.len() >= rayon::current_num_threads() || parts == 1 {
        tasks.into_par_iter().for_each(|(l, level, own)| {
            vectorized(
                #[inline(always)]
                || with_dims!(shape.dims, D => scatter::<D>(shape, l, level, points, grad, width, 0..f, own, f)),
            );
        });
    } else {
        // Few levels of many features (planes): tasks share a level by features, in columns of their own that are put together afterwards.
        for (l, level, own) in tasks {
            let columns: Vec<(usize, Vec<f32>)> = (0..parts)
                .into_par_iter()
                .map(|p| {
                    let range = p * FEATURES..((p + 1) * FEATURES).min(f);
                    let mut column = vec![0.0f32; level.rows * range.len()];
                    let stride = range.len();
                    vectorized(
                        #[inline(always)]
                        || with_dims!(shape.dims, D => scatter::<D>(shape, l, level, points, grad, width, range.clone(), &mut column, stride)),
                    );
                    (range.start, column)
                })
                .collect();
            for (start, column) in columns {
                let stride = column.len() / level.rows;
                for (row, values) in own.chunks_exact_mut(f).zip(column.chunks_exact(stride)) {
                    row[start..start + stride].copy_from_slice(values);
                }
            }
        }
    }
    out
}

#[inline(always)]
fn scatter<const D: usize>(
    shape: &GridShape,
    l: usize,
    level: &GridLevel,
    points: &[f32],
    grad: &[f32],
    width: usize,
    features: std::ops::Range<usize>,
    out: &mut [f32],
    stride: usize,
) {
    let f = shape.features;
    for (x, d) in points.as_chunks::<D>().0.iter().zip(grad.chunks_exact(width)) {
        let d = &d[l * f + features.start..l * f + features.end];
        let Some(cell) = cell(x, level, shape) else { continue };
        for c in 0..1 << D {
            let (at, weight) = corner(&cell, c, level);
            add_scaled(&mut out[at * stride..at * stride + d.len()], d, weight);
        }
    }
}
