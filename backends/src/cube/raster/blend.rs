//! Front-to-back blending, a unit per pixel and a cube per tile, and its back-to-front derivative. What a tile draws is brought on the chip a batch at a time.

use super::project::SPLAT;
use crate::cpu::raster::camera::{ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::cpu::raster::{RECORD, TILE, TILE_PIXELS};
use cubecl::prelude::*;

const SIDE: u32 = TILE as u32;
/// Gaussians brought on the chip at a time, forwards.
const BATCH: usize = 64;
/// The same backwards, where pixels leave what they found for those who add it up: the more the better, as far as shared memory goes.
const BATCHES: [usize; 3] = [16, 8, 4];
/// One more than the pixels of a tile, so that columns of sums lie in different banks.
const COLUMN: usize = TILE_PIXELS + 1;

/// Floats that the backward pass shares for a batch of so many Gaussians: what pixels found (later sums), and the gradient of the picture.
const fn found_floats(batch: usize) -> usize {
    let (found, sums) = (2 * batch * TILE_PIXELS, RECORD * COLUMN);
    if found > sums { found } else { sums }
}

/// The Gaussians per batch of the backward pass on a device with so much shared memory.
pub fn backward_batch(shared_bytes: usize) -> usize {
    let bytes = |batch: usize| 4 * (found_floats(batch) + 4 * TILE_PIXELS + (RECORD + 1) * batch + 1);
    BATCHES.into_iter().find(|&batch| bytes(batch) <= shared_bytes).unwrap_or(BATCHES[BATCHES.len() - 1])
}

/// Alpha of a Gaussian at an offset from its centre before its cap; 0 where it is not drawn.
#[cube]
fn full_alpha(drawn: &Shared<[f32]>, at: usize, dx: f32, dy: f32) -> f32 {
    let sigma = drawn[at + 2] * dx * dx + drawn[at + 3] * dx * dy + drawn[at + 4] * dy * dy;
    let alpha = drawn[at + 5] * (-sigma).exp();
    select(sigma >= 0.0 && alpha >= ALPHA_MIN, alpha, 0.0f32)
}

/// Planes [5,H,W]; per pixel the transmittance left and the place in the list where it stopped, as bits [2,H,W]; largest weights [N] if wanted.
#[cube(launch_unchecked)]
pub fn blend_tiles(
    splats: &[f32],
    gaussian_of_pair: &[u32],
    sorted: &[u32],
    starts: &[u32],
    background: &[f32],
    planes: &mut [f32],
    state: &mut [f32],
    weights: &mut [Atomic<u32>],
    width: u32,
    height: u32,
    tiles_x: u32,
    alpha_max: f32,
    #[comptime] wants_weights: bool,
) {
    let mut drawn = Shared::<[f32]>::new_slice(comptime!(RECORD * BATCH));
    let mut gaussians = Shared::<[u32]>::new_slice(BATCH);
    let finished = Shared::<[Atomic<u32>]>::new_slice(1usize);
    let unit = UNIT_POS as usize;
    let tile = CUBE_POS as u32;
    let x = tile % tiles_x * SIDE + UNIT_POS % SIDE;
    let y = tile / tiles_x * SIDE + UNIT_POS / SIDE;
    let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
    let inside = x < width && y < height;
    let mut first = 0u32;
    let mut end = 0u32;
    if (tile as usize) + 1 < starts.len() {
        first = starts[tile as usize];
        end = starts[tile as usize + 1];
    }
    let mut stop = end;
    let mut left = 1.0f32;
    let mut red = 0.0f32;
    let mut green = 0.0f32;
    let mut blue = 0.0f32;
    let mut depth = 0.0f32;
    let mut running = inside;
    if unit == 0 {
        finished[0].store(0u32);
    }
    sync_cube();
    if !inside {
        finished[0].fetch_add(1u32);
    }
    sync_cube();
    let mut done = finished[0].load();
    while first < end && done < TILE_PIXELS as u32 {
        let count = select(end - first < BATCH as u32, end - first, BATCH as u32);
        if UNIT_POS < count {
            gaussians[unit] = gaussian_of_pair[sorted[first as usize + unit] as usize];
        }
        sync_cube();
        let mut k = unit;
        while k < RECORD * count as usize {
            drawn[k] = splats[SPLAT * gaussians[k / RECORD] as usize + k % RECORD];
            k += TILE_PIXELS;
        }
        sync_cube();
        let mut g = 0u32;
        while running && g < count {
            let at = RECORD * g as usize;
            let full = full_alpha(&drawn, at, px - drawn[at], py - drawn[at + 1]);
            if full > 0.0 {
                let alpha = select(full < alpha_max, full, alpha_max);
                let after = left - alpha * left;
                if after <= TRANSMITTANCE_STOP {
                    running = false;
                    stop = first + g;
                    finished[0].fetch_add(1u32);
                } else {
                    let weight = alpha * left;
                    red += weight * drawn[at + 6];
                    green += weight * drawn[at + 7];
                    blue += weight * drawn[at + 8];
                    depth += weight * drawn[at + 9];
                    left = after;
                    if comptime!(wants_weights) {
                        // Weights are positive, so their bits order like the numbers, and a maximum has no order.
                        weights[gaussians[g as usize] as usize].fetch_max(u32::reinterpret(weight));
                    }
                }
            }
            g += 1;
        }
        first += count;
        sync_cube();
        done = finished[0].load();
        sync_cube();
    }
    if inside {
        let pixels = (width * height) as usize;
        let at = (y * width + x) as usize;
        planes[at] = red + left * background[0];
        planes[at + pixels] = green + left * background[1];
        planes[at + 2 * pixels] = blue + left * background[2];
        planes[at + 3 * pixels] = 1.0 - left;
        planes[at + 4 * pixels] = depth;
        state[at] = left;
        state[at + pixels] = f32::reinterpret(stop);
    }
}

/// Gradient records of all pairs: centre (2), A, B, C, opacity, colour (3), depth. With q_i the upstream gradient of what Gaussian i shows at a pixel and S_i
/// the part of the loss behind it, d loss / d alpha_i = T_i q_i - S_i / (1 - alpha_i).
#[cube(launch_unchecked)]
pub fn blend_tiles_backward(
    splats: &[f32],
    gaussian_of_pair: &[u32],
    sorted: &[u32],
    starts: &[u32],
    background: &[f32],
    state: &[f32],
    upstream: &[f32],
    records: &mut [f32],
    width: u32,
    height: u32,
    tiles_x: u32,
    alpha_max: f32,
    #[comptime] pass_capped: bool,
    #[comptime] batch: usize,
) {
    // Per Gaussian of a batch and pixel: -d loss / d sigma, then the blending weight.
    let mut found = Shared::<[f32]>::new_slice(comptime!(found_floats(batch)));
    let mut of_picture = Shared::<[f32]>::new_slice(comptime!(4 * TILE_PIXELS));
    let mut drawn = Shared::<[f32]>::new_slice(comptime!(RECORD * batch));
    let mut pairs = Shared::<[u32]>::new_slice(batch);
    let unit = UNIT_POS as usize;
    let tile = CUBE_POS as u32;
    let x = tile % tiles_x * SIDE + UNIT_POS % SIDE;
    let y = tile / tiles_x * SIDE + UNIT_POS / SIDE;
    let pixels = (width * height) as usize;
    let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
    let mut left = 1.0f32;
    let mut behind = 0.0f32;
    let mut stop = 0u32;
    let mut g_red = 0.0f32;
    let mut g_green = 0.0f32;
    let mut g_blue = 0.0f32;
    let mut g_depth = 0.0f32;
    if x < width && y < height {
        let at = (y * width + x) as usize;
        left = state[at];
        stop = u32::reinterpret(state[at + pixels]);
        g_red = upstream[at];
        g_green = upstream[at + pixels];
        g_blue = upstream[at + 2 * pixels];
        g_depth = upstream[at + 4 * pixels];
        behind = left * (background[0] * g_red + background[1] * g_green + background[2] * g_blue - upstream[at + 3 * pixels]);
    }
    of_picture[unit] = g_red;
    of_picture[unit + TILE_PIXELS] = g_green;
    of_picture[unit + 2 * TILE_PIXELS] = g_blue;
    of_picture[unit + 3 * TILE_PIXELS] = g_depth;
    let mut start = 0u32;
    let mut end = 0u32;
    if (tile as usize) + 1 < starts.len() {
        start = starts[tile as usize];
        end = starts[tile as usize + 1];
    }
    // Behind the last Gaussian that any pixel of the tile shows, there is nothing to derive.
    let deepest = Shared::<[Atomic<u32>]>::new_slice(1usize);
    if UNIT_POS == 0 {
        deepest[0].store(start);
    }
    sync_cube();
    deepest[0].fetch_max(stop);
    sync_cube();
    let mut i = deepest[0].load();
    let unseen = (end - i) as usize * RECORD;
    let mut k = unit;
    while k < unseen {
        records[RECORD * sorted[i as usize + k / RECORD] as usize + k % RECORD] = 0.0;
        k += TILE_PIXELS;
    }
    // The Gaussian of the batch and the pixels a unit adds up; they share a column of the tile.
    let groups = comptime!(TILE_PIXELS / batch);
    let (own, group) = (unit / groups, unit % groups);
    let (column, top) = ((tile % tiles_x * SIDE) as f32 + (group % TILE) as f32 + 0.5, (tile / tiles_x * SIDE) as f32 + 0.5);
    while i > start {
        let count = select(i - start < batch as u32, i - start, batch as u32);
        let first = i - count;
        if UNIT_POS < count {
            pairs[unit] = sorted[first as usize + unit];
        }
        sync_cube();
        if unit < RECORD * count as usize {
            drawn[unit] = splats[SPLAT * gaussian_of_pair[pairs[unit / RECORD] as usize] as usize + unit % RECORD];
        }
        sync_cube();
        for step in 0..count {
            let g = (count - 1 - step) as usize;
            let at = RECORD * g;
            let mut v = 0.0f32;
            let mut weight = 0.0f32;
            if first + (g as u32) < stop {
                let full = full_alpha(&drawn, at, px - drawn[at], py - drawn[at + 1]);
                if full > 0.0 {
                    let alpha = select(full < alpha_max, full, alpha_max);
                    let inverse = 1.0 / (1.0 - alpha);
                    left *= inverse;
                    weight = alpha * left;
                    let q = drawn[at + 6] * g_red + drawn[at + 7] * g_green + drawn[at + 8] * g_blue + drawn[at + 9] * g_depth;
                    let d_alpha = left * q - behind * inverse;
                    behind += weight * q;
                    // d alpha / d sigma = -alpha, uncapped.
                    v = full * d_alpha;
                    if comptime!(!pass_capped) {
                        v = select(full <= alpha_max, v, 0.0f32);
                    }
                }
            }
            found[g * TILE_PIXELS + unit] = v;
            found[(batch + g) * TILE_PIXELS + unit] = weight;
        }
        sync_cube();
        // Moments of v give everything about the shape.
        let mut sums = Array::<f32>::new(RECORD);
        #[unroll]
        for k in 0..RECORD {
            sums[k] = 0.0f32;
        }
        if own < count as usize {
            let dx = column - drawn[RECORD * own];
            let mut along = 0.0f32;
            let mut square = 0.0f32;
            for k in 0..batch {
                let pixel = k * groups + group;
                let dy = top + (pixel / TILE) as f32 - drawn[RECORD * own + 1];
                let v = found[own * TILE_PIXELS + pixel];
                let weight = found[(batch + own) * TILE_PIXELS + pixel];
                sums[5] += v;
                along += v * dy;
                square += v * dy * dy;
                #[unroll]
                for c in 0..4usize {
                    sums[6 + c] += weight * of_picture[c * TILE_PIXELS + pixel];
                }
            }
            sums[0] = dx * sums[5];
            sums[1] = along;
            sums[2] = dx * dx * sums[5];
            sums[3] = dx * along;
            sums[4] = square;
        }
        sync_cube();
        #[unroll]
        for k in 0..RECORD {
            found[k * COLUMN + unit] = sums[k];
        }
        sync_cube();
        if unit < RECORD * count as usize {
            let (g, k) = (unit / RECORD, unit % RECORD);
            let mut sum = 0.0f32;
            for part in 0..groups {
                sum += found[k * COLUMN + g * groups + part];
            }
            records[RECORD * pairs[g] as usize + k] = sum;
        }
        sync_cube();
        i = first;
    }
}
