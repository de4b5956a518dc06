//! EWA projection of one Gaussian and its derivative; the arithmetic of `cpu::raster::geometry`, one Gaussian per thread.

use super::vector::{V3, V4, add, combine, cross, dot, load3, scale, times, v3};
use crate::ops::rasterize::camera::{CameraConstants, MIN_COMPENSATION, QUATERNION_RANGE, RESCALE, RuleConstants};
use cubecl::prelude::*;
use std::f32::consts::FRAC_1_SQRT_2;

/// Index of the translation in the camera buffer, which starts with the rotation by rows.
pub const TRANSLATION: usize = 9;
/// Index of the camera centre.
pub const CENTER: usize = 12;
/// Index of the two focal lengths.
pub const FOCAL: usize = 15;
/// Index of the principal point.
pub const PRINCIPAL: usize = 17;
/// Index of the limits of x/z (2) and y/z (2).
pub const LIMITS: usize = 19;
/// Index of the near plane.
pub const NEAR: usize = 23;
/// Index of width and height.
pub const SIZE: usize = 24;
/// Index of the four numbers of the row that gives the depth.
const DEPTH: usize = 26;
/// Index of the rounding errors of these in float32.
const DEPTH_REST: usize = 30;
/// Index of a zero that compilers do not know, see [`rounded`].
const ZERO: usize = 34;
/// Index of the blur of a pixel.
const BLUR: usize = 35;
/// Mask of the upper half of a float32's significand; products of halves are exact.
const UPPER_HALF: u32 = 0xffff_f000;

/// The camera as the kernels read it.
pub fn camera_buffer(camera: &CameraConstants, rules: &RuleConstants, width: usize, height: usize) -> Vec<f32> {
    let mut values: Vec<f32> = camera.rotation.iter().flatten().copied().collect();
    values.extend(camera.translation);
    values.extend(camera.center);
    values.extend(camera.focal);
    values.extend(camera.principal);
    values.extend(camera.ratio_limits.iter().flatten());
    values.extend([rules.near, width as f32, height as f32]);
    values.extend(camera.depth_row.map(|v| v as f32));
    values.extend(camera.depth_row.map(|v| (v - f64::from(v as f32)) as f32));
    values.extend([0.0, camera.blur]);
    values
}

/// A projected Gaussian with everything its derivative needs.
#[derive(CubeType, Clone, Copy)]
pub struct Projected {
    pub point: V3,
    pub center_x: f32,
    pub center_y: f32,
    /// Covariance in square pixels with the blur.
    pub xx: f32,
    pub xy: f32,
    pub yy: f32,
    pub determinant: f32,
    pub raw_determinant: f32,
    /// l1, l2, l3 of sigma = (l1 dx + l2 dy)^2 + (l3 dy)^2.
    pub factors: V3,
    pub compensation: f32,
    pub norm_squared: f32,
    pub inverse_norm: f32,
    pub unit: V4,
    pub rotation0: V3,
    pub rotation1: V3,
    pub rotation2: V3,
    pub turned0: V3,
    pub turned1: V3,
    pub turned2: V3,
    pub scaled2: V3,
    pub row0: V3,
    pub row1: V3,
    pub inverse_depth: f32,
    pub ratio_x: f32,
    pub ratio_y: f32,
    /// 1 where the ratio was not clamped, else 0.
    pub inside_x: f32,
    pub inside_y: f32,
}

/// a b as an exact float32 and a small remainder, so that the result does not depend on whether a compiler fuses products with sums.
#[cube]
fn exact_product(a: f32, b: f32) -> (f32, f32) {
    let a_upper = f32::reinterpret(u32::reinterpret(a) & UPPER_HALF);
    let b_upper = f32::reinterpret(u32::reinterpret(b) & UPPER_HALF);
    let (a_lower, b_lower) = (a - a_upper, b - b_upper);
    (a_upper * b_upper, a_upper * b_lower + a_lower * b_upper + a_lower * b_lower)
}

/// `v`, behind an optimisation barrier, because some shader compilers simplify (a + b) - a to b (Mesa). `zero` is 0, but not known to the compiler.
#[cube]
fn rounded(v: f32, zero: u32) -> f32 {
    f32::reinterpret(u32::reinterpret(v) ^ zero)
}

