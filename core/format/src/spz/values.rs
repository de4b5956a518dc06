//! The quantisation of SPZ: bytes per attribute.

use super::{ANTIALIASED, Packed, SpzOptions};
use crate::gaussians::sh_rest_len;
use crate::{Error, HostGaussians, Result};
use std::f32::consts::FRAC_1_SQRT_2;

/// Largest number of fractional bits of fixed-point coordinates.
const MOST_FRACTION: u8 = 20;
/// Largest absolute coordinate, world units: 24 bits without fractional bits.
pub const LARGEST: f32 = 8_388_607.0;
/// Scale of the degree-0 coefficient in the stored colour range 0..1.
const COLOR: f32 = 0.15;
/// Largest code of a quaternion component from version 3 on.
const COMPONENT: f32 = 511.0;

/// Whether spherical-harmonics coefficient `k` (from 1) changes sign if y and z do: the powers of y and z add up to an odd number.
fn is_odd(k: usize) -> bool {
    // By degree, in the order of 3DGS: -y z -x; xy yz zz xz xx-yy; y xyz y z x z x; xy yz xy yz zz xz xx xz xx.
    const ODD: [bool; 24] = [
        true, true, false, // degree 1
        true, false, false, true, false, // 2
        true, false, true, true, false, true, false, // 3
        true, false, true, false, false, true, false, true, false, // 4
    ];
    ODD[k - 1]
}

/// The quantised attributes of `gaussians`.
pub(super) fn pack(gaussians: &HostGaussians, options: &SpzOptions) -> Result<Packed> {
    let count = gaussians.len();
    if u32::try_from(count).is_err() {
        return Err(Error::limit("SPZ file", count as u64, u64::from(u32::MAX), "Prune the model"));
    }
    let farthest = gaussians.means.iter().fold(0.0f32, |a, v| a.max(v.abs()));
    if farthest > LARGEST {
        return Err(Error::data(
            "Gaussians to write as SPZ",
            format!("a coordinate of {farthest:e} does not fit 24 bits"),
            "Remove far outliers, or use another codec",
        ));
    }
    let fraction = (0..=MOST_FRACTION).rev().find(|&bits| farthest * f32::from(bits).exp2() <= LARGEST).unwrap_or(0);
    let scale = f32::from(fraction).exp2();
    let fixed = |value: f32| ((value * scale).round() as i32).to_le_bytes();
    let positions = gaussians.means.as_chunks::<3>().0.iter().flat_map(|point| turned(*point)).flat_map(|v| fixed(v).into_iter().take(3)).collect();
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let unit: Vec<Option<[f32; 4]>> = gaussians.quaternions.as_chunks::<4>().0.iter().map(|q| normalized(*q)).collect();
    // A quaternion of norm zero is not drawn, so its Gaussian is stored with an opacity of zero.
    let alphas = gaussians.opacity_logits.iter().zip(&unit).map(|(o, q)| if q.is_some() { byte(255.0 / (1.0 + libm::expf(-o))) } else { 0 }).collect();
    let colors = gaussians.sh_dc.iter().map(|c| byte((c * COLOR + 0.5) * 255.0)).collect();
    let scales = gaussians.log_scales.iter().map(|s| byte((s + 10.0) * 16.0)).collect();
    let rotations = unit.iter().flat_map(|q| {
        let [w, x, y, z] = q.unwrap_or([1.0, 0.0, 0.0, 0.0]);
        pack_rotation([x, -y, -z, w]).to_le_bytes()
    });
    let per_point = sh_rest_len(gaussians.sh_degree);
    let level = |(i, value): (usize, &f32)| {
        let k = 1 + i / 3 % per_point.max(1);
        let value = if is_odd(k) { -value } else { *value };
        let step = 1i32 << (8 - if k <= 3 { options.sh1_bits } else { options.sh_rest_bits });
        let level = (value * 128.0).round().clamp(-1e6, 1e6) as i32 + 128;
        ((level + step / 2).div_euclid(step) * step).clamp(0, 255) as u8
    };
    let harmonics = gaussians.sh_rest.iter().enumerate().map(level).collect();
    Ok(Packed {
        count,
        sh_degree: gaussians.sh_degree,
        fraction,
        flags: if options.antialiased { ANTIALIASED } else { 0 },
        rotation_bytes: 4,
        streams: [positions, alphas, colors, scales, rotations.collect(), harmonics],
    })
}

