//! The kernel behind [`super::Program`]: what each step does to the tiles of one cube.

use super::Layout;
use crate::cube::field::activation::{mish, mish_derivative};
use crate::cube::field::decoder::signature;
use crate::ops::networks::LAYER_NORM_EPSILON as EPSILON;
use cubecl::prelude::*;

/// Numbers per step in a plan.
pub const FIELDS: usize = 9;
/// Stands for "none".
pub const NONE: u32 = u32::MAX;
/// Stands for the result where a tile is named.
pub const OUTSIDE: usize = 3;
/// Rows and columns a unit computes: 64 sums for 16 loads.
pub const BLOCK: usize = 8;

pub const MULTIPLY: u32 = 0;
pub const LOAD: u32 = 1;
pub const KEEP: u32 = 2;
pub const CUT: u32 = 3;
pub const NORM: u32 = 4;
pub const NORM_BACK: u32 = 5;

/// Flags of a multiplication.
pub const RELU: u32 = 1;
pub const ACCUMULATE: u32 = 2;

/// Whether a row of `vertices` [U,3] holds one; those that do not come last.
#[cube]
pub fn is_vertex(vertices: &[i32], row: usize) -> bool {
    vertices[3 * row] >= 0
}

/// See [`super::Program::run`].
#[cube(launch_unchecked)]
pub fn run_steps(
    x: &[f32],
    vertices: &[i32],
    plan: &[u32],
    weights: &[f32],
    given: &[f32],
    out: &mut [f32],
    start: u32,
    count: u32,
    steps: u32,
    inputs: u32,
    constants: u32,
    modulus: u32,
    scale: f32,
    #[comptime] hashed: bool,
    #[comptime] layout: Layout,
) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let mut kept = Shared::<[f32]>::new_slice(comptime!(layout.tile * layout.stride * layout.tiles));
    let mut partial = Shared::<[f32]>::new_slice(comptime!(PARTS * layout.tile));
    let (first, count, start) = (CUBE_POS * tile, count as usize, start as usize);
    let inputs = inputs as usize;
    let mut steps = steps as usize;
    if comptime!(hashed) {
        // Behind the last vertex there is nothing to do.
        let row = start + select(first < count, first, count - 1);
        steps = select(first < count && is_vertex(vertices, row), steps, 0);
    }
    let mut place = select(steps > 0, UNIT_POS as usize, tile * inputs);
    while place < tile * inputs {
        let (r, i) = (place / inputs, place % inputs);
        // Rows beyond the last repeat it; they are not written.
        let row = start + select(first + r < count, first + r, count - 1);
        if comptime!(hashed) {
            kept[r * stride + i] = signature(vertices, plan, constants as usize, row, i, inputs, modulus, scale);
        } else {
            kept[r * stride + i] = x[row * inputs + i];
        }
        place += comptime!(layout.units());
    }
    sync_cube();
    for step in 0..steps {
        let at = FIELDS * step;
        let what = plan[at];
        if what == MULTIPLY {
            multiply(&mut kept, weights, plan, out, at, first, count, layout);
        } else if what == LOAD {
            load(&mut kept, given, plan, at, first, count, start, layout);
        } else if what == KEEP {
            keep(&mut kept, plan, out, at, first, count, layout);
        } else if what == CUT {
            cut(&mut kept, plan, &*out, at, first, count, layout);
        } else if what == NORM {
            norm(&mut kept, &mut partial, weights, plan, out, at, first, count, layout);
        } else {
            norm_back(&mut kept, &mut partial, weights, plan, out, at, first, count, layout);
        }
        sync_cube();
    }
}

