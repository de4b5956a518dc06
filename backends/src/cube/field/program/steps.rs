//! The kernel behind [`super::Program`]: what each step does to the tiles of one workgroup.

mod layer_norm;

pub use layer_norm::PARTS;

use super::Layout;
use super::fields::{
    ACCUMULATE, AT, BIAS, COLUMN, FIELDS, FLAGS, KIND, LOAD, MASK, MULTIPLY, NONE, NORM, OUTPUT, OUTSIDE, RELOAD, RELU, SAVE, STRIDE, TARGET, TILE, WEIGHTS,
    WIDTH,
};
use crate::cube::field::activation::relu_is_zero;
use crate::cube::field::decoder::signature;
use cubecl::prelude::*;
use layer_norm::{norm, norm_back};

/// Rows and columns a thread computes.
pub const BLOCK: usize = 8;
/// Values that a thread reads from global memory before it needs the first of them.
const AHEAD: usize = 8;

/// Four floats that one instruction loads.
type Four = Vector<f32, Const<4>>;

/// Whether a row of `vertices` `[U,3]` holds one; rows without a vertex come last.
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
    let mut tiles = Shared::<[f32]>::new_slice(comptime!(layout.tile * layout.stride * layout.tiles));
    let mut partial = Shared::<[f32]>::new_slice(comptime!(PARTS * layout.tile));
    // What a multiplication works on: four inputs of a row, or their weights to a column, in a vector; `[chunk / 4, tile]` and `[chunk / 4, columns]`.
    let mut rows = Shared::<[Four]>::new_slice(comptime!(layout.chunk() / 4 * layout.tile));
    let mut factors = Shared::<[Four]>::new_slice(comptime!(layout.chunk() / 4 * layout.columns()));
    let (first, count, start) = (CUBE_POS * tile, count as usize, start as usize);
    let inputs = inputs as usize;
    let mut steps = steps as usize;
    if comptime!(hashed) {
        // Past the last vertex there is nothing to do.
        let row = start + select(first < count, first, count - 1);
        steps = select(first < count && is_vertex(vertices, row), steps, 0);
    }
    let mut index = select(steps > 0, UNIT_POS as usize, tile * inputs);
    while index < tile * inputs {
        let (r, i) = (index / inputs, index % inputs);
        // Rows beyond the last repeat it; they are not written.
        let row = start + select(first + r < count, first + r, count - 1);
        if comptime!(hashed) {
            tiles[r * stride + i] = signature(vertices, plan, constants as usize, row, i, inputs, modulus, scale);
        } else {
            tiles[r * stride + i] = x[row * inputs + i];
        }
        index += comptime!(layout.threads());
    }
    sync_cube();
    for step in 0..steps {
        let at = FIELDS * step;
        let kind = plan[at + KIND];
        if kind == MULTIPLY {
            multiply(&mut tiles, &mut rows, &mut factors, weights, plan, out, at, first, count, layout);
        } else if kind == LOAD {
            load(&mut tiles, given, plan, at, start + first, first, count, layout);
        } else if kind == RELOAD {
            load(&mut tiles, &*out, plan, at, first, first, count, layout);
        } else if kind == SAVE {
            save(&mut tiles, plan, out, at, first, count, layout);
        } else if kind == MASK {
            mask(&mut tiles, plan, &*out, at, first, count, layout);
        } else if kind == NORM {
            norm(&mut tiles, &mut partial, weights, plan, out, at, first, count, layout);
        } else {
            norm_back(&mut tiles, &mut partial, weights, plan, out, at, first, count, layout);
        }
        sync_cube();
    }
}