/// The Gaussians of quantised attributes; dynamic scores are zero.
pub(super) fn unpack(packed: &Packed) -> HostGaussians {
    let [positions, alphas, colors, scales, rotations, harmonics] = &packed.streams;
    let scale = 1.0 / f32::from(packed.fraction).exp2();
    let coordinate = |b: &[u8; 3]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 * scale;
    let means = positions.as_chunks::<9>().0.iter().flat_map(|p| turned([0, 3, 6].map(|k| coordinate(&[p[k], p[k + 1], p[k + 2]])))).collect();
    // Half a step inside, where the logit is finite.
    let opacity_logits = alphas.iter().map(|&a| f32::from(a).clamp(0.5, 254.5)).map(|a| libm::logf(a / (255.0 - a))).collect();
    let sh_dc = colors.iter().map(|&c| (f32::from(c) / 255.0 - 0.5) / COLOR).collect();
    let log_scales = scales.iter().map(|&s| f32::from(s) / 16.0 - 10.0).collect();
    let rotations: Vec<[f32; 4]> = if packed.rotation_bytes == 4 {
        rotations.as_chunks::<4>().0.iter().map(|b| unpack_rotation(u32::from_le_bytes(*b))).collect()
    } else {
        rotations.as_chunks::<3>().0.iter().map(|b| with_largest(b.map(|v| f32::from(v) / 127.5 - 1.0), 3)).collect()
    };
    let quaternions = rotations.into_iter().flat_map(|[x, y, z, w]| [w, x, -y, -z]).collect();
    let per_point = sh_rest_len(packed.sh_degree).max(1);
    let level = |(i, v): (usize, &u8)| {
        let value = (f32::from(*v) - 128.0) / 128.0;
        if is_odd(1 + i / 3 % per_point) { -value } else { value }
    };
    let sh_rest = harmonics.iter().enumerate().map(level).collect();
    let dynamic_scores = vec![0.0; packed.count];
    HostGaussians { sh_degree: packed.sh_degree, means, log_scales, quaternions, opacity_logits, sh_dc, sh_rest, dynamic_scores, ..Default::default() }
}

/// Rotation by 180 degrees around x.
fn turned([x, y, z]: [f32; 3]) -> [f32; 3] {
    [x, -y, -z]
}

fn normalized(q: [f32; 4]) -> Option<[f32; 4]> {
    let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (norm > 1e-15 && norm.is_finite()).then(|| q.map(|v| (f64::from(v) / norm) as f32))
}

/// Packs (x,y,z,w): two bits for the index of the largest component, then sign and nine bits for each of the others in order.
fn pack_rotation(q: [f32; 4]) -> u32 {
    let largest = (0..4).fold(0, |a, k| if q[k].abs() > q[a].abs() { k } else { a });
    let flip = q[largest] < 0.0;
    (0..4).filter(|&k| k != largest).fold(largest as u32, |packed, k| {
        let negative = (q[k] < 0.0) != flip;
        let size = (COMPONENT * (q[k].abs() / FRAC_1_SQRT_2)).round().min(COMPONENT) as u32;
        packed << 10 | u32::from(negative) << 9 | size
    })
}

fn unpack_rotation(packed: u32) -> [f32; 4] {
    let small = [20, 10, 0].map(|shift| {
        let bits = packed >> shift;
        let size = (bits & 511) as f32 / COMPONENT * FRAC_1_SQRT_2;
        if bits & 512 == 0 { size } else { -size }
    });
    with_largest(small, (packed >> 30) as usize)
}

/// A unit quaternion from three components and the index of the fourth, which is not negative.
fn with_largest(small: [f32; 3], index: usize) -> [f32; 4] {
    let rest = (1.0 - small.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut others = small.into_iter();
    let q = std::array::from_fn(|k| if k == index { rest } else { others.next().unwrap_or(0.0) });
    normalized(q).unwrap_or([0.0, 0.0, 0.0, 1.0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_come_back_within_a_step() {
        for k in 0..2000u32 {
            let q = normalized(std::array::from_fn(|c| ((k * 7 + c as u32 * 131) as f32 * 0.37).sin())).unwrap();
            let back = unpack_rotation(pack_rotation(q));
            let along: f32 = q.iter().zip(back).map(|(a, b)| a * b).sum();
            assert!(1.0 - along.abs() < 3e-6, "{q:?} became {back:?}");
        }
        assert_eq!(pack_rotation([0.0, 0.0, 0.0, -1.0]), 3 << 30 | 1 << 29 | 1 << 19 | 1 << 9);
    }

    #[test]
    fn signs_are_those_of_the_basis_turned_half_around_x() {
        // The basis functions of 3DGS up to degree 3, without factors.
        let values = |[x, y, z]: [f32; 3]| {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            [
                -y,
                z,
                -x,
                x * y,
                y * z,
                2.0 * zz - xx - yy,
                x * z,
                xx - yy,
                y * (3.0 * xx - yy),
                x * y * z,
                y * (4.0 * zz - xx - yy),
                z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
                x * (4.0 * zz - xx - yy),
                z * (xx - yy),
                x * (xx - 3.0 * yy),
                x * y * (xx - yy),
                y * z * (3.0 * xx - yy),
                x * y * (7.0 * zz - 1.0),
                y * z * (7.0 * zz - 3.0),
                zz * (35.0 * zz - 30.0),
                x * z * (7.0 * zz - 3.0),
                (xx - yy) * (7.0 * zz - 1.0),
                x * z * (xx - 3.0 * yy),
                xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy),
            ]
        };
        let direction = [0.3, -0.5, 0.8];
        for (k, (a, b)) in values(direction).into_iter().zip(values(turned(direction))).enumerate() {
            assert_eq!(a == -b, is_odd(k + 1), "coefficient {}", k + 1);
        }
    }
}
