//! Real spherical harmonics of degree 0 to 4 and their derivative, a vector of directions at a time (signs as in Inria's 3DGS).

use super::geometry::Vec3;
use crate::cpu::simd::{Lanes, each};
use pulp::Simd;

/// Coefficients of degree 4, the largest known.
pub const MAX_BASIS: usize = 25;
const C0: f32 = 0.282_094_79;
const C1: f32 = 0.488_602_51;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
const C3: [f32; 7] = [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];
const C4: [f32; 9] = [2.503_342_9, -1.770_130_8, 0.946_174_7, -0.669_046_5, 0.105_785_55, -0.669_046_5, 0.473_087_35, -1.770_130_8, 0.625_835_7];

/// Fills the first (degree + 1)^2 basis values at the unit direction `d`.
#[inline(always)]
pub fn basis<S: Simd>(degree: usize, d: Vec3<S>, out: &mut [Lanes<S>; MAX_BASIS]) {
    let [x, y, z] = d;
    out[0] = x.like(C0);
    if degree < 1 {
        return;
    }
    out[1] = y * -C1;
    out[2] = z * C1;
    out[3] = x * -C1;
    if degree < 2 {
        return;
    }
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    out[4] = xy * C2[0];
    out[5] = yz * C2[1];
    out[6] = (zz * 2.0 - xx - yy) * C2[2];
    out[7] = xz * C2[3];
    out[8] = (xx - yy) * C2[4];
    if degree < 3 {
        return;
    }
    out[9] = y * (xx * 3.0 - yy) * C3[0];
    out[10] = xy * z * C3[1];
    out[11] = y * (zz * 4.0 - xx - yy) * C3[2];
    out[12] = z * (zz * 2.0 - (xx + yy) * 3.0) * C3[3];
    out[13] = x * (zz * 4.0 - xx - yy) * C3[4];
    out[14] = z * (xx - yy) * C3[5];
    out[15] = x * (xx - yy * 3.0) * C3[6];
    if degree < 4 {
        return;
    }
    let s = zz * 7.0;
    out[16] = xy * (xx - yy) * C4[0];
    out[17] = yz * (xx * 3.0 - yy) * C4[1];
    out[18] = xy * (s - 1.0) * C4[2];
    out[19] = yz * (s - 3.0) * C4[3];
    out[20] = (zz * (s * 5.0 - 30.0) + 3.0) * C4[4];
    out[21] = xz * (s - 3.0) * C4[5];
    out[22] = (xx - yy) * (s - 1.0) * C4[6];
    out[23] = xz * (xx - yy * 3.0) * C4[7];
    out[24] = (xx * (xx - yy * 3.0) - yy * (xx * 3.0 - yy)) * C4[8];
}

/// Gradient with respect to the unit direction of sum_k h`[k]` basis`[k]`; its component along the direction has no meaning.
#[inline(always)]
pub fn basis_backward<S: Simd>(degree: usize, d: Vec3<S>, h: &[Lanes<S>; MAX_BASIS]) -> Vec3<S> {
    let [x, y, z] = d;
    let zero = x.like(0.0);
    if degree < 1 {
        return [zero; 3];
    }
    let mut g = [h[3] * -C1, h[1] * -C1, h[2] * C1];
    if degree < 2 {
        return g;
    }
    let h2: [Lanes<S>; 5] = each(
        #[inline(always)]
        |k| h[4 + k] * C2[k],
    );
    g[0] = h2[0].fma(y, h2[2].fma(x * -2.0, h2[3].fma(z, h2[4].fma(x * 2.0, g[0]))));
    g[1] = h2[0].fma(x, h2[1].fma(z, h2[2].fma(y * -2.0, h2[4].fma(y * -2.0, g[1]))));
    g[2] = h2[1].fma(y, h2[2].fma(z * 4.0, h2[3].fma(x, g[2])));
    if degree < 3 {
        return g;
    }
    let (xx, yy, zz, xy, yz, xz) = (x * x, y * y, z * z, x * y, y * z, x * z);
    let h3: [Lanes<S>; 7] = each(
        #[inline(always)]
        |k| h[9 + k] * C3[k],
    );
    let side = zz * 4.0 - xx - yy;
    g[0] = h3[0].fma(xy * 6.0, h3[1].fma(yz, h3[2].fma(xy * -2.0, h3[3].fma(xz * -6.0, g[0]))));
    g[0] = h3[4].fma(side - xx * 2.0, h3[5].fma(xz * 2.0, h3[6].fma((xx - yy) * 3.0, g[0])));
    g[1] = h3[0].fma((xx - yy) * 3.0, h3[1].fma(xz, h3[2].fma(side - yy * 2.0, h3[3].fma(yz * -6.0, g[1]))));
    g[1] = h3[4].fma(xy * -2.0, h3[5].fma(yz * -2.0, h3[6].fma(xy * -6.0, g[1])));
    g[2] = h3[1].fma(xy, h3[2].fma(yz * 8.0, h3[3].fma((zz * 2.0 - xx - yy) * 3.0, g[2])));
    g[2] = h3[4].fma(xz * 8.0, h3[5].fma(xx - yy, g[2]));
    if degree < 4 {
        return g;
    }
    let h4: [Lanes<S>; 9] = each(
        #[inline(always)]
        |k| h[16 + k] * C4[k],
    );
    let s = zz * 7.0;
    let (s1, s3) = (s - 1.0, s - 3.0);
    g[0] = h4[0].fma(y * (xx * 3.0 - yy), h4[1].fma(xy * z * 6.0, h4[2].fma(y * s1, g[0])));
    g[0] = h4[5].fma(z * s3, h4[6].fma(x * s1 * 2.0, h4[7].fma(z * (xx - yy) * 3.0, h4[8].fma(x * (xx - yy * 3.0) * 4.0, g[0]))));
    g[1] = h4[0].fma(x * (xx - yy * 3.0), h4[1].fma(z * (xx - yy) * 3.0, h4[2].fma(x * s1, h4[3].fma(z * s3, g[1]))));
    g[1] = h4[6].fma(y * s1 * -2.0, h4[7].fma(xy * z * -6.0, h4[8].fma(y * (yy - xx * 3.0) * 4.0, g[1])));
    g[2] = h4[1].fma(y * (xx * 3.0 - yy), h4[2].fma(xy * z * 14.0, h4[3].fma(y * (s * 3.0 - 3.0), g[2])));
    g[2] = h4[4].fma(z * (s * 20.0 - 60.0), h4[5].fma(x * (s * 3.0 - 3.0), g[2]));
    g[2] = h4[6].fma(z * (xx - yy) * 14.0, h4[7].fma(x * (xx - yy * 3.0), g[2]));
    g
}

/// Gradient of a vector from that of its direction, `direction` being the vector times `inverse_length`.
#[inline(always)]
pub fn normalize_backward<S: Simd>(direction: Vec3<S>, inverse_length: Lanes<S>, g: Vec3<S>) -> Vec3<S> {
    let along = direction[0].fma(g[0], direction[1].fma(g[1], direction[2] * g[2]));
    each(
        #[inline(always)]
        |k| direction[k].nfma(along, g[k]) * inverse_length,
    )
}