/// Brings the inputs from `i` on of every row, and their weights to `columns` columns from `first` on, into shared memory; zeros where they end.
#[cube]
fn stage(
    rows: &mut Shared<[Four]>,
    factors: &mut Shared<[Four]>,
    tiles: &Shared<[f32]>,
    weights: &[f32],
    source: usize,
    matrix: usize,
    i: usize,
    input: usize,
    first: usize,
    columns: usize,
    output: usize,
    #[comptime] layout: Layout,
) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let mut index = UNIT_POS as usize;
    while index < comptime!(layout.chunk() / 4 * layout.tile) {
        let (r, from) = (index % tile, i + index / tile * 4);
        let mut four = Four::new(0.0f32);
        #[unroll]
        for v in 0..4usize {
            let inside = from + v < input;
            let value = tiles[source + r * stride + select(inside, from + v, 0)];
            four.insert(v, select(inside, value, 0.0f32));
        }
        rows[index] = four;
        index += comptime!(layout.threads());
    }
    let mut index = UNIT_POS as usize;
    while index < comptime!(layout.chunk() / 4) * columns {
        let (column, from) = (first + index % columns, i + index / columns * 4);
        let mut four = Four::new(0.0f32);
        // Without branches, a thread need not wait for one weight before it asks for the next.
        #[unroll]
        for v in 0..4usize {
            let inside = from + v < input && column < output;
            let value = weights[matrix + select(inside, (from + v) * output + column, 0)];
            four.insert(v, select(inside, value, 0.0f32));
        }
        factors[index] = four;
        index += comptime!(layout.threads());
    }
}

/// A thread computes a block of rows and, `across` apart, a few columns. Inputs and weights go through shared memory in vectors of four, chunk by chunk: a
/// thread does 256 multiplications for 16 loads.
#[cube]
fn multiply(
    tiles: &mut Shared<[f32]>,
    rows: &mut Shared<[Four]>,
    factors: &mut Shared<[Four]>,
    weights: &[f32],
    plan: &[u32],
    out: &mut [f32],
    at: usize,
    first: usize,
    count: usize,
    #[comptime] layout: Layout,
) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (source, target) = (plan[at + TILE] as usize, plan[at + TARGET] as usize);
    let (input, output) = (plan[at + WIDTH] as usize, plan[at + OUTPUT] as usize);
    let (matrix, bias, flags) = (plan[at + WEIGHTS] as usize, plan[at + BIAS], plan[at + FLAGS]);
    let result = plan[at + AT] as usize;
    let (all, most) = (output.div_ceil(BLOCK), comptime!(layout.columns() / BLOCK));
    for pass in 0..all.div_ceil(most) {
        let left = all - pass * most;
        let across = select(left < most, left, most);
        let begin = pass * comptime!(layout.columns());
        let thread = UNIT_POS as usize;
        let active = thread < across * comptime!(layout.tile / BLOCK);
        let (row, column) = (thread / across * BLOCK, thread % across);
        let mut sums = Array::<f32>::new(comptime!(BLOCK * BLOCK));
        #[unroll]
        for k in 0..comptime!(BLOCK * BLOCK) {
            sums[k] = 0.0f32;
        }
        for chunk in 0..input.div_ceil(comptime!(layout.chunk())) {
            // Every thread is done with the chunk before.
            sync_cube();
            let i = chunk * comptime!(layout.chunk());
            stage(rows, factors, &*tiles, weights, source * (tile * stride), matrix, i, input, begin, across * BLOCK, output, layout);
            sync_cube();
            if active {
                #[unroll]
                for k in 0..comptime!(layout.chunk() / 4) {
                    let mut own = Array::<Four>::new(BLOCK);
                    #[unroll]
                    for r in 0..BLOCK {
                        own[r] = rows[k * tile + row + r];
                    }
                    #[unroll]
                    for c in 0..BLOCK {
                        let four = factors[k * (across * BLOCK) + column + c * across];
                        #[unroll]
                        for v in 0..4usize {
                            let factor = four.extract(v);
                            #[unroll]
                            for r in 0..BLOCK {
                                sums[r * BLOCK + c] = fma(own[r].extract(v), factor, sums[r * BLOCK + c]);
                            }
                        }
                    }
                }
            }
        }
        // All of the source has been staged before any thread writes to the same tile.
        if active {
            #[unroll]
            for c in 0..BLOCK {
                let own = begin + column + c * across;
                if own < output {
                    let mut shift = 0.0f32;
                    if bias != NONE {
                        shift = weights[bias as usize + own];
                    }
                    #[unroll]
                    for r in 0..BLOCK {
                        let sum = sums[r * BLOCK + c] + shift;
                        let zero = relu_is_zero(sum);
                        let value = select((flags & RELU) != 0 && zero, 0.0f32, sum);
                        if target == OUTSIDE {
                            if first + row + r < count {
                                out[result + (first + row + r) * output + own] = value;
                            }
                        } else {
                            let to = target * (tile * stride) + (row + r) * stride + own;
                            tiles[to] = value + select((flags & ACCUMULATE) != 0, tiles[to], 0.0f32);
                        }
                    }
                }
            }
        }
    }
}