/// A unit computes a block of rows and, `across` apart, a few columns, so that neighbouring units read neighbouring weights.
#[cube]
fn multiply(kept: &mut Shared<[f32]>, weights: &[f32], plan: &[u32], out: &mut [f32], at: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (source, target, input, output) = (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize, plan[at + 4] as usize);
    let (matrix, bias, place, flags) = (plan[at + 5] as usize, plan[at + 6], plan[at + 7] as usize, plan[at + 8]);
    let units = comptime!(layout.units());
    let across = output.div_ceil(BLOCK);
    let blocks = across * comptime!(layout.tile / BLOCK);
    for pass in 0..blocks.div_ceil(units) {
        let block = pass * units + UNIT_POS as usize;
        let active = block < blocks;
        let (row, column) = (block / across * BLOCK, block % across);
        let mut sums = Array::<f32>::new(comptime!(BLOCK * BLOCK));
        if active {
            #[unroll]
            for k in 0..comptime!(BLOCK * BLOCK) {
                sums[k] = 0.0f32;
            }
            let mut own = Array::<usize>::new(BLOCK);
            #[unroll]
            for c in 0..BLOCK {
                // Columns beyond the last repeat it; they are not written.
                own[c] = matrix + select(column + c * across < output, column + c * across, output - 1);
            }
            let from = source * (tile * stride) + row * stride;
            let mut factors = Array::<f32>::new(BLOCK);
            for i in 0..input {
                #[unroll]
                for c in 0..BLOCK {
                    factors[c] = weights[own[c] + i * output];
                }
                #[unroll]
                for r in 0..BLOCK {
                    let value = kept[from + r * stride + i];
                    #[unroll]
                    for c in 0..BLOCK {
                        sums[r * BLOCK + c] = fma(value, factors[c], sums[r * BLOCK + c]);
                    }
                }
            }
        }
        // Everybody has read before anybody writes to the same tile.
        sync_cube();
        if active {
            #[unroll]
            for c in 0..BLOCK {
                let own = column + c * across;
                if own < output {
                    let mut shift = 0.0f32;
                    if bias != NONE {
                        shift = weights[bias as usize + own];
                    }
                    #[unroll]
                    for r in 0..BLOCK {
                        let sum = sums[r * BLOCK + c] + shift;
                        let value = select((flags & RELU) != 0 && sum <= 0.0, 0.0f32, sum);
                        if target == OUTSIDE {
                            if first + row + r < count {
                                out[place + (first + row + r) * output + own] = value;
                            }
                        } else {
                            let to = target * (tile * stride) + (row + r) * stride + own;
                            kept[to] = value + select((flags & ACCUMULATE) != 0, kept[to], 0.0f32);
                        }
                    }
                }
            }
        }
    }
}

#[cube]
fn load(kept: &mut Shared<[f32]>, given: &[f32], plan: &[u32], at: usize, first: usize, count: usize, start: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (target, column, taken, width, from) =
        (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize, plan[at + 4] as usize, plan[at + 5] as usize);
    let mut place = UNIT_POS as usize;
    while place < tile * taken {
        let (r, i) = (place / taken, place % taken);
        let mut value = 0.0f32;
        if first + r < count {
            value = given[from + (start + first + r) * width + column + i];
        }
        kept[target * (tile * stride) + r * stride + i] = value;
        place += comptime!(layout.units());
    }
}

/// What a unit keeps here is what it reads in [`cut`]: no other unit's writes have to arrive.
#[cube]
fn keep(kept: &mut Shared<[f32]>, plan: &[u32], out: &mut [f32], at: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (source, width, to) = (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize);
    let mut place = UNIT_POS as usize;
    while place < tile * width {
        let (r, i) = (place / width, place % width);
        if first + r < count {
            out[to + (first + r) * width + i] = kept[source * (tile * stride) + r * stride + i];
        }
        place += comptime!(layout.units());
    }
}

#[cube]
fn cut(kept: &mut Shared<[f32]>, plan: &[u32], out: &[f32], at: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (target, width, from) = (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize);
    let mut place = UNIT_POS as usize;
    while place < tile * width {
        let (r, i) = (place / width, place % width);
        if first + r < count {
            if out[from + (first + r) * width + i] <= 0.0 {
                kept[target * (tile * stride) + r * stride + i] = 0.0f32;
            }
        }
        place += comptime!(layout.units());
    }
}

/// Parts into which the sum of a row is cut, whatever the tile, so that it does not depend on how many rows there are: part k adds up values k, k + 16, ….
pub const PARTS: usize = 16;

