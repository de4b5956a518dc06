//! From gradient records to the gradients of the parameters, one Gaussian per thread.

use super::geometry::{CENTER, project, project_backward};
use super::harmonics::{basis, basis_backward};
use super::project::{KEY_CLAMPED, KEY_TILES, KEYS, activated_opacity, activated_scales, quaternion, view_direction};
use super::vector::{V3, add, dot, load3, scale, store3, v3};
use crate::cube::tensor::{THREADS, compensated_sum, sum_of_threads};
use crate::ops::rasterize::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, RECORD};
use cubecl::prelude::*;

/// Columns of the screen gradients: those of a record, then three for the offset from the camera (through the view direction), then [`AT_DRAWN`].
pub const SCREEN: usize = RECORD + 4;
/// First column of the gradient of the offset from the camera.
pub const AT_OFFSET: usize = RECORD;
/// Column that is 1 for Gaussians that meet a tile, else 0.
const AT_DRAWN: usize = RECORD + 3;

/// Columns of the geometry's gradients.
pub const GEOMETRY: usize = 23;
/// First of three columns of the centre in world units.
pub const OF_MEAN: usize = 0;
/// First of three columns of the scales.
pub const OF_SCALES: usize = 3;
/// First of four columns of the quaternion.
pub const OF_QUATERNION: usize = 6;
/// Column of the opacity.
pub const OF_OPACITY: usize = 10;
/// First of twelve columns of the camera: rotation by rows, translation.
pub const OF_CAMERA: usize = 11;

/// Adds up the records of each Gaussian, `stride` floats each, in the order of its tiles, and turns moments into gradients: screen `[N,14]`.
#[cube(launch)]
pub fn sum_records(records: &[f32], start_of_gaussian: &[u32], keys: &[u32], splats: &[f32], screen: &mut [f32], #[comptime] stride: usize) {
    let i = ABSOLUTE_POS;
    if i < start_of_gaussian.len() {
        let mut sums = Array::<f32>::new(RECORD);
        #[unroll]
        for k in 0..RECORD {
            sums[k] = 0.0f32;
        }
        let start = start_of_gaussian[i];
        let count = keys[KEYS * i + KEY_TILES];
        for pair in start..start + count {
            #[unroll]
            for k in 0..RECORD {
                sums[k] += records[stride * pair as usize + k];
            }
        }
        let to = SCREEN * i;
        if count > 0 {
            let at = RECORD * i;
            let (l1, l2, l3) = (splats[at + AT_A], splats[at + AT_B], splats[at + AT_C]);
            screen[to + AT_X] = 2.0 * l1 * sums[AT_X];
            screen[to + AT_Y] = 2.0 * (l2 * sums[AT_X] + l3 * sums[AT_Y]);
            screen[to + AT_A] = -sums[AT_A];
            screen[to + AT_B] = -sums[AT_B];
            screen[to + AT_C] = -sums[AT_C];
            screen[to + AT_OPACITY] = sums[AT_OPACITY] / splats[at + AT_OPACITY];
            #[unroll]
            for k in 0..4usize {
                screen[to + AT_COLOR + k] = sums[AT_COLOR + k];
            }
            // What was clamped at zero passes nothing.
            let clamped = keys[KEYS * i + KEY_CLAMPED];
            if (clamped & 1u32) != 0u32 {
                screen[to + AT_COLOR] = 0.0;
            }
            if (clamped & 2u32) != 0u32 {
                screen[to + AT_COLOR + 1] = 0.0;
            }
            if (clamped & 4u32) != 0u32 {
                screen[to + AT_COLOR + 2] = 0.0;
            }
            screen[to + AT_DRAWN] = 1.0;
        } else {
            #[unroll]
            for k in 0..RECORD {
                screen[to + k] = 0.0;
            }
            screen[to + AT_DRAWN] = 0.0;
        }
        store3(screen, to + AT_OFFSET, v3(0.0, 0.0, 0.0));
    }
}

/// The absolute gradients of the centres `[N,2]`, from the end of records of `stride` floats, in the order of each Gaussian's tiles.
#[cube(launch)]
pub fn sum_absolute(records: &[f32], start_of_gaussian: &[u32], keys: &[u32], out: &mut [f32], #[comptime] stride: usize) {
    let i = ABSOLUTE_POS;
    if i < start_of_gaussian.len() {
        let start = start_of_gaussian[i];
        let mut x = 0.0f32;
        let mut y = 0.0f32;
        for pair in start..start + keys[KEYS * i + KEY_TILES] {
            x += records[stride * pair as usize + RECORD];
            y += records[stride * pair as usize + RECORD + 1];
        }
        out[2 * i] = x;
        out[2 * i + 1] = y;
    }
}