/// a + b and its rounding error (Knuth).
#[cube]
fn exact_sum(a: f32, b: f32, zero: u32) -> (f32, f32) {
    let sum = rounded(a + b, zero);
    let of_b = rounded(sum - a, zero);
    let of_a = rounded(sum - of_b, zero);
    (sum, rounded(a - of_a, zero) + rounded(b - of_b, zero))
}

/// The depth of `mean`, rounded once, as [`CameraConstants::depth`] finds it in float64: about 36 bits before the rounding.
#[cube]
pub fn sorting_depth(cam: &[f32], mean: V3) -> f32 {
    let (x, x_rest) = exact_product(cam[DEPTH], mean.x);
    let (y, y_rest) = exact_product(cam[DEPTH + 1], mean.y);
    let (z, z_rest) = exact_product(cam[DEPTH + 2], mean.z);
    let zero = u32::reinterpret(cam[ZERO]);
    let (first, first_rest) = exact_sum(cam[DEPTH + 3], x, zero);
    let (second, second_rest) = exact_sum(first, y, zero);
    let (third, third_rest) = exact_sum(second, z, zero);
    let rest = cam[DEPTH_REST] * mean.x + cam[DEPTH_REST + 1] * mean.y + cam[DEPTH_REST + 2] * mean.z + cam[DEPTH_REST + 3];
    third + (x_rest + y_rest + z_rest + (first_rest + second_rest + third_rest) + rest)
}

#[cube]
fn clamp_to(v: f32, low: f32, high: f32) -> f32 {
    select(v < low, low, select(v > high, high, v))
}

/// Projects a Gaussian of centre `mean`, raw quaternion `q` and linear scales `s`.
#[cube]
pub fn project(cam: &[f32], mean: V3, q: V4, s: V3) -> Projected {
    let w0 = load3(cam, 0);
    let w1 = load3(cam, 3);
    let w2 = load3(cam, 6);
    let point = add(v3(dot(w0, mean), dot(w1, mean), dot(w2, mean)), load3(cam, TRANSLATION));
    let inverse_depth = 1.0 / point.z;
    // Squares of very short and very long quaternions leave the range of float32: a power of two brings them back, and rounds nothing.
    let first = q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z;
    let factor = select(first < 1.0 / QUATERNION_RANGE, RESCALE, select(first > QUATERNION_RANGE, 1.0 / RESCALE, 1.0f32));
    let r = V4 { w: q.w * factor, x: q.x * factor, y: q.y * factor, z: q.z * factor };
    let norm_squared = r.w * r.w + r.x * r.x + r.y * r.y + r.z * r.z;
    let inverse_length = 1.0 / norm_squared.sqrt();
    let unit = V4 { w: r.w * inverse_length, x: r.x * inverse_length, y: r.y * inverse_length, z: r.z * inverse_length };
    let inverse_norm = inverse_length * factor;
    let (w, x, y, z) = (unit.w, unit.x, unit.y, unit.z);
    let rotation0 = v3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y));
    let rotation1 = v3(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x));
    let rotation2 = v3(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y));
    let turned0 = combine(rotation0, w0.x, rotation1, w0.y, rotation2, w0.z);
    let turned1 = combine(rotation0, w1.x, rotation1, w1.y, rotation2, w1.z);
    let turned2 = combine(rotation0, w2.x, rotation1, w2.y, rotation2, w2.z);
    let scaled0 = times(turned0, s);
    let scaled1 = times(turned1, s);
    let scaled2 = times(turned2, s);
    let raw_x = point.x * inverse_depth;
    let raw_y = point.y * inverse_depth;
    let ratio_x = clamp_to(raw_x, cam[LIMITS], cam[LIMITS + 1]);
    let ratio_y = clamp_to(raw_y, cam[LIMITS + 2], cam[LIMITS + 3]);
    // J's third column is -f x / z^2 = -(f / z) (x / z).
    let row0 = scale(add(scaled0, scale(scaled2, -ratio_x)), inverse_depth * cam[FOCAL]);
    let row1 = scale(add(scaled1, scale(scaled2, -ratio_y)), inverse_depth * cam[FOCAL + 1]);
    let raw_xx = dot(row0, row0);
    let xy = dot(row0, row1);
    let raw_yy = dot(row1, row1);
    let normal = cross(row0, row1);
    let raw_determinant = dot(normal, normal);
    let determinant = raw_determinant + (raw_xx + raw_yy) * cam[BLUR] + cam[BLUR] * cam[BLUR];
    let inverse = 1.0 / determinant;
    let (xx, yy) = (raw_xx + cam[BLUR], raw_yy + cam[BLUR]);
    // Roots before they are divided: of a huge footprint the quotients of squares would leave the range of float32.
    let root = yy.sqrt();
    let l1 = FRAC_1_SQRT_2 * root / determinant.sqrt();
    let share = raw_determinant * inverse;
    let floor = MIN_COMPENSATION * MIN_COMPENSATION;
    Projected {
        point,
        center_x: raw_x * cam[FOCAL] + cam[PRINCIPAL],
        center_y: raw_y * cam[FOCAL + 1] + cam[PRINCIPAL + 1],
        xx,
        xy,
        yy,
        determinant,
        raw_determinant,
        factors: v3(l1, -(xy / yy * l1), FRAC_1_SQRT_2 / root),
        compensation: select(share > floor, share, floor).sqrt(),
        norm_squared,
        inverse_norm,
        unit,
        rotation0,
        rotation1,
        rotation2,
        turned0,
        turned1,
        turned2,
        scaled2,
        row0,
        row1,
        inverse_depth,
        ratio_x,
        ratio_y,
        inside_x: select(raw_x == ratio_x, 1.0f32, 0.0f32),
        inside_y: select(raw_y == ratio_y, 1.0f32, 0.0f32),
    }
}

