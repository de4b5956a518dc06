//! Interpolated lookups in grids of stored features; the arithmetic of `cpu::lookup`.

use super::sort::sort_pairs;
use super::tensor::{THREADS, constant, empty, floats, spread, workgroups_for};
use crate::ops::lookup::{GridShape, LookupBackward, LookupOps, MAX_DIMS, Outside, PRIMES};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use std::sync::Arc;

/// Words per level.
const WORDS: usize = 11;
/// First of four words: vertices per axis.
const SIZE: usize = 0;
/// First of four words: bits of the scale per axis.
const SCALE: usize = 4;
/// First row of the table.
const FIRST_ROW: usize = 8;
/// Rows of the table.
const ROWS: usize = 9;
/// 1 where vertices share rows by their hash, else 0.
const HASHED: usize = 10;

fn words(shape: &GridShape) -> Vec<u32> {
    let level = |l: &crate::ops::lookup::GridLevel| {
        let mut words = [0; WORDS];
        words[SIZE..SIZE + MAX_DIMS].copy_from_slice(&l.size);
        words[SCALE..SCALE + MAX_DIMS].copy_from_slice(&l.scale.map(f32::to_bits));
        words[FIRST_ROW] = l.first_row as u32;
        words[ROWS] = l.rows as u32;
        words[HASHED] = u32::from(l.hashed);
        words
    };
    shape.levels.iter().flat_map(level).collect()
}

/// Properties of a grid that are compile-time constants of its kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct Rules {
    dims: usize,
    staggered: bool,
    smooth: bool,
    clamps: bool,
    zero_outside: bool,
}

impl Rules {
    fn of(shape: &GridShape) -> Self {
        Self { dims: shape.dims, staggered: shape.stagger != 0.0, smooth: shape.smooth, clamps: shape.clamps, zero_outside: shape.outside == Outside::Zero }
    }
}

/// Lower vertex of a coordinate on an axis of a level, and how far it is past it.
#[cube]
fn along(raw: f32, size: u32, scale: f32, #[comptime] rules: Rules) -> (u32, f32) {
    let low = select(raw > 0.0, raw, 0.0f32);
    let mut position = select(low < 1.0, low, 1.0f32) * scale;
    if comptime!(rules.staggered) {
        position += 0.5;
    }
    let mut floor = position.floor();
    if comptime!(rules.clamps) {
        let last = (size - 2) as f32;
        floor = select(floor < last, floor, last);
    }
    let mut part = position - floor;
    if comptime!(rules.smooth) {
        part = part * part * (3.0 - 2.0 * part);
    }
    (floor as u32, part)
}

/// Row and weight of a corner of the cell of a point on a level; weight 0 outside the grid.
#[cube]
fn corner(points: &[f32], levels: &[u32], point: usize, level: usize, corner: u32, #[comptime] rules: Rules) -> (u32, f32) {
    let at = level * WORDS;
    let mut weight = 1.0f32;
    let mut hash = 0u32;
    let mut index = 0u32;
    let mut stride = 1u32;
    #[unroll]
    for d in 0..comptime!(rules.dims) {
        let raw = points[point * rules.dims + d];
        let size = levels[at + SIZE + d];
        let (low, part) = along(raw, size, f32::reinterpret(levels[at + SCALE + d]), rules);
        if comptime!(rules.zero_outside) {
            // False for NaN, too.
            weight = select(raw >= 0.0 && raw <= 1.0, weight, 0.0f32);
        }
        let upper = (corner >> comptime!(d as u32)) & 1u32;
        weight *= select(upper == 1, part, 1.0 - part);
        let vertex = low + upper;
        hash ^= vertex * comptime!(PRIMES[d]);
        index += vertex * stride;
        stride *= size;
    }
    let row = select(levels[at + HASHED] == 1, hash, index) % levels[at + ROWS];
    (levels[at + FIRST_ROW] + row, weight)
}

/// out `[M, levels * features]`, a thread per number.
#[cube(launch)]
fn look_up(table: &[f32], points: &[f32], levels: &[u32], out: &mut [f32], features: u32, level_count: u32, #[comptime] rules: Rules) {
    if ABSOLUTE_POS < out.len() {
        let f = features as usize;
        let width = level_count as usize * f;
        let (point, column) = (ABSOLUTE_POS / width, ABSOLUTE_POS % width);
        let mut sum = 0.0f32;
        for c in 0..comptime!(1u32 << rules.dims) {
            let (row, weight) = corner(points, levels, point, column / f, c, rules);
            sum += weight * table[row as usize * f + column % f];
        }
        out[ABSOLUTE_POS] = sum;
    }
}

/// The row of every (point, level, corner) slot.
#[cube(launch)]
fn rows_of_slots(points: &[f32], levels: &[u32], rows: &mut [u32], slots: &mut [u32], level_count: u32, #[comptime] rules: Rules) {
    if ABSOLUTE_POS < rows.len() {
        let corners = comptime!(1usize << rules.dims);
        let cell = ABSOLUTE_POS / corners;
        let (row, _) = corner(points, levels, cell / level_count as usize, cell % level_count as usize, (ABSOLUTE_POS % corners) as u32, rules);
        rows[ABSOLUTE_POS] = row;
        slots[ABSOLUTE_POS] = ABSOLUTE_POS as u32;
    }
}