/// Gradients of the degree-0 coefficients (or colours) `[N,3]` and of the higher ones `[N,K,3]`, for `count` Gaussians from `first` on, whose higher
/// coefficients `sh_rest` and `d_rest` hold; that of the offset goes to the screen gradients.
#[cube(launch)]
pub fn color_backward(
    means: &[f32],
    sh_rest: &[f32],
    cam: &[f32],
    screen: &mut [f32],
    d_colors: &mut [f32],
    d_rest: &mut [f32],
    first: u32,
    count: u32,
    rest_width: u32,
    #[comptime] degree: usize,
    #[comptime] harmonics: bool,
    #[comptime] wants_rest: bool,
) {
    let row = ABSOLUTE_POS;
    let i = first as usize + row;
    if row < count as usize {
        let from = SCREEN * i + AT_COLOR;
        let mut red = screen[from];
        let mut green = screen[from + 1];
        let mut blue = screen[from + 2];
        if comptime!(harmonics) {
            let seen = red != 0.0 || green != 0.0 || blue != 0.0;
            let d = v3(screen[from], screen[from + 1], screen[from + 2]);
            red = 0.0;
            green = 0.0;
            blue = 0.0;
            if comptime!(wants_rest) {
                for k in 0..rest_width as usize {
                    d_rest[row * rest_width as usize + k] = 0.0;
                }
            }
            let mean = load3(means, 3 * i);
            if seen {
                let direction = view_direction(cam, mean);
                let values = basis(direction, degree);
                red = d.x * values[0];
                green = d.y * values[0];
                blue = d.z * values[0];
                let mut h = Array::<f32>::new(25usize);
                #[unroll]
                for k in 1..comptime!((degree + 1) * (degree + 1)) {
                    let at = row * rest_width as usize + 3 * (k - 1);
                    h[k] = dot(load3(sh_rest, at), d);
                    if comptime!(wants_rest) {
                        d_rest[at] = values[k] * d.x;
                        d_rest[at + 1] = values[k] * d.y;
                        d_rest[at + 2] = values[k] * d.z;
                    }
                }
                if comptime!(degree > 0) {
                    let g = basis_backward(direction, &h, degree);
                    let offset = add(mean, scale(load3(cam, CENTER), -1.0f32));
                    let inverse = 1.0 / dot(offset, offset).sqrt();
                    let along = dot(direction, g);
                    let offset_at = SCREEN * i + AT_OFFSET;
                    screen[offset_at] = (g.x - direction.x * along) * inverse;
                    screen[offset_at + 1] = (g.y - direction.y * along) * inverse;
                    screen[offset_at + 2] = (g.z - direction.z * along) * inverse;
                }
            }
        }
        d_colors[3 * i] = red;
        d_colors[3 * i + 1] = green;
        d_colors[3 * i + 2] = blue;
    }
}

/// Gradients of centre, scales, quaternion, opacity and camera from those on the screen: `[N,23]`.
#[cube(launch)]
pub fn geometry_backward(
    means: &[f32],
    scales: &[f32],
    quaternions: &[f32],
    opacities: &[f32],
    cam: &[f32],
    screen: &[f32],
    out: &mut [f32],
    gaussians: u32,
    #[comptime] raw: bool,
    #[comptime] antialiased: bool,
) {
    let i = ABSOLUTE_POS;
    if i < gaussians as usize {
        let to = GEOMETRY * i;
        let from = SCREEN * i;
        if screen[from + AT_DRAWN] > 0.0 {
            let mean = load3(means, 3 * i);
            let s = activated_scales(scales, i, raw);
            let opacity = activated_opacity(opacities, i, raw);
            let p = project(cam, mean, quaternion(quaternions, i), s);
            let mut d_opacity = screen[from + AT_OPACITY];
            let mut d_compensation = 0.0f32;
            if comptime!(antialiased) {
                d_compensation = d_opacity * opacity;
                d_opacity *= p.compensation;
            }
            let moments = load3(screen, from + AT_A);
            let d = project_backward(cam, mean, s, p, screen[from + AT_X], screen[from + AT_Y], moments, screen[from + AT_DEPTH], d_compensation);
            let mut scale_x = d.scales.x;
            let mut scale_y = d.scales.y;
            let mut scale_z = d.scales.z;
            if comptime!(raw) {
                d_opacity *= opacity * (1.0 - opacity);
                scale_x *= s.x;
                scale_y *= s.y;
                scale_z *= s.z;
            }
            store3(out, to + OF_MEAN, add(d.mean, load3(screen, from + AT_OFFSET)));
            store3(out, to + OF_SCALES, V3 { x: scale_x, y: scale_y, z: scale_z });
            out[to + OF_QUATERNION] = d.quaternion.w;
            out[to + OF_QUATERNION + 1] = d.quaternion.x;
            out[to + OF_QUATERNION + 2] = d.quaternion.y;
            out[to + OF_QUATERNION + 3] = d.quaternion.z;
            out[to + OF_OPACITY] = d_opacity;
            store3(out, to + OF_CAMERA, d.camera0);
            store3(out, to + OF_CAMERA + 3, d.camera1);
            store3(out, to + OF_CAMERA + 6, d.camera2);
            store3(out, to + OF_CAMERA + 9, d.translation);
        } else {
            for k in 0..GEOMETRY {
                out[to + k] = 0.0;
            }
        }
    }
}

