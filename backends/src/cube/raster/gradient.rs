//! From gradient records to the gradients of the parameters, one Gaussian per unit.

use super::geometry::{CENTER, project, project_backward};
use super::harmonics::{basis, basis_backward};
use super::project::{KEYS, SPLAT, activated_opacity, activated_scales, quaternion, view_direction};
use super::vector::{add, dot, load3, scale, v3};
use crate::cpu::raster::RECORD;
use cubecl::prelude::*;

/// Columns of the screen gradients: those of a record, then of the offset from the camera (through the view direction).
pub const SCREEN: usize = RECORD + 3;
/// Columns of the geometry's gradients: centre, scales, quaternion, opacity, camera rotation, camera translation.
pub const GEOMETRY: usize = 3 + 3 + 4 + 1 + 12;

/// Adds up the records of each Gaussian, in the order of its tiles, and turns moments into gradients: screen [N,13].
#[cube(launch)]
pub fn sum_records(records: &[f32], start_of_gaussian: &[u32], keys: &[u32], splats: &[f32], screen: &mut [f32]) {
    let i = ABSOLUTE_POS;
    if i < start_of_gaussian.len() {
        let mut sums = Array::<f32>::new(10usize);
        #[unroll]
        for k in 0..10usize {
            sums[k] = 0.0;
        }
        let start = start_of_gaussian[i];
        let count = keys[KEYS * i + 1];
        for pair in start..start + count {
            #[unroll]
            for k in 0..10usize {
                sums[k] += records[RECORD * pair as usize + k];
            }
        }
        let to = SCREEN * i;
        if count > 0 {
            let at = SPLAT * i;
            let (half_a, b, half_c) = (splats[at + 2], splats[at + 3], splats[at + 4]);
            screen[to] = 2.0 * half_a * sums[0] + b * sums[1];
            screen[to + 1] = b * sums[0] + 2.0 * half_c * sums[1];
            screen[to + 2] = -0.5f32 * sums[2];
            screen[to + 3] = -sums[3];
            screen[to + 4] = -0.5f32 * sums[4];
            screen[to + 5] = sums[5] / splats[at + 5];
            #[unroll]
            for k in 6..10usize {
                screen[to + k] = sums[k];
            }
        } else {
            #[unroll]
            for k in 0..10usize {
                screen[to + k] = 0.0;
            }
        }
        #[unroll]
        for k in 10..13usize {
            screen[to + k] = 0.0;
        }
    }
}

/// Gradients of the degree-0 coefficients (or colours) [N,3] and of the higher ones [N,K,3], for `count` Gaussians from `first` on, whose higher coefficients
/// `sh_rest` and `d_rest` hold; that of the offset goes to the screen gradients.
#[cube(launch)]
pub fn color_backward(
    means: &[f32],
    sh_rest: &[f32],
    cam: &[f32],
    splats: &[f32],
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
        let from = SCREEN * i + 6;
        let mut red = screen[from];
        let mut green = screen[from + 1];
        let mut blue = screen[from + 2];
        if comptime!(harmonics) {
            let seen = red != 0.0 || green != 0.0 || blue != 0.0;
            // What was clamped at zero passes nothing.
            let at = SPLAT * i + 6;
            let d = v3(select(splats[at] > 0.0, red, 0.0f32), select(splats[at + 1] > 0.0, green, 0.0f32), select(splats[at + 2] > 0.0, blue, 0.0f32));
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
                    screen[SCREEN * i + 10] = (g.x - direction.x * along) * inverse;
                    screen[SCREEN * i + 11] = (g.y - direction.y * along) * inverse;
                    screen[SCREEN * i + 12] = (g.z - direction.z * along) * inverse;
                }
            }
        }
        d_colors[3 * i] = red;
        d_colors[3 * i + 1] = green;
        d_colors[3 * i + 2] = blue;
    }
}

