//! Real spherical harmonics of degree 0 to 4 at one direction, as `cpu::raster::sh`, and their derivative.

use super::vector::{V3, v3};
use cubecl::prelude::*;

const C0: f32 = 0.282_094_79;
const C1: f32 = 0.488_602_51;
const MINUS_C1: f32 = -C1;

/// Values of the basis; the first (degree + 1)^2 are filled.
#[cube]
pub fn basis(d: V3, #[comptime] degree: usize) -> Array<f32> {
    let mut out = Array::<f32>::new(25usize);
    let (x, y, z) = (d.x, d.y, d.z);
    out[0] = C0;
    if comptime!(degree > 0) {
        out[1] = MINUS_C1 * y;
        out[2] = C1 * z;
        out[3] = MINUS_C1 * x;
    }
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    if comptime!(degree > 1) {
        out[4] = 1.092_548_4 * xy;
        out[5] = -1.092_548_4f32 * yz;
        out[6] = 0.315_391_57 * (2.0 * zz - xx - yy);
        out[7] = -1.092_548_4f32 * xz;
        out[8] = 0.546_274_2 * (xx - yy);
    }
    if comptime!(degree > 2) {
        out[9] = -0.590_043_6f32 * y * (3.0 * xx - yy);
        out[10] = 2.890_611_4 * xy * z;
        out[11] = -0.457_045_8f32 * y * (4.0 * zz - xx - yy);
        out[12] = 0.373_176_34 * z * (2.0 * zz - 3.0 * (xx + yy));
        out[13] = -0.457_045_8f32 * x * (4.0 * zz - xx - yy);
        out[14] = 1.445_305_7 * z * (xx - yy);
        out[15] = -0.590_043_6f32 * x * (xx - 3.0 * yy);
    }
    if comptime!(degree > 3) {
        let s = 7.0 * zz;
        out[16] = 2.503_342_9 * xy * (xx - yy);
        out[17] = -1.770_130_8f32 * yz * (3.0 * xx - yy);
        out[18] = 0.946_174_7 * xy * (s - 1.0);
        out[19] = -0.669_046_5f32 * yz * (s - 3.0);
        out[20] = 0.105_785_55 * (zz * (5.0 * s - 30.0) + 3.0);
        out[21] = -0.669_046_5f32 * xz * (s - 3.0);
        out[22] = 0.473_087_35 * (xx - yy) * (s - 1.0);
        out[23] = -1.770_130_8f32 * xz * (xx - 3.0 * yy);
        out[24] = 0.625_835_7 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy));
    }
    out
}

/// Gradient with respect to the unit direction of sum_k h`[k]` basis`[k]`; its component along the direction has no meaning.
#[cube]
pub fn basis_backward(d: V3, h: &Array<f32>, #[comptime] degree: usize) -> V3 {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    let mut gx = 0.0f32;
    let mut gy = 0.0f32;
    let mut gz = 0.0f32;
    if comptime!(degree > 0) {
        gx -= C1 * h[3];
        gy -= C1 * h[1];
        gz += C1 * h[2];
    }
    if comptime!(degree > 1) {
        let (a, b, c, e, f) = (1.092_548_4 * h[4], -1.092_548_4f32 * h[5], 0.315_391_57 * h[6], -1.092_548_4f32 * h[7], 0.546_274_2 * h[8]);
        gx += a * y - 2.0 * c * x + e * z + 2.0 * f * x;
        gy += a * x + b * z - 2.0 * c * y - 2.0 * f * y;
        gz += b * y + 4.0 * c * z + e * x;
    }
    if comptime!(degree > 2) {
        let (a, b, c) = (-0.590_043_6f32 * h[9], 2.890_611_4 * h[10], -0.457_045_8f32 * h[11]);
        let (e, f, g, i) = (0.373_176_34 * h[12], -0.457_045_8f32 * h[13], 1.445_305_7 * h[14], -0.590_043_6f32 * h[15]);
        let side = 4.0 * zz - xx - yy;
        gx += 6.0 * a * xy + b * yz - 2.0 * c * xy - 6.0 * e * xz + f * (side - 2.0 * xx) + 2.0 * g * xz + 3.0 * i * (xx - yy);
        gy += 3.0 * a * (xx - yy) + b * xz + c * (side - 2.0 * yy) - 6.0 * e * yz - 2.0 * f * xy - 2.0 * g * yz - 6.0 * i * xy;
        gz += b * xy + 8.0 * c * yz + 3.0 * e * (2.0 * zz - xx - yy) + 8.0 * f * xz + g * (xx - yy);
    }
    if comptime!(degree > 3) {
        let s = 7.0 * zz;
        let (s1, s3) = (s - 1.0, s - 3.0);
        let (a, b, c, e) = (2.503_342_9 * h[16], -1.770_130_8f32 * h[17], 0.946_174_7 * h[18], -0.669_046_5f32 * h[19]);
        let (f, g, i, j, k) = (0.105_785_55 * h[20], -0.669_046_5f32 * h[21], 0.473_087_35 * h[22], -1.770_130_8f32 * h[23], 0.625_835_7 * h[24]);
        gx += a * y * (3.0 * xx - yy) + 6.0 * b * xy * z + c * y * s1;
        gx += g * z * s3 + 2.0 * i * x * s1 + 3.0 * j * z * (xx - yy) + 4.0 * k * x * (xx - 3.0 * yy);
        gy += a * x * (xx - 3.0 * yy) + 3.0 * b * z * (xx - yy) + c * x * s1 + e * z * s3;
        gy += -2.0f32 * i * y * s1 - 6.0 * j * xy * z + 4.0 * k * y * (yy - 3.0 * xx);
        gz += b * y * (3.0 * xx - yy) + 14.0 * c * xy * z + e * y * (3.0 * s - 3.0);
        gz += f * z * (20.0 * s - 60.0) + g * x * (3.0 * s - 3.0) + 14.0 * i * z * (xx - yy) + j * x * (xx - 3.0 * yy);
    }
    v3(gx, gy, gz)
}
