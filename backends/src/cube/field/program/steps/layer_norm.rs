//! LayerNorm with Mish on a tile, and its derivative.

use crate::cube::field::activation::{mish, mish_derivative};
use crate::cube::field::program::Layout;
use crate::cube::field::program::fields::{AT, BEFORE, NONE, NORMAL, SCALE, TILE, WEIGHTS, WIDTH};
use cc4dgs_fields::networks::LAYER_NORM_EPSILON as EPSILON;
use cubecl::prelude::*;

/// Parts into which the sum of a row is split, whatever the tile, so that it does not depend on how many rows there are: part k adds up values k, k + 16, ….
pub const PARTS: usize = 16;

/// The sum over a row of which this thread holds the parts `own`, in order.
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

/// LayerNorm and Mish of the rows of a tile.
#[cube]
pub fn norm(
    tiles: &mut Shared<[f32]>,
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
    let (target, width, gain) = (plan[at + TILE] as usize, plan[at + WIDTH] as usize, plan[at + WEIGHTS] as usize);
    let (normals, scales) = (plan[at + NORMAL], plan[at + SCALE]);
    let (r, part) = (UNIT_POS as usize / per_row, UNIT_POS as usize % per_row);
    let line = target * (tile * stride) + r * stride;
    let mut sums = Array::<f32>::new(comptime!(PARTS / per_row));
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        sums[k] = 0.0f32;
        let mut i = part + k * per_row;
        while i < width {
            sums[k] += tiles[line + i];
            i += PARTS;
        }
    }
    let mean = row_sum(partial, &sums, per_row) / width as f32;
    #[unroll]
    for k in 0..comptime!(PARTS / per_row) {
        sums[k] = 0.0f32;
        let mut i = part + k * per_row;
        while i < width {
            let d = tiles[line + i] - mean;
            sums[k] = fma(d, d, sums[k]);
            i += PARTS;
        }
    }
    let variance = row_sum(partial, &sums, per_row) / width as f32;
    let inverse = 1.0 / (variance + EPSILON).sqrt();
    let saves = normals != NONE && first + r < count;
    if saves {
        out[scales as usize + CUBE_POS * comptime!(layout.threads()) + UNIT_POS as usize] = inverse;
    }
    let mut i = part;
    while i < width {
        let normal = (tiles[line + i] - mean) * inverse;
        if saves {
            out[normals as usize + (first + r) * width + i] = normal;
        }
        tiles[line + i] = mish(fma(normal, weights[gain + i], weights[gain + width + i]));
        i += per_row;
    }
}

/// The derivative of LayerNorm and Mish.
#[cube]
pub fn norm_back(
    tiles: &mut Shared<[f32]>,
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
    let (target, width, gain) = (plan[at + TILE] as usize, plan[at + WIDTH] as usize, plan[at + WEIGHTS] as usize);
    let (normals, scales) = (plan[at + NORMAL] as usize, plan[at + SCALE] as usize);
    let (before, after) = (plan[at + BEFORE] as usize, plan[at + AT] as usize);
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
                let dz = tiles[line + i] * mish_derivative(fma(normal, g, weights[gain + width + i]));
                tiles[line + i] = dz;
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
        let inverse = out[scales + CUBE_POS * comptime!(layout.threads()) + UNIT_POS as usize];
        let mut i = part;
        while i < width {
            let d = inverse * (tiles[line + i] * weights[gain + i] - sum - out[normals + row + i] * along);
            tiles[line + i] = d;
            out[after + row + i] = d;
            i += per_row;
        }
    }
}