/// Gradients of centre, scales, quaternion, opacity and camera from those on the screen: [N,23].
#[cube(launch)]
pub fn geometry_backward(
    means: &[f32],
    scales: &[f32],
    quaternions: &[f32],
    opacities: &[f32],
    cam: &[f32],
    keys: &[u32],
    screen: &[f32],
    out: &mut [f32],
    gaussians: u32,
    #[comptime] raw: bool,
    #[comptime] antialiased: bool,
) {
    let i = ABSOLUTE_POS;
    if i < gaussians as usize {
        let to = GEOMETRY * i;
        if keys[KEYS * i + 1] > 0 {
            let from = SCREEN * i;
            let mean = load3(means, 3 * i);
            let s = activated_scales(scales, i, raw);
            let opacity = activated_opacity(opacities, i, raw);
            let p = project(cam, mean, quaternion(quaternions, i), s);
            let mut d_opacity = screen[from + 5];
            let mut d_compensation = 0.0f32;
            if comptime!(antialiased) {
                d_compensation = d_opacity * opacity;
                d_opacity *= p.compensation;
            }
            let d = project_backward(cam, mean, s, p, screen[from], screen[from + 1], load3(screen, from + 2), screen[from + 9], d_compensation);
            let mut scale_x = d.scales.x;
            let mut scale_y = d.scales.y;
            let mut scale_z = d.scales.z;
            if comptime!(raw) {
                d_opacity *= opacity * (1.0 - opacity);
                scale_x *= s.x;
                scale_y *= s.y;
                scale_z *= s.z;
            }
            let d_mean = add(d.mean, load3(screen, from + 10));
            out[to] = d_mean.x;
            out[to + 1] = d_mean.y;
            out[to + 2] = d_mean.z;
            out[to + 3] = scale_x;
            out[to + 4] = scale_y;
            out[to + 5] = scale_z;
            out[to + 6] = d.quaternion.w;
            out[to + 7] = d.quaternion.x;
            out[to + 8] = d.quaternion.y;
            out[to + 9] = d.quaternion.z;
            out[to + 10] = d_opacity;
            out[to + 11] = d.camera0.x;
            out[to + 12] = d.camera0.y;
            out[to + 13] = d.camera0.z;
            out[to + 14] = d.camera1.x;
            out[to + 15] = d.camera1.y;
            out[to + 16] = d.camera1.z;
            out[to + 17] = d.camera2.x;
            out[to + 18] = d.camera2.y;
            out[to + 19] = d.camera2.z;
            out[to + 20] = d.translation.x;
            out[to + 21] = d.translation.y;
            out[to + 22] = d.translation.z;
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

/// Sums of columns over rows, in order, and of products over pixels: one unit per result, for the few that are asked for.
#[cube(launch)]
pub fn sum_rows(from: &[f32], to: &mut [f32], rows: u32, stride: u32, first: u32) {
    if ABSOLUTE_POS < to.len() {
        let mut sum = 0.0f32;
        let mut lost = 0.0f32;
        for row in 0..rows as usize {
            // Kahan's compensation: hundreds of thousands of terms go into one number.
            let value = from[row * stride as usize + first as usize + ABSOLUTE_POS] - lost;
            let next = sum + value;
            lost = (next - sum) - value;
            sum = next;
        }
        to[ABSOLUTE_POS] = sum;
    }
}

/// Gradient of the background [3]: transmittance left times upstream colour, summed over pixels.
#[cube(launch)]
pub fn background_backward(state: &[f32], upstream: &[f32], to: &mut [f32], pixels: u32) {
    if ABSOLUTE_POS < 3usize {
        let mut sum = 0.0f32;
        let mut lost = 0.0f32;
        for at in 0..pixels as usize {
            let value = state[at] * upstream[ABSOLUTE_POS * pixels as usize + at] - lost;
            let next = sum + value;
            lost = (next - sum) - value;
            sum = next;
        }
        to[ABSOLUTE_POS] = sum;
    }
}
