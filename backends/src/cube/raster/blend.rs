//! Front-to-back blending, a thread per pixel and a workgroup per tile, and its back-to-front derivative. The Gaussians of a tile are loaded into shared memory
//! a batch at a time.

use super::lists::{BACKGROUND, background_of};
use crate::ops::rasterize::camera::{ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::ops::rasterize::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, RECORD, TILE, TILE_PIXELS};
use cubecl::prelude::*;

const SIDE: u32 = TILE as u32;
/// From the first to the last pixel centre of a row or column of a tile.
const SPAN: f32 = TILE as f32 - 1.0;
/// Gaussians per batch, forwards.
const BATCH: usize = 64;
/// Gaussians per batch, backwards. Each pixel stores two numbers per Gaussian in shared memory, so the batch is as large as that memory allows.
const BATCHES: [usize; 3] = [16, 8, 4];
/// One more than the pixels of a tile, so that columns of sums are in different banks.
const COLUMN: usize = TILE_PIXELS + 1;

/// Floats of shared memory for what the pixels found of a batch of so many Gaussians, later for their sums.
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
    // A sum of squares: a dx^2 + b dx dy + c dy^2 would cancel for needles. The comparison with 0 is for NaN.
    let u = drawn[at + AT_A] * dx + drawn[at + AT_B] * dy;
    let t = drawn[at + AT_C] * dy;
    let sigma = u * u + t * t;
    let alpha = drawn[at + AT_OPACITY] * (-sigma).exp();
    select(sigma >= 0.0 && alpha >= ALPHA_MIN, alpha, 0.0f32)
}

/// Planes `[5,H,W]`; per pixel the bits of the transmittance left, and the list index at which it stopped `[2,H,W]`; largest weights `[N]` if asked for. The
/// background's colour is in `starts` ([`background_of`]).
#[cube(launch_unchecked)]
pub fn blend_tiles(
    splats: &[f32],
    gaussian_of_pair: &[u32],
    sorted: &[u32],
    starts: &[u32],
    planes: &mut [f32],
    state: &mut [u32],
    weights: &mut [Atomic<u32>],
    width: u32,
    height: u32,
    tiles_x: u32,
    alpha_max: f32,
    #[comptime] wants_weights: bool,
) {
    let mut drawn = Shared::<[f32]>::new_slice(comptime!(RECORD * BATCH));
    let mut gaussians = Shared::<[u32]>::new_slice(BATCH);
    // Largest weights of the batch, as bits.
    let heaviest = Shared::<[Atomic<u32>]>::new_slice(comptime!(if wants_weights { BATCH } else { 1 }));
    let finished = Shared::<[Atomic<u32>]>::new_slice(1usize);
    let thread = UNIT_POS as usize;
    let tile = CUBE_POS as u32;
    let x = tile % tiles_x * SIDE + UNIT_POS % SIDE;
    let y = tile / tiles_x * SIDE + UNIT_POS / SIDE;
    let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
    let inside = x < width && y < height;
    let mut first = 0u32;
    let mut end = 0u32;
    if (tile as usize) + 1 + BACKGROUND < starts.len() {
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
    if thread == 0 {
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
            gaussians[thread] = gaussian_of_pair[sorted[first as usize + thread] as usize];
            if comptime!(wants_weights) {
                heaviest[thread].store(0u32);
            }
        }
        sync_cube();
        let mut k = thread;
        while k < RECORD * count as usize {
            drawn[k] = splats[RECORD * gaussians[k / RECORD] as usize + k % RECORD];
            k += TILE_PIXELS;
        }
        sync_cube();
        let mut g = 0u32;
        while running && g < count {
            let at = RECORD * g as usize;
            let full = full_alpha(&drawn, at, px - drawn[at + AT_X], py - drawn[at + AT_Y]);
            if full > 0.0 {
                let alpha = select(full < alpha_max, full, alpha_max);
                let after = left * (1.0f32 - alpha);
                if after <= TRANSMITTANCE_STOP {
                    running = false;
                    stop = first + g;
                    finished[0].fetch_add(1u32);
                } else {
                    let weight = alpha * left;
                    red += weight * drawn[at + AT_COLOR];
                    green += weight * drawn[at + AT_COLOR + 1];
                    blue += weight * drawn[at + AT_COLOR + 2];
                    depth += weight * drawn[at + AT_DEPTH];
                    left = after;
                    if comptime!(wants_weights) {
                        // Weights are positive, so their bits order like the numbers, and a maximum has no order.
                        heaviest[g as usize].fetch_max(u32::reinterpret(weight));
                    }
                }
            }
            g += 1;
        }
        first += count;
        sync_cube();
        if comptime!(wants_weights) {
            if UNIT_POS < count {
                let most = heaviest[thread].load();
                if most > 0 {
                    weights[gaussians[thread] as usize].fetch_max(most);
                }
            }
        }
        done = finished[0].load();
        sync_cube();
    }
    if inside {
        let pixels = (width * height) as usize;
        let at = (y * width + x) as usize;
        planes[at] = red + left * background_of(starts, 0usize);
        planes[at + pixels] = green + left * background_of(starts, 1usize);
        planes[at + 2 * pixels] = blue + left * background_of(starts, 2usize);
        planes[at + 3 * pixels] = 1.0 - left;
        planes[at + 4 * pixels] = depth;
        // As words: an index as a float would be subnormal, and WGSL lets devices flush those to zero.
        state[at] = u32::reinterpret(left);
        state[at + pixels] = stop;
    }
}