/// The index into a tile of value `index` of rows of `width`, and whether it is within the tile and its row among the last.
#[cube]
fn position(index: usize, width: usize, first: usize, count: usize, #[comptime] layout: Layout) -> (usize, bool) {
    let (r, i) = (index / width, index % width);
    (r * comptime!(layout.stride) + i, index < comptime!(layout.tile) * width && first + r < count)
}

/// Loads columns of rows of `buffer`, from row `row` on, into a tile. `buffer` holds given or saved values.
#[cube]
fn load(tiles: &mut Shared<[f32]>, buffer: &[f32], plan: &[u32], at: usize, row: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (target, column, taken) = (plan[at + TILE] as usize, plan[at + COLUMN] as usize, plan[at + WIDTH] as usize);
    let (width, from) = (plan[at + STRIDE] as usize, plan[at + AT] as usize);
    let mut index = UNIT_POS as usize;
    while index < tile * taken {
        let mut values = Array::<f32>::new(AHEAD);
        #[unroll]
        for k in 0..AHEAD {
            let own = index + k * comptime!(layout.threads());
            let (_, inside) = position(own, taken, first, count, layout);
            let value = buffer[from + select(inside, (row + own / taken) * width + column + own % taken, 0)];
            values[k] = select(inside, value, 0.0f32);
        }
        #[unroll]
        for k in 0..AHEAD {
            let own = index + k * comptime!(layout.threads());
            if own < tile * taken {
                let (to, _) = position(own, taken, first, count, layout);
                tiles[target * (tile * stride) + to] = values[k];
            }
        }
        index += comptime!(AHEAD * layout.threads());
    }
}

/// Writes a tile to the output buffer. Each thread writes the values that it uses when it reads them back in [`mask`] and, for a reload, in [`load`]: no
/// barrier for global memory is needed. It also reads values that it did not write, which it does not use.
#[cube]
fn save(tiles: &mut Shared<[f32]>, plan: &[u32], out: &mut [f32], at: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (source, width, to) = (plan[at + TILE] as usize, plan[at + WIDTH] as usize, plan[at + AT] as usize);
    let mut index = UNIT_POS as usize;
    while index < tile * width {
        let (r, i) = (index / width, index % width);
        if first + r < count {
            out[to + (first + r) * width + i] = tiles[source * (tile * stride) + r * stride + i];
        }
        index += comptime!(layout.threads());
    }
}

#[cube]
fn mask(tiles: &mut Shared<[f32]>, plan: &[u32], out: &[f32], at: usize, first: usize, count: usize, #[comptime] layout: Layout) {
    let (tile, stride) = (comptime!(layout.tile), comptime!(layout.stride));
    let (target, width, from) = (plan[at + TILE] as usize, plan[at + WIDTH] as usize, plan[at + AT] as usize);
    let mut index = UNIT_POS as usize;
    while index < tile * width {
        let mut values = Array::<f32>::new(AHEAD);
        #[unroll]
        for k in 0..AHEAD {
            let own = index + k * comptime!(layout.threads());
            let (_, inside) = position(own, width, first, count, layout);
            values[k] = out[from + select(inside, first * width + own, 0)];
        }
        #[unroll]
        for k in 0..AHEAD {
            let own = index + k * comptime!(layout.threads());
            let (to, inside) = position(own, width, first, count, layout);
            let zero = relu_is_zero(values[k]);
            if inside && zero {
                tiles[target * (tile * stride) + to] = 0.0f32;
            }
        }
        index += comptime!(AHEAD * layout.threads());
    }
}
