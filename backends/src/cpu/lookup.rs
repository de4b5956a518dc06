//! Interpolated lookups in grids of stored features: dense, or hashed where a level has more vertices than rows (Müller et al. 2022).

use crate::cpu::simd::vectorized;
use crate::ops::lookup::{GridLevel, GridShape, Outside, PRIMES};
use rayon::prelude::*;

/// Points per task.
const ROWS: usize = 128;
/// Features a backward task adds up: several tasks share a level where it has many.
const FEATURES: usize = 8;

/// The cell of a point on a level of `D` axes: per axis, the contributions of its lower and upper vertex in weight, hash and index.
struct Cell<const D: usize> {
    weight: [[f32; 2]; D],
    hash: [[u32; 2]; D],
    index: [[u32; 2]; D],
}

/// The cell of `x` (in 0..1 per axis), `None` outside the grid.
#[inline(always)]
fn cell<const D: usize>(x: &[f32; D], level: &GridLevel, shape: &GridShape) -> Option<Cell<D>> {
    let mut cell = Cell { weight: [[0.0; 2]; D], hash: [[0; 2]; D], index: [[0; 2]; D] };
    let mut stride = 1u32;
    for d in 0..D {
        let raw = x[d];
        // Comparisons with NaN are false: it is outside, or at the lower face.
        if shape.outside == Outside::Zero && !(0.0..=1.0).contains(&raw) {
            return None;
        }
        let clamped = if raw > 0.0 { raw.min(1.0) } else { 0.0 };
        let position = clamped * level.scale[d] + shape.stagger;
        // A dense level ends with its last vertex; a hashed one has a row for every index.
        let low = if shape.clamps { position.floor().min((level.size[d] - 2) as f32) } else { position.floor() };
        let part = position - low;
        let part = if shape.smooth { part * part * (3.0 - 2.0 * part) } else { part };
        let vertex = low as u32;
        cell.weight[d] = [1.0 - part, part];
        // Products and sums wrap; the index does so on hashed levels only, which do not use it.
        cell.hash[d] = [vertex.wrapping_mul(PRIMES[d]), (vertex + 1).wrapping_mul(PRIMES[d])];
        cell.index[d] = [vertex.wrapping_mul(stride), (vertex + 1).wrapping_mul(stride)];
        stride = stride.wrapping_mul(level.size[d]);
    }
    Some(cell)
}

/// Row (within the level) and weight of a corner (bit d set: the upper one along axis d).
#[inline(always)]
fn corner<const D: usize>(cell: &Cell<D>, corner: usize, level: &GridLevel) -> (usize, f32) {
    let (mut weight, mut hash, mut index) = (1.0f32, 0u32, 0u32);
    for d in 0..D {
        let upper = corner >> d & 1;
        weight *= cell.weight[d][upper];
        hash ^= cell.hash[d][upper];
        index = index.wrapping_add(cell.index[d][upper]);
    }
    let (raw, rows) = (if level.hashed { hash } else { index }, level.rows as u32);
    // A division per corner would cost more than the lookup.
    let row = if raw < rows {
        raw
    } else if rows.is_power_of_two() {
        raw & (rows - 1)
    } else {
        raw % rows
    };
    (row as usize, weight)
}

/// Runs `$body` with `$d` the number of axes as a constant.
macro_rules! with_dims {
    ($dims:expr, $d:ident => $body:expr) => {
        match $dims {
            1 => {
                const $d: usize = 1;
                $body
            }
            2 => {
                const $d: usize = 2;
                $body
            }
            3 => {
                const $d: usize = 3;
                $body
            }
            _ => {
                const $d: usize = 4;
                $body
            }
        }
    };
}

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
            || with_dims!(dims, D => gather::<D>(shape, table, points, width, out)),
        );
    });
    out
}

#[inline(always)]
fn gather<const D: usize>(shape: &GridShape, table: &[f32], points: &[f32], width: usize, out: &mut [f32]) {
    let f = shape.features;
    // Level by level, so that a task's rows of one table stay near.
    for (l, level) in shape.levels.iter().enumerate() {
        let own = &table[level.first_row * f..(level.first_row + level.rows) * f];
        for (row, x) in out.chunks_exact_mut(width).zip(points.as_chunks::<D>().0) {
            let Some(cell) = cell(x, level, shape) else { continue };
            let sum = &mut row[l * f..(l + 1) * f];
            for c in 0..1 << D {
                let (at, weight) = corner(&cell, c, level);
                add_scaled(sum, &own[at * f..(at + 1) * f], weight);
            }
        }
    }
}

/// The gradient of the table, given that of the features. A task owns some features of one level and visits the points in order, so that no two tasks write the same element.
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

#[inline(always)]
fn add_scaled(row: &mut [f32], values: &[f32], scale: f32) {
    for (r, v) in row.iter_mut().zip(values) {
        *r += scale * v;
    }
}