/// Floats of a gradient record of a pair: sums of -d loss / d sigma times u, t, u^2, u t, t^2 and 1, where sigma = u^2 + t^2, weighted colours and depth; with
/// `absolute`, the centre's absolute gradient (x, y) too.
pub const fn record_floats(absolute: bool) -> usize {
    if absolute { RECORD + 2 } else { RECORD }
}

/// Gradient records of all pairs, [`record_floats`] each, which [`super::gradient::sum_records`] turns into gradients. With q_i the upstream gradient of what
/// Gaussian i shows at a pixel and S_i the part of the loss that lies behind it, d loss / d alpha_i = T_i q_i - S_i / (1 - alpha_i).
#[cube(launch_unchecked)]
pub fn blend_tiles_backward(
    splats: &[f32],
    gaussian_of_pair: &[u32],
    sorted: &[u32],
    starts: &[u32],
    state: &[u32],
    upstream: &[f32],
    records: &mut [f32],
    width: u32,
    height: u32,
    tiles_x: u32,
    alpha_max: f32,
    #[comptime] pass_capped: bool,
    #[comptime] batch: usize,
    #[comptime] absolute: bool,
) {
    let width_of_record = comptime!(record_floats(absolute));
    // Per Gaussian of a batch and pixel: -d loss / d sigma, then the blending weight.
    let mut found = Shared::<[f32]>::new_slice(comptime!(found_floats(batch)));
    let mut of_image = Shared::<[f32]>::new_slice(comptime!(4 * TILE_PIXELS));
    let mut drawn = Shared::<[f32]>::new_slice(comptime!(RECORD * batch));
    let mut pairs = Shared::<[u32]>::new_slice(batch);
    let thread = UNIT_POS as usize;
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
        left = f32::reinterpret(state[at]);
        stop = state[at + pixels];
        g_red = upstream[at];
        g_green = upstream[at + pixels];
        g_blue = upstream[at + 2 * pixels];
        g_depth = upstream[at + 4 * pixels];
        let (red, green, blue) = (background_of(starts, 0usize), background_of(starts, 1usize), background_of(starts, 2usize));
        behind = left * (red * g_red + green * g_green + blue * g_blue - upstream[at + 3 * pixels]);
    }
    of_image[thread] = g_red;
    of_image[thread + TILE_PIXELS] = g_green;
    of_image[thread + 2 * TILE_PIXELS] = g_blue;
    of_image[thread + 3 * TILE_PIXELS] = g_depth;
    let mut start = 0u32;
    let mut end = 0u32;
    if (tile as usize) + 1 + BACKGROUND < starts.len() {
        start = starts[tile as usize];
        end = starts[tile as usize + 1];
    }
    // Gaussians behind the last one that any pixel of the tile shows have no gradient.
    let deepest = Shared::<[Atomic<u32>]>::new_slice(1usize);
    if UNIT_POS == 0 {
        deepest[0].store(start);
    }
    sync_cube();
    deepest[0].fetch_max(stop);
    sync_cube();
    let mut i = deepest[0].load();
    let unseen = (end - i) as usize * width_of_record;
    let mut k = thread;
    while k < unseen {
        records[width_of_record * sorted[i as usize + k / width_of_record] as usize + k % width_of_record] = 0.0;
        k += TILE_PIXELS;
    }
    // Each thread sums some pixels of one Gaussian of the batch; they share a column of the tile.
    let groups = comptime!(TILE_PIXELS / batch);
    let (own, group) = (thread / groups, thread % groups);
    let (column, top) = ((tile % tiles_x * SIDE) as f32 + (group % TILE) as f32 + 0.5, (tile / tiles_x * SIDE) as f32 + 0.5);
    while i > start {
        let count = select(i - start < batch as u32, i - start, batch as u32);
        let first = i - count;
        if UNIT_POS < count {
            pairs[thread] = sorted[first as usize + thread];
        }
        sync_cube();
        if thread < RECORD * count as usize {
            drawn[thread] = splats[RECORD * gaussian_of_pair[pairs[thread / RECORD] as usize] as usize + thread % RECORD];
        }
        sync_cube();
        for step in 0..count {
            let g = (count - 1 - step) as usize;
            let at = RECORD * g;
            let mut v = 0.0f32;
            let mut weight = 0.0f32;
            if first + (g as u32) < stop {
                let full = full_alpha(&drawn, at, px - drawn[at + AT_X], py - drawn[at + AT_Y]);
                if full > 0.0 {
                    let alpha = select(full < alpha_max, full, alpha_max);
                    let inverse = 1.0 / (1.0 - alpha);
                    left *= inverse;
                    weight = alpha * left;
                    let mut q = drawn[at + AT_COLOR] * g_red + drawn[at + AT_COLOR + 1] * g_green;
                    q = q + drawn[at + AT_COLOR + 2] * g_blue + drawn[at + AT_DEPTH] * g_depth;
                    let d_alpha = left * q - behind * inverse;
                    behind += weight * q;
                    // d alpha / d sigma = -alpha, uncapped.
                    v = full * d_alpha;
                    if comptime!(!pass_capped) {
                        v = select(full <= alpha_max, v, 0.0f32);
                    }
                }
            }
            found[g * TILE_PIXELS + thread] = v;
            found[(batch + g) * TILE_PIXELS + thread] = weight;
        }
        sync_cube();
        // Moments of v give everything about the shape.
        let mut sums = Array::<f32>::new(RECORD);
        #[unroll]
        for k in 0..RECORD {
            sums[k] = 0.0f32;
        }
        let mut absolute_x = 0.0f32;
        let mut absolute_y = 0.0f32;
        if own < count as usize {
            let at = RECORD * own;
            let dx = column - drawn[at + AT_X];
            let center_y = drawn[at + AT_Y];
            let (l1, l2, l3) = (drawn[at + AT_A], drawn[at + AT_B], drawn[at + AT_C]);
            // Sums over y, from the point of the column that is next to the centre: squares of thousands of pixels would leave nothing of the digits of v.
            let below = select(center_y > top, center_y, top);
            let nearest = select(below < top + SPAN, below, top + SPAN);
            let mut along = 0.0f32;
            let mut square = 0.0f32;
            for k in 0..batch {
                let pixel = k * groups + group;
                let row = top + (pixel / TILE) as f32;
                let y = row - nearest;
                let v = found[own * TILE_PIXELS + pixel];
                let weight = found[(batch + own) * TILE_PIXELS + pixel];
                sums[AT_OPACITY] += v;
                along += v * y;
                square += v * y * y;
                #[unroll]
                for c in 0..4usize {
                    sums[AT_COLOR + c] += weight * of_image[c * TILE_PIXELS + pixel];
                }
                if comptime!(absolute) {
                    // The factors 2 l1 and 2 follow after the sums.
                    let dy = row - center_y;
                    let u = l1 * dx + l2 * dy;
                    absolute_x += (v * u).abs();
                    absolute_y += (v * (l2 * u + l3 * l3 * dy)).abs();
                }
            }
            // u and t at that point, and the moments about it.
            let offset = nearest - center_y;
            let (u0, t0) = (l1 * dx + l2 * offset, l3 * offset);
            let (own_u, own_t) = (l2 * along, l3 * along);
            let (u, t) = (u0 * sums[AT_OPACITY] + own_u, t0 * sums[AT_OPACITY] + own_t);
            sums[AT_X] = u;
            sums[AT_Y] = t;
            sums[AT_A] = l2 * l2 * square + u0 * (own_u + u);
            sums[AT_B] = l2 * l3 * square + u0 * own_t + t0 * u;
            sums[AT_C] = l3 * l3 * square + t0 * (own_t + t);
            if comptime!(absolute) {
                absolute_x *= 2.0 * l1;
                absolute_y *= 2.0f32;
            }
        }
        sync_cube();
        #[unroll]
        for k in 0..RECORD {
            found[k * COLUMN + thread] = sums[k];
        }
        sync_cube();
        if thread < RECORD * count as usize {
            let (g, k) = (thread / RECORD, thread % RECORD);
            let mut sum = 0.0f32;
            for part in 0..groups {
                sum += found[k * COLUMN + g * groups + part];
            }
            records[width_of_record * pairs[g] as usize + k] = sum;
        }
        if comptime!(absolute) {
            sync_cube();
            found[thread] = absolute_x;
            found[COLUMN + thread] = absolute_y;
            sync_cube();
            if thread < 2 * count as usize {
                let (g, k) = (thread / 2, thread % 2);
                let mut sum = 0.0f32;
                for part in 0..groups {
                    sum += found[k * COLUMN + g * groups + part];
                }
                records[width_of_record * pairs[g] as usize + RECORD + k] = sum;
            }
        }
        sync_cube();
        i = first;
    }
}