/// Columns `first` to `first + width` of rows of `stride` floats.
#[cube(launch)]
pub fn take_columns(from: &[f32], to: &mut [f32], stride: u32, first: u32, width: u32) {
    if ABSOLUTE_POS < to.len() {
        let (row, column) = (ABSOLUTE_POS / width as usize, ABSOLUTE_POS % width as usize);
        to[ABSOLUTE_POS] = from[row * stride as usize + first as usize + column];
    }
}

/// Sums of columns over rows, in a fixed order: one workgroup per column, for few columns.
#[cube(launch)]
pub fn sum_rows(from: &[f32], to: &mut [f32], rows: u32, stride: u32, first: u32) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let mut sum = 0.0f32;
    let mut lost = 0.0f32;
    let mut row = UNIT_POS as usize;
    while row < rows as usize {
        // Compensated, because hundreds of thousands of terms go into one number.
        let (next, rest) = compensated_sum(sum, lost, from[row * stride as usize + first as usize + CUBE_POS]);
        sum = next;
        lost = rest;
        row += THREADS as usize;
    }
    let total = sum_of_threads(&mut sums, sum);
    if UNIT_POS == 0 && CUBE_POS < to.len() {
        to[CUBE_POS] = total;
    }
}

/// Gradient of the camera matrix `[4,4]`, row-major, as `CameraSums::matrix_gradient` finds it: from the sums of the gradients of rotation and translation
/// `[12]` and of the offsets from the camera `[3]`, and the inverse of the matrix `[4,4]`.
#[cube(launch)]
pub fn camera_matrix(of_camera: &[f32], of_offset: &[f32], inverse: &[f32], out: &mut [f32]) {
    if ABSOLUTE_POS < out.len() {
        let (row, column) = (ABSOLUTE_POS / 4, ABSOLUTE_POS % 4);
        let mut sum = 0.0f32;
        if row < 3 {
            let at = select(column < 3, 3 * row + column, row + 9);
            sum = of_camera[at];
        }
        // The centre is the last column of the inverse, and d inverse = -inverse dM inverse; offsets shrink as the centre grows.
        let mut through = 0.0f32;
        #[unroll]
        for k in 0..3usize {
            through += inverse[4 * k + row] * of_offset[k];
        }
        out[ABSOLUTE_POS] = sum + through * inverse[4 * column + 3];
    }
}

/// Gradient of the background `[3]`: transmittance left times upstream colour, summed over pixels by one workgroup per channel.
#[cube(launch)]
pub fn background_backward(state: &[u32], upstream: &[f32], to: &mut [f32], pixels: u32) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let mut sum = 0.0f32;
    let mut lost = 0.0f32;
    let mut at = UNIT_POS as usize;
    while at < pixels as usize {
        let (next, rest) = compensated_sum(sum, lost, f32::reinterpret(state[at]) * upstream[CUBE_POS * pixels as usize + at]);
        sum = next;
        lost = rest;
        at += THREADS as usize;
    }
    let total = sum_of_threads(&mut sums, sum);
    if UNIT_POS == 0 && CUBE_POS < to.len() {
        to[CUBE_POS] = total;
    }
}