/// starts`[row]`: the first of the sorted slots that are of this row or a later one. This is one search per row; in [`gather`] every slice of every number
/// would need one.
#[cube(launch)]
fn first_slots(sorted: &[u32], starts: &mut [u32]) {
    if ABSOLUTE_POS < starts.len() {
        let row = ABSOLUTE_POS as u32;
        let mut low = 0usize.runtime();
        let mut high = sorted.len();
        while low < high {
            let middle = (low + high) / 2;
            if sorted[middle] < row {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        starts[ABSOLUTE_POS] = low as u32;
    }
}

/// Slices of the slots of a row: rows of coarse levels have thousands.
const SLICES: usize = 16;
/// Numbers of the table that a workgroup computes.
const NUMBERS: usize = THREADS as usize / SLICES;

/// Gradient of the table: each row visits its slots in order, from its entry of `starts` to that of the next row, in slices that are added up in order.
#[cube(launch)]
fn gather(
    starts: &[u32],
    slots: &[u32],
    points: &[f32],
    levels: &[u32],
    grad: &[f32],
    out: &mut [f32],
    features: u32,
    level_count: u32,
    #[comptime] rules: Rules,
) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let thread = UNIT_POS as usize;
    let (slice, item) = (thread / NUMBERS, CUBE_POS * NUMBERS + thread % NUMBERS);
    let mut sum = 0.0f32;
    if item < out.len() {
        let (f, count) = (features as usize, level_count as usize);
        let (row, feature) = (item / f, item % f);
        let corners = comptime!(1usize << rules.dims);
        let mut index = starts[row] as usize + slice;
        let mut end = slots.len();
        if row + 1 < starts.len() {
            end = starts[row + 1] as usize;
        }
        while index < end {
            let slot = slots[index] as usize;
            let cell = slot / corners;
            let (_, weight) = corner(points, levels, cell / count, cell % count, (slot % corners) as u32, rules);
            sum += weight * grad[cell * f + feature];
            index += SLICES;
        }
    }
    sums[thread] = sum;
    sync_cube();
    if slice == 0 && item < out.len() {
        let mut total = 0.0f32;
        #[unroll]
        for k in 0..SLICES {
            total += sums[k * NUMBERS + thread];
        }
        out[item] = total;
    }
}

impl LookupOps for CubeBackend {
    fn lookup(table: FloatTensor<Self>, points: FloatTensor<Self>, shape: Arc<GridShape>) -> FloatTensor<Self> {
        let (table, points) = (into_contiguous(table), into_contiguous(points));
        let m = points.meta.shape()[0];
        let out = floats(&points, [m, shape.width()]);
        let client = points.client.clone();
        let levels = constant(&points, &words(&shape), DType::U32);
        look_up::launch(
            &client,
            workgroups_for(m * shape.width()),
            CubeDim::new_1d(THREADS),
            table.into_buffer_arg(),
            points.into_buffer_arg(),
            levels.into_buffer_arg(),
            out.clone().into_buffer_arg(),
            shape.features as u32,
            shape.levels.len() as u32,
            Rules::of(&shape),
        );
        out
    }
}

impl LookupBackward for CubeBackend {
    fn lookup_backward(points: FloatTensor<Self>, shape: Arc<GridShape>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let (points, grad): (CubeTensor, CubeTensor) = (into_contiguous(points), into_contiguous(grad));
        let client = points.client.clone();
        let dim = CubeDim::new_1d(THREADS);
        let count = (points.meta.shape()[0] * shape.levels.len()) << shape.dims;
        let levels = constant(&points, &words(&shape), DType::U32);
        let (rows, slots) = (empty(&points, [count], DType::U32), empty(&points, [count], DType::U32));
        rows_of_slots::launch(
            &client,
            workgroups_for(count),
            dim,
            points.clone().into_buffer_arg(),
            levels.clone().into_buffer_arg(),
            rows.clone().into_buffer_arg(),
            slots.clone().into_buffer_arg(),
            shape.levels.len() as u32,
            Rules::of(&shape),
        );
        let (sorted, slots) = sort_pairs(rows, slots, count, usize::BITS - shape.rows().leading_zeros());
        let starts = empty(&points, [shape.rows()], DType::U32);
        first_slots::launch(&client, workgroups_for(shape.rows()), dim, sorted.into_buffer_arg(), starts.clone().into_buffer_arg());
        let out = floats(&grad, [shape.parameter_count()]);
        gather::launch(
            &client,
            spread(shape.parameter_count().div_ceil(NUMBERS)),
            dim,
            starts.into_buffer_arg(),
            slots.into_buffer_arg(),
            points.into_buffer_arg(),
            levels.into_buffer_arg(),
            grad.into_buffer_arg(),
            out.clone().into_buffer_arg(),
            shape.features as u32,
            shape.levels.len() as u32,
            Rules::of(&shape),
        );
        out
    }
}