/// The sum over a row of which this unit holds the parts `own`, in order.
#[cube]
fn row_sum(partial: &mut Shared<[f32]>, own: &Array<f32>, #[comptime] per_row: usize) -> f32 {
    let (r, part) = (UNIT_POS as usize / per_row, UNIT_POS as usize % per_row);
    sync_cube();
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        partial[r * PARTS + part + k * per_row] = own[k];
    }
    sync_cube();
    let mut sum = 0.0f32;
    #[unroll]
    for k in 0..PARTS {
        sum += partial[r * PARTS + k];
    }
    sum
}

#[cube]
fn norm(
    kept: &mut Shared<[f32]>,
    partial: &mut Shared<[f32]>,
    weights: &[f32],
    plan: &[u32],
    out: &mut [f32],
    at: usize,
    first: usize,
    count: usize,
    #[comptime] layout: Layout,
) {
    let (tile, stride, per_row) = (comptime!(layout.tile), comptime!(layout.stride), comptime!(layout.per_row));
    let (target, width, gain, normals, scales) = (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize, plan[at + 4], plan[at + 5]);
    let (r, part) = (UNIT_POS as usize / per_row, UNIT_POS as usize % per_row);
    let line = target * (tile * stride) + r * stride;
    let mut sums = Array::<f32>::new(comptime!(PARTS / per_row));
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        sums[k] = 0.0f32;
        let mut i = part + k * per_row;
        while i < width {
            sums[k] += kept[line + i];
            i += PARTS;
        }
    }
    let mean = row_sum(partial, &sums, per_row) / width as f32;
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        sums[k] = 0.0f32;
        let mut i = part + k * per_row;
        while i < width {
            let d = kept[line + i] - mean;
            sums[k] = fma(d, d, sums[k]);
            i += PARTS;
        }
    }
    let variance = row_sum(partial, &sums, per_row) / width as f32;
    let inverse = 1.0 / (variance + EPSILON).sqrt();
    let keeps = normals != NONE && first + r < count;
    if keeps {
        out[scales as usize + CUBE_POS * comptime!(layout.units()) + UNIT_POS as usize] = inverse;
    }
    let mut i = part;
    while i < width {
        let normal = (kept[line + i] - mean) * inverse;
        if keeps {
            out[normals as usize + (first + r) * width + i] = normal;
        }
        kept[line + i] = mish(fma(normal, weights[gain + i], weights[gain + width + i]));
        i += per_row;
    }
}

#[cube]
fn norm_back(
    kept: &mut Shared<[f32]>,
    partial: &mut Shared<[f32]>,
    weights: &[f32],
    plan: &[u32],
    out: &mut [f32],
    at: usize,
    first: usize,
    count: usize,
    #[comptime] layout: Layout,
) {
    let (tile, stride, per_row) = (comptime!(layout.tile), comptime!(layout.stride), comptime!(layout.per_row));
    let (target, width, gain) = (plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3] as usize);
    let (normals, scales, before, after) = (plan[at + 4] as usize, plan[at + 5] as usize, plan[at + 6] as usize, plan[at + 7] as usize);
    let (r, part) = (UNIT_POS as usize / per_row, UNIT_POS as usize % per_row);
    let line = target * (tile * stride) + r * stride;
    let row = (first + r) * width;
    let real = first + r < count;
    let mut sums = Array::<f32>::new(comptime!(PARTS / per_row));
    let mut along = Array::<f32>::new(comptime!(PARTS / per_row));
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        sums[k] = 0.0f32;
        along[k] = 0.0f32;
        if real {
            let mut i = part + k * per_row;
            while i < width {
                let normal = out[normals + row + i];
                let g = weights[gain + i];
                let dz = kept[line + i] * mish_derivative(fma(normal, g, weights[gain + width + i]));
                kept[line + i] = dz;
                out[before + row + i] = dz;
                sums[k] = fma(dz, g, sums[k]);
                along[k] = fma(dz * g, normal, along[k]);
                i += PARTS;
            }
        }
    }
    let sum = row_sum(partial, &sums, per_row) / width as f32;
    let along = row_sum(partial, &along, per_row) / width as f32;
    if real {
        let inverse = out[scales + CUBE_POS * comptime!(layout.units()) + UNIT_POS as usize];
        let mut i = part;
        while i < width {
            let d = inverse * (kept[line + i] * weights[gain + i] - sum - out[normals + row + i] * along);
            kept[line + i] = d;
            out[after + row + i] = d;
            i += per_row;
        }
    }
}
