//! From Gaussians to the visible ones on the screen: activation, projection, culling, colour.

use super::cells::{cells_met, cells_of};
use super::geometry::{CENTER, NEAR, Projected, SIZE, project, sorting_depth};
use super::harmonics::basis;
use super::vector::{V3, V4, add, dot, load3, scale, store3, v3};
use crate::cube::tensor::is_finite;
use crate::ops::rasterize::camera::{ALPHA_MIN, FAR, SHORTEST_QUATERNION};
use crate::ops::rasterize::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, RECORD, TILE};
use cubecl::prelude::*;

/// Columns of what sorting needs of a Gaussian, and of which of its colours are clamped.
pub const KEYS: usize = 6;
/// Column of the depth key.
pub const KEY_DEPTH: usize = 0;
/// Column of the number of tiles.
pub const KEY_TILES: usize = 1;
/// Column of the first and end tile along x, packed in halves.
pub const KEY_COLUMNS: usize = 2;
/// Column of the first and end tile along y, packed in halves.
pub const KEY_ROWS: usize = 3;
/// Column of the channels that were negative and are clamped at zero: 1 for red, 2 for green, 4 for blue. Colours cannot say it themselves: 0 may be exact, and
/// compilers may ignore the sign of a zero.
pub const KEY_CLAMPED: usize = 4;
/// Column of the cells that the footprint meets ([`cells_met`]).
pub const KEY_CELLS: usize = 5;
/// Sigma by which footprints are enlarged, so that rounding never cuts off a pixel that blending would count.
const CUTOFF_MARGIN: f32 = 0.005;
/// Colours of this size and above count as infinite: their sums could overflow.
const COLOR_LIMIT: f32 = 1e20;
const TILE_SIDE: u32 = TILE as u32;
const TILE_LENGTH: f32 = TILE as f32;

/// Linear scales of a Gaussian.
#[cube]
pub fn activated_scales(scales: &[f32], i: usize, #[comptime] raw: bool) -> V3 {
    let s = load3(scales, 3 * i);
    if comptime!(raw) { v3(s.x.exp(), s.y.exp(), s.z.exp()) } else { s }
}

/// Opacity in 0..1 of a Gaussian.
#[cube]
pub fn activated_opacity(opacities: &[f32], i: usize, #[comptime] raw: bool) -> f32 {
    let o = opacities[i];
    if comptime!(raw) { 1.0 / (1.0 + (-o).exp()) } else { o }
}

/// The raw quaternion of a Gaussian.
#[cube]
pub fn quaternion(quaternions: &[f32], i: usize) -> V4 {
    V4 { w: quaternions[4 * i], x: quaternions[4 * i + 1], y: quaternions[4 * i + 2], z: quaternions[4 * i + 3] }
}

/// First and end tile of pixels from `low` to `high`, packed in halves; empty where nothing of the image is met.
#[cube]
fn tiles_of_span(low: f32, high: f32, size: f32) -> u32 {
    let first = (low - 0.5).ceil();
    let last = (high - 0.5).floor();
    let mut packed = 0u32;
    if last >= 0.0 && first <= size - 1.0 && first <= last {
        let from = select(first > 0.0, first, 0.0f32);
        let to = select(last < size - 1.0, last, size - 1.0);
        packed = (from as u32 / TILE_SIDE) | ((to as u32 / TILE_SIDE + 1) << 16);
    }
    packed
}

/// Tiles of Inria's getRect along one axis, packed in halves.
#[cube]
fn tiles_of_square(center: f32, radius: f32, size: f32) -> u32 {
    // Inria counts pixels from their centres: column 0 is at 0, not at 0.5.
    let tiles = ((size + TILE_LENGTH - 1.0) / TILE_LENGTH).floor();
    let low = (center - 0.5 - radius) / TILE_LENGTH;
    let high = (center - 0.5 + radius + TILE_LENGTH - 1.0) / TILE_LENGTH;
    let first = select(low > 0.0, select(low < tiles, low, tiles), 0.0f32);
    let end = select(high > 0.0, select(high < tiles, high, tiles), 0.0f32);
    (first as u32) | ((end as u32) << 16)
}

