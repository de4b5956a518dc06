//! Interpolated lookups in grids of stored features: dense, or hashed where a level has more vertices than rows (Müller et al. 2022).

use crate::ops::lookup::{GridLevel, GridShape, MAX_DIMS, Outside, PRIMES};
use pulp::Arch;
use rayon::prelude::*;

/// Points per task.
const ROWS: usize = 128;
/// Features a backward task adds up: several tasks share a level where it has many.
const FEATURES: usize = 8;

/// Where a point lies on a level: its lower corner and how far it is past it, per axis.
struct Cell {
    low: [u32; MAX_DIMS],
    part: [f32; MAX_DIMS],
}

/// The cell of `x` (in 0..1 per axis), `None` where the grid has nothing.
#[inline(always)]
fn cell(x: &[f32], level: &GridLevel, shape: &GridShape) -> Option<Cell> {
    let mut cell = Cell { low: [0; MAX_DIMS], part: [0.0; MAX_DIMS] };
    for (d, &raw) in x.iter().enumerate() {
        // Comparisons with NaN are false: it is outside, or at the lower face.
        let inside = (0.0..=1.0).contains(&raw);
        if !inside && shape.outside == Outside::Zero {
            return None;
        }
        let clamped = if raw > 0.0 { raw.min(1.0) } else { 0.0 };
        let position = clamped * level.scale[d] + shape.stagger;
        // A dense level ends with its last vertex; a hashed one has a place for every number.
        let last = if shape.clamps { (level.size[d] - 2) as f32 } else { f32::MAX };
        let low = position.floor().min(last);
        let part = position - low;
        cell.low[d] = low as u32;
        cell.part[d] = if shape.smooth { part * part * (3.0 - 2.0 * part) } else { part };
    }
    Some(cell)
}

/// Row and weight of a corner (bit d set: the upper one along axis d).
#[inline(always)]
fn corner(cell: &Cell, corner: usize, level: &GridLevel, dims: usize) -> (usize, f32) {
    let (mut weight, mut hash, mut index, mut stride) = (1.0f32, 0u32, 0u64, 1u64);
    for (d, prime) in PRIMES.into_iter().enumerate().take(dims) {
        let upper = corner >> d & 1;
        weight *= if upper == 1 { cell.part[d] } else { 1.0 - cell.part[d] };
        let at = cell.low[d].wrapping_add(upper as u32);
        hash ^= at.wrapping_mul(prime);
        index += u64::from(at) * stride;
        stride *= u64::from(level.size[d]);
    }
    let row = if level.hashed { u64::from(hash) } else { index } % level.rows as u64;
    (level.first_row + row as usize, weight)
}

/// Features [M, levels * features] of `points` [M, dims].
pub fn forward(shape: &GridShape, table: &[f32], points: &[f32]) -> Vec<f32> {
    let (dims, f) = (shape.dims, shape.features);
    let width = shape.levels.len() * f;
    let mut out = vec![0.0f32; points.len() / dims * width];
    if out.is_empty() {
        return out;
    }
    let arch = Arch::new();
    out.par_chunks_mut(ROWS * width).zip(points.par_chunks(ROWS * dims)).for_each(|(out, points)| {
        arch.dispatch(
            #[inline(always)]
            || {
                // Level by level, so that a task's rows of one table stay near.
                for (l, level) in shape.levels.iter().enumerate() {
                    for (row, x) in out.chunks_exact_mut(width).zip(points.chunks_exact(dims)) {
                        let Some(cell) = cell(x, level, shape) else { continue };
                        let sum = &mut row[l * f..(l + 1) * f];
                        for c in 0..1 << dims {
                            let (at, weight) = corner(&cell, c, level, dims);
                            add_scaled(sum, &table[at * f..(at + 1) * f], weight);
                        }
                    }
                }
            },
        );
    });
    out
}

/// The gradient of the table, given that of the features. A task owns some features of one level and visits the points in order, so that nothing is raced for.
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
    let arch = Arch::new();
    let parts = f.div_ceil(FEATURES);
    if tasks.len() >= rayon::current_num_threads() || parts == 1 {
        tasks.into_par_iter().for_each(|(l, level, own)| {
            arch.dispatch(
                #[inline(always)]
                || scatter(shape, l, level, points, grad, width, 0..f, own, f),
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
                    arch.dispatch(
                        #[inline(always)]
                        || scatter(shape, l, level, points, grad, width, range.clone(), &mut column, stride),
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
fn scatter(
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
    let (dims, f) = (shape.dims, shape.features);
    for (x, d) in points.chunks_exact(dims).zip(grad.chunks_exact(width)) {
        let d = &d[l * f + features.start..l * f + features.end];
        let Some(cell) = cell(x, level, shape) else { continue };
        for c in 0..1 << dims {
            let (at, weight) = corner(&cell, c, level, dims);
            let row = (at - level.first_row) * stride;
            add_scaled(&mut out[row..row + d.len()], d, weight);
        }
    }
}

#[inline(always)]
fn add_scaled(row: &mut [f32], values: &[f32], scale: f32) {
    for (r, v) in row.iter_mut().zip(values) {
        *r += scale * v;
    }
}