/// Gradients of the inputs of [`project`].
#[derive(CubeType, Clone, Copy)]
pub struct GeometryGradient {
    pub mean: V3,
    pub quaternion: V4,
    pub scales: V3,
    /// d loss / d camera rotation, by rows, and translation.
    pub camera0: V3,
    pub camera1: V3,
    pub camera2: V3,
    pub translation: V3,
}

/// The derivative of [`project`]: upstream of centre in pixels, of depth and of the compensation; `moments` are sums over pixels of d loss / d sigma times u^2,
/// u t and t^2, where sigma = u^2 + t^2.
#[cube]
pub fn project_backward(cam: &[f32], mean: V3, s: V3, p: Projected, d_x: f32, d_y: f32, moments: V3, d_depth: f32, d_compensation: f32) -> GeometryGradient {
    let w0 = load3(cam, 0);
    let w1 = load3(cam, 3);
    let w2 = load3(cam, 6);
    let (fz_x, fz_y) = (p.inverse_depth * cam[FOCAL], p.inverse_depth * cam[FOCAL + 1]);
    // Projected axes of unit length in the world: row0 and row1 are these times the scales.
    let axes0 = scale(add(p.turned0, scale(p.turned2, -p.ratio_x)), fz_x);
    let axes1 = scale(add(p.turned1, scale(p.turned2, -p.ratio_y)), fz_y);
    let squared = times(s, s);
    // The adjugate of the unblurred covariance, times the axes. A needle's covariance nearly annihilates its own axis; written with cross products, nothing
    // cancels. With the blur and over the determinant, its first row is that of the conic K times the axes.
    let normal = cross(axes0, axes1);
    let adjugate0 = cross(times(axes1, squared), normal);
    let adjugate1 = cross(normal, times(axes0, squared));
    let inverse = 1.0 / p.determinant;
    // With L = ((l1, l2), (0, l3)): K = 2 L^T L and d covariance = -2 L^T Q L, where Q has the moments. L times the axes, from K times the axes.
    let (l1, l2, l3) = (p.factors.x, p.factors.y, p.factors.z);
    let seen0 = scale(add(scale(axes0, cam[BLUR]), adjugate0), inverse * 0.5 / l1);
    let seen1 = scale(axes1, l3);
    // 2 Q L times the axes.
    let (uu, ut, tt) = (moments.x * 2.0, moments.y * 2.0, moments.z * 2.0);
    let weighted0 = add(scale(seen0, uu), scale(seen1, ut));
    let weighted1 = add(scale(seen0, ut), scale(seen1, tt));
    // Compensation^2 = raw determinant / determinant, where that is over its floor.
    let share = p.raw_determinant * inverse;
    let d_share = select(share > MIN_COMPENSATION * MIN_COMPENSATION, d_compensation * 0.5 / p.compensation, 0.0f32) * inverse;
    // 1 - share, which would cancel where the Gaussian is much larger than the blur.
    let of_blur = (p.xx + p.yy - cam[BLUR]) * (inverse * cam[BLUR]);
    let d_raw = d_share * of_blur;
    let d_trace = -(d_share * share * cam[BLUR]);
    let n = times(normal, normal);
    let raw = v3(squared.y * n.z + squared.z * n.y, squared.z * n.x + squared.x * n.z, squared.x * n.y + squared.y * n.x);
    let trace = add(times(axes0, axes0), times(axes1, axes1));
    let through_shape = add(times(seen0, weighted0), times(seen1, weighted1));
    let d_scales = scale(times(s, add(add(scale(raw, d_raw), scale(trace, d_trace)), scale(through_shape, -1.0f32))), 2.0f32);
    let shape0 = scale(weighted0, l1);
    let shape1 = add(scale(weighted0, l2), scale(weighted1, l3));
    let d_row0 = scale(add(times(s, add(scale(adjugate0, d_raw), scale(shape0, -1.0f32))), scale(p.row0, d_trace)), 2.0f32);
    let d_row1 = scale(add(times(s, add(scale(adjugate1, d_raw), scale(shape1, -1.0f32))), scale(p.row1, d_trace)), 2.0f32);
    // rows[k] = (f_k / z) (scaled[k] - ratio_k scaled[2]).
    let d_scaled0 = scale(d_row0, fz_x);
    let d_scaled1 = scale(d_row1, fz_y);
    let d_scaled2 = add(scale(d_scaled0, -p.ratio_x), scale(d_scaled1, -p.ratio_y));
    // The clamped ratio passes no gradient; the projected centre always does. 1/z scales both rows, as a common factor of the scales would.
    let step_x = (d_x * cam[FOCAL] - p.inside_x * dot(d_scaled0, p.scaled2)) * p.inverse_depth;
    let step_y = (d_y * cam[FOCAL + 1] - p.inside_y * dot(d_scaled1, p.scaled2)) * p.inverse_depth;
    let d_z = d_depth - dot(d_scales, s) * p.inverse_depth - (step_x * p.point.x + step_y * p.point.y) * p.inverse_depth;
    let d_point = v3(step_x, step_y, d_z);
    let d_turned0 = times(d_scaled0, s);
    let d_turned1 = times(d_scaled1, s);
    let d_turned2 = times(d_scaled2, s);
    let r0 = combine(d_turned0, w0.x, d_turned1, w1.x, d_turned2, w2.x);
    let r1 = combine(d_turned0, w0.y, d_turned1, w1.y, d_turned2, w2.y);
    let r2 = combine(d_turned0, w0.z, d_turned1, w1.z, d_turned2, w2.z);
    let (w, x, y, z) = (p.unit.w, p.unit.x, p.unit.y, p.unit.z);
    let g_w = x * (r2.y - r1.z) + y * (r0.z - r2.x) + z * (r1.x - r0.y);
    let g_x = -2.0f32 * x * (r1.y + r2.z) + y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r2.y - r1.z);
    let g_y = x * (r0.y + r1.x) - 2.0 * y * (r0.x + r2.z) + z * (r1.z + r2.y) + w * (r0.z - r2.x);
    let g_z = x * (r0.z + r2.x) + y * (r1.z + r2.y) - 2.0 * z * (r0.x + r1.y) + w * (r1.x - r0.y);
    // The matrix is quadratic in the quaternion: a factor 2 in all; then the part along the quaternion is projected out.
    let along = g_w * w + g_x * x + g_y * y + g_z * z;
    let factor = p.inverse_norm * 2.0;
    let (t0, t1, t2) = (through(d_turned0, p), through(d_turned1, p), through(d_turned2, p));
    GeometryGradient {
        mean: combine(w0, d_point.x, w1, d_point.y, w2, d_point.z),
        quaternion: V4 { w: (g_w - w * along) * factor, x: (g_x - x * along) * factor, y: (g_y - y * along) * factor, z: (g_z - z * along) * factor },
        scales: d_scales,
        camera0: add(scale(mean, d_point.x), t0),
        camera1: add(scale(mean, d_point.y), t1),
        camera2: add(scale(mean, d_point.z), t2),
        translation: d_point,
    }
}

/// Dot products with the rows of the Gaussian's rotation.
#[cube]
fn through(d: V3, p: Projected) -> V3 {
    v3(dot(d, p.rotation0), dot(d, p.rotation1), dot(d, p.rotation2))
}

impl Clone for ProjectedExpand {
    fn clone(&self) -> Self {
        *self
    }
}
impl Copy for ProjectedExpand {}

impl Clone for GeometryGradientExpand {
    fn clone(&self) -> Self {
        *self
    }
}
impl Copy for GeometryGradientExpand {}