/// The overlap of two packed ranges.
#[cube]
fn overlap(a: u32, b: u32) -> u32 {
    let (a0, a1, b0, b1) = (a & 0xffffu32, a >> 16, b & 0xffffu32, b >> 16);
    select(a0 > b0, a0, b0) | (select(a1 < b1, a1, b1) << 16)
}

#[cube]
fn length_of(range: u32) -> u32 {
    let (first, end) = (range & 0xffffu32, range >> 16);
    select(end > first, end - first, 0u32)
}

/// Whether scales and opacity of a Gaussian are finite as they are stored: a log-scale of -infinity is a scale of 0, and a logit of infinity an opacity of 1.
#[cube]
fn stored_finite(scales: &[f32], opacities: &[f32], i: usize) -> bool {
    let s = load3(scales, 3 * i);
    is_finite(s.x) && is_finite(s.y) && is_finite(s.z) && is_finite(opacities[i])
}

#[cube]
fn all_finite(mean: V3, s: V3, q: V4, opacity: f32, p: Projected) -> bool {
    is_finite(mean.x)
        && is_finite(mean.y)
        && is_finite(mean.z)
        && is_finite(s.x)
        && is_finite(s.y)
        && is_finite(s.z)
        && is_finite(q.w)
        && is_finite(q.x)
        && is_finite(q.y)
        && is_finite(q.z)
        && is_finite(opacity)
        && is_finite(p.determinant)
        && is_finite(p.center_x)
        && is_finite(p.center_y)
}

/// Screen records `[N,10]` with the radius (0 if culled) in place of the colour, which [`color_gaussians`] adds; sorting keys `[N,6]`.
#[cube(launch)]
pub fn project_gaussians(
    means: &[f32],
    scales: &[f32],
    quaternions: &[f32],
    opacities: &[f32],
    cam: &[f32],
    splats: &mut [f32],
    keys: &mut [u32],
    gaussians: u32,
    #[comptime] raw: bool,
    #[comptime] antialiased: bool,
    #[comptime] square: bool,
) {
    let i = ABSOLUTE_POS;
    if i < gaussians as usize {
        let mean = load3(means, 3 * i);
        let s = activated_scales(scales, i, raw);
        let q = quaternion(quaternions, i);
        let p = project(cam, mean, q, s);
        let mut opacity = activated_opacity(opacities, i, raw);
        if comptime!(antialiased) {
            opacity *= p.compensation;
        }
        // Twice the sigma at which alpha falls to 1/255.
        let strength = opacity * 255.0;
        let reach = (select(strength > 1e-30, strength, 1e-30f32).ln() + CUTOFF_MARGIN) * 2.0;
        let kept_reach = select(reach > 0.0, reach, 0.0f32);
        let half_width = (kept_reach * p.xx).sqrt();
        let half_height = (kept_reach * p.yy).sqrt();
        let (width, height) = (cam[SIZE], cam[SIZE + 1]);
        let mut radius = (select(p.xx > p.yy, p.xx, p.yy).sqrt() * 3.33).ceil();
        if comptime!(square) {
            let (mid, half) = ((p.xx + p.yy) * 0.5, (p.xx - p.yy) * 0.5);
            let spread = half * half + p.xy * p.xy;
            radius = ((mid + select(spread > 0.1, spread, 0.1f32).sqrt()).sqrt() * 3.0).ceil();
        }
        let mut columns = tiles_of_span(p.center_x - half_width, p.center_x + half_width, width);
        let mut rows = tiles_of_span(p.center_y - half_height, p.center_y + half_height, height);
        let seen = all_finite(mean, s, q, opacity, p)
            && stored_finite(scales, opacities, i)
            && is_finite(half_width)
            && is_finite(half_height)
            && p.point.z > cam[NEAR]
            && p.point.z < FAR
            && p.norm_squared > SHORTEST_QUATERNION
            && opacity >= ALPHA_MIN
            && reach > 0.0
            && p.center_x + half_width >= 0.5
            && p.center_x - half_width <= width - 0.5
            && p.center_y + half_height >= 0.5
            && p.center_y - half_height <= height - 0.5;
        let depth = sorting_depth(cam, mean);
        let mut drawn = seen && depth > 0.0;
        if comptime!(square) {
            let square_columns = tiles_of_square(p.center_x, radius, width);
            let square_rows = tiles_of_square(p.center_y, radius, height);
            drawn = drawn && length_of(square_columns) > 0 && length_of(square_rows) > 0;
            columns = overlap(columns, square_columns);
            rows = overlap(rows, square_rows);
        }
        let at = RECORD * i;
        splats[at + AT_X] = p.center_x;
        splats[at + AT_Y] = p.center_y;
        splats[at + AT_A] = p.factors.x;
        splats[at + AT_B] = p.factors.y;
        splats[at + AT_C] = p.factors.z;
        splats[at + AT_OPACITY] = opacity;
        splats[at + AT_DEPTH] = depth;
        let key = KEYS * i;
        // Depths are positive, so their bits order like the numbers.
        keys[key + KEY_DEPTH] = select(drawn, u32::reinterpret(depth), 0xffff_ffffu32);
        let mut tiles = 0u32;
        let mut met = 0u32;
        if drawn && length_of(columns) > 0 && length_of(rows) > 0 {
            let found = cells_met(cells_of(columns, rows), p, reach * 0.5);
            met = found.cells;
            tiles = found.tiles;
        }
        keys[key + KEY_TILES] = tiles;
        keys[key + KEY_CELLS] = met;
        keys[key + KEY_COLUMNS] = columns;
        keys[key + KEY_ROWS] = rows;
        keys[key + KEY_CLAMPED] = 0u32;
        // Integer radii stay below 2^31, as in Inria's code.
        splats[at + AT_COLOR] = select(drawn, select(radius < 1e9, radius, 1e9f32), 0.0f32);
    }
}

