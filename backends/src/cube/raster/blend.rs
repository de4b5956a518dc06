//! Front-to-back blending, a unit per pixel and a cube per tile, and its back-to-front derivative.

use super::project::SPLAT;
use crate::cpu::raster::camera::{ALPHA_MIN, TRANSMITTANCE_STOP};
use crate::cpu::raster::{RECORD, TILE, TILE_PIXELS};
use cubecl::prelude::*;

const SIDE: u32 = TILE as u32;
/// Sums are taken in parts of this many pixels, then over the parts: the order is fixed, and no unit adds more than a few numbers.
const PART: usize = 16;
const PARTS: usize = TILE_PIXELS / PART;

/// Alpha of a Gaussian at an offset from its centre before its cap; 0 where it is not drawn.
#[cube]
fn full_alpha(splats: &[f32], at: usize, dx: f32, dy: f32) -> f32 {
    let sigma = splats[at + 2] * dx * dx + splats[at + 3] * dx * dy + splats[at + 4] * dy * dy;
    let alpha = splats[at + 5] * (-sigma).exp();
    select(sigma >= 0.0 && alpha >= ALPHA_MIN, alpha, 0.0f32)
}

/// Planes [5,H,W]; per pixel the transmittance left and the place in the list where it stopped, as bits [2,H,W]; largest weights [N] if wanted.
#[cube(launch)]
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
    let tile = CUBE_POS as u32;
    let x = tile % tiles_x * SIDE + UNIT_POS % SIDE;
    let y = tile / tiles_x * SIDE + UNIT_POS / SIDE;
    if x < width && y < height {
        let end = starts[tile as usize + 1];
        let mut i = starts[tile as usize];
        let mut left = 1.0f32;
        let mut red = 0.0f32;
        let mut green = 0.0f32;
        let mut blue = 0.0f32;
        let mut depth = 0.0f32;
        let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
        let mut running = true;
        while running && i < end {
            let gaussian = gaussian_of_pair[sorted[i as usize] as usize] as usize;
            let at = SPLAT * gaussian;
            let full = full_alpha(splats, at, px - splats[at], py - splats[at + 1]);
            if full > 0.0 {
                let alpha = select(full < alpha_max, full, alpha_max);
                let after = left - alpha * left;
                if after <= TRANSMITTANCE_STOP {
                    running = false;
                } else {
                    let weight = alpha * left;
                    red += weight * splats[at + 6];
                    green += weight * splats[at + 7];
                    blue += weight * splats[at + 8];
                    depth += weight * splats[at + 9];
                    left = after;
                    if comptime!(wants_weights) {
                        // Weights are positive, so their bits order like the numbers, and a maximum has no order.
                        weights[gaussian].fetch_max(u32::reinterpret(weight));
                    }
                }
            }
            if running {
                i += 1;
            }
        }
        let pixels = (width * height) as usize;
        let at = (y * width + x) as usize;
        planes[at] = red + left * background[0];
        planes[at + pixels] = green + left * background[1];
        planes[at + 2 * pixels] = blue + left * background[2];
        planes[at + 3 * pixels] = 1.0 - left;
        planes[at + 4 * pixels] = depth;
        state[at] = left;
        state[at + pixels] = f32::reinterpret(i);
    }
}

/// Gradient records of all pairs: centre (2), A, B, C, opacity, colour (3), depth. With q_i the upstream gradient of what Gaussian i shows at a pixel and S_i
/// the part of the loss behind it, d loss / d alpha_i = T_i q_i - S_i / (1 - alpha_i).
#[cube(launch)]
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
) {
    let mut parts = Shared::<[f32]>::new_slice(RECORD * TILE_PIXELS);
    let mut sums = Shared::<[f32]>::new_slice(RECORD * PARTS);
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
    while i > start {
        i -= 1;
        let pair = sorted[i as usize] as usize;
        let at = SPLAT * gaussian_of_pair[pair] as usize;
        let (dx, dy) = (px - splats[at], py - splats[at + 1]);
        let mut v = 0.0f32;
        let mut weight = 0.0f32;
        if i < stop {
            let full = full_alpha(splats, at, dx, dy);
            if full > 0.0 {
                let alpha = select(full < alpha_max, full, alpha_max);
                let inverse = 1.0 / (1.0 - alpha);
                left *= inverse;
                weight = alpha * left;
                let q = splats[at + 6] * g_red + splats[at + 7] * g_green + splats[at + 8] * g_blue + splats[at + 9] * g_depth;
                let d_alpha = left * q - behind * inverse;
                behind += weight * q;
                // d alpha / d sigma = -alpha, uncapped.
                v = full * d_alpha;
                if comptime!(!pass_capped) {
                    v = select(full <= alpha_max, v, 0.0f32);
                }
            }
        }
        // v is -d loss / d sigma; moments of it give everything about the shape.
        parts[unit] = v * dx;
        parts[unit + TILE_PIXELS] = v * dy;
        parts[unit + 2 * TILE_PIXELS] = v * dx * dx;
        parts[unit + 3 * TILE_PIXELS] = v * dx * dy;
        parts[unit + 4 * TILE_PIXELS] = v * dy * dy;
        parts[unit + 5 * TILE_PIXELS] = v;
        parts[unit + 6 * TILE_PIXELS] = weight * g_red;
        parts[unit + 7 * TILE_PIXELS] = weight * g_green;
        parts[unit + 8 * TILE_PIXELS] = weight * g_blue;
        parts[unit + 9 * TILE_PIXELS] = weight * g_depth;
        sync_cube();
        if unit < RECORD * PARTS {
            let mut sum = 0.0f32;
            for k in 0..PART {
                sum += parts[unit * PART + k];
            }
            sums[unit] = sum;
        }
        sync_cube();
        if unit < RECORD {
            let mut sum = 0.0f32;
            for k in 0..PARTS {
                sum += sums[unit * PARTS + k];
            }
            records[RECORD * pair + unit] = sum;
        }
        sync_cube();
    }
}