/// Unit direction from the camera centre to `mean`.
#[cube]
pub fn view_direction(cam: &[f32], mean: V3) -> V3 {
    let offset = add(mean, scale(load3(cam, CENTER), -1.0f32));
    scale(offset, 1.0 / dot(offset, offset).sqrt())
}

/// Colours into the screen records, and radii `[N]`, for `count` Gaussians from `first` on, whose coefficients `sh_rest` holds. Gaussians whose colour is not
/// finite are culled.
#[cube(launch)]
pub fn color_gaussians(
    means: &[f32],
    colors: &[f32],
    sh_rest: &[f32],
    cam: &[f32],
    splats: &mut [f32],
    keys: &mut [u32],
    radii: &mut [i32],
    first: u32,
    count: u32,
    rest_width: u32,
    #[comptime] degree: usize,
    #[comptime] harmonics: bool,
) {
    let row = ABSOLUTE_POS;
    let i = first as usize + row;
    if row < count as usize {
        let mut radius = splats[RECORD * i + AT_COLOR] as i32;
        if radius > 0 {
            let mut red = colors[3 * i];
            let mut green = colors[3 * i + 1];
            let mut blue = colors[3 * i + 2];
            if comptime!(harmonics) {
                let values = basis(view_direction(cam, load3(means, 3 * i)), degree);
                red = red * values[0] + 0.5;
                green = green * values[0] + 0.5;
                blue = blue * values[0] + 0.5;
                #[unroll]
                for k in 1..comptime!((degree + 1) * (degree + 1)) {
                    let at = row * rest_width as usize + 3 * (k - 1);
                    red += sh_rest[at] * values[k];
                    green += sh_rest[at + 1] * values[k];
                    blue += sh_rest[at + 2] * values[k];
                }
            }
            let finite =
                is_finite(red) && is_finite(green) && is_finite(blue) && red.abs() < COLOR_LIMIT && green.abs() < COLOR_LIMIT && blue.abs() < COLOR_LIMIT;
            if finite {
                if comptime!(harmonics) {
                    let (of_red, of_green, of_blue) = (select(red < 0.0, 1u32, 0u32), select(green < 0.0, 2u32, 0u32), select(blue < 0.0, 4u32, 0u32));
                    keys[KEYS * i + KEY_CLAMPED] = of_red | of_green | of_blue;
                    red = select(red > 0.0, red, 0.0f32);
                    green = select(green > 0.0, green, 0.0f32);
                    blue = select(blue > 0.0, blue, 0.0f32);
                }
                store3(splats, RECORD * i + AT_COLOR, v3(red, green, blue));
            } else {
                keys[KEYS * i + KEY_DEPTH] = 0xffff_ffffu32;
                keys[KEYS * i + KEY_TILES] = 0;
                radius = 0i32;
            }
        }
        radii[i] = radius;
    }
}
