//! The quantisation of SPZ: bytes per attribute.

use super::{ANTIALIASED, Packed, SpzOptions};
use crate::gaussians::{sh_rest_len, unit_quaternion};
use crate::{Error, HostGaussians, Result};
use std::f32::consts::FRAC_1_SQRT_2;

/// Largest number of fractional bits of fixed-point coordinates.
const MOST_FRACTION: u8 = 20;
/// The fractional bits of Niantic's own writer.
const USUAL_FRACTION: u8 = 12;
/// Largest absolute coordinate, world units: 24 bits without fractional bits.
pub const LARGEST: f32 = 8_388_607.0;
/// Scale of the degree-0 coefficient in the stored colour range 0..1.
const COLOR: f32 = 0.15;
/// Largest code of a quaternion component from version 3 on.
const COMPONENT: f32 = 511.0;
/// Steps of centres are coarse from this share of a Gaussian's standard deviation on.
const COARSE: f32 = 0.1;

/// Codes of 8 bits, before they are rounded and limited.
fn scale_code(log_scale: f32) -> f32 {
    (log_scale + 10.0) * 16.0
}
fn color_code(coefficient: f32) -> f32 {
    (coefficient * COLOR + 0.5) * 255.0
}
fn harmonic_code(coefficient: f32) -> f32 {
    coefficient * 128.0 + 128.0
}

/// 2^`exponent`, for exponents of normal numbers.
fn power_of_two(exponent: i32) -> f32 {
    f32::from_bits(((127 + exponent) as u32) << 23)
}

/// Largest absolute coordinate.
fn farthest(gaussians: &HostGaussians) -> f32 {
    gaussians.means.iter().fold(0.0, |a, v| a.max(v.abs()))
}

/// The most fractional bits of coordinates up to `farthest`.
fn most_fraction(farthest: f32) -> u8 {
    (0..=MOST_FRACTION).rev().find(|&bits| farthest * power_of_two(i32::from(bits)) <= LARGEST).unwrap_or(0)
}

/// The step of centres with so many fractional bits.
fn step_of(fraction: u8) -> f32 {
    power_of_two(-i32::from(fraction))
}

/// Median standard deviation; infinity where there are no Gaussians.
fn median_size(gaussians: &HostGaussians) -> f32 {
    let mut log_scales = gaussians.log_scales.clone();
    let middle = log_scales.len().checked_sub(1).map(|last| last / 2);
    middle.map_or(f32::INFINITY, |middle| libm::expf(*log_scales.select_nth_unstable_by(middle, f32::total_cmp).1))
}

/// The fractional bits of centres.
fn fraction_of(gaussians: &HostGaussians, options: &SpzOptions) -> u8 {
    let most = most_fraction(farthest(gaussians));
    let usual = options.usual_fraction && most > USUAL_FRACTION && step_of(USUAL_FRACTION) <= COARSE * median_size(gaussians);
    if usual { USUAL_FRACTION } else { most }
}

/// What a file does not hold of `gaussians`, in words: values outside of its ranges, and centres in steps that are coarse for such Gaussians; and other
/// fractional bits of centres than readers may want.
pub(super) fn remarks(gaussians: &HostGaussians, options: &SpzOptions) -> Vec<String> {
    let outside = |values: &[f32], code: fn(f32) -> f32| values.iter().filter(|v| !(0.0..=255.0).contains(&code(**v).round())).count();
    let counts = [
        (outside(&gaussians.log_scales, scale_code), "scales (e^-10 to e^5.94)"),
        (outside(&gaussians.sh_dc, color_code), "coefficients of degree 0 (±3.33)"),
        (outside(&gaussians.sh_rest, harmonic_code), "coefficients of higher degrees (±1)"),
    ];
    let limited: Vec<String> = counts.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}")).collect();
    let mut out = Vec::new();
    if !limited.is_empty() {
        out.push(format!("limited to the range of the format: {}", limited.join(", ")));
    }
    let (size, fraction) = (median_size(gaussians), fraction_of(gaussians, options));
    let step = step_of(fraction);
    if step > COARSE * size {
        out.push(format!("centres are in steps of {step}, coarse beside the median standard deviation of {size:.2e}"));
    }
    if options.usual_fraction && fraction != USUAL_FRACTION && !gaussians.is_empty() {
        let why = if fraction < USUAL_FRACTION {
            format!("the farthest coordinate is {:.1}", farthest(gaussians))
        } else {
            format!("the median standard deviation is {size:.2e}")
        };
        out.push(format!("centres have {fraction} fractional bits, since {why}; readers that want {USUAL_FRACTION} refuse the file"));
    }
    out
}

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
    let farthest = farthest(gaussians);
    if farthest > LARGEST {
        return Err(Error::data(
            "Gaussians to write as SPZ",
            format!("a coordinate of {farthest:e} does not fit 24 bits"),
            "Remove far outliers, or use another codec",
        ));
    }
    let fraction = fraction_of(gaussians, options);
    let scale = power_of_two(i32::from(fraction));
    let fixed = |value: f32| ((value * scale).round() as i32).to_le_bytes();
    let positions = gaussians.means.as_chunks::<3>().0.iter().flat_map(|point| turned(*point)).flat_map(|v| fixed(v).into_iter().take(3)).collect();
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let unit: Vec<Option<[f32; 4]>> = gaussians.quaternions.as_chunks::<4>().0.iter().map(unit_quaternion).collect();
    // A quaternion of norm zero is not drawn, so its Gaussian is stored with an opacity of zero.
    let alphas = gaussians.opacity_logits.iter().zip(&unit).map(|(o, q)| if q.is_some() { byte(255.0 / (1.0 + libm::expf(-o))) } else { 0 }).collect();
    let colors = gaussians.sh_dc.iter().map(|c| byte(color_code(*c))).collect();
    let scales = gaussians.log_scales.iter().map(|s| byte(scale_code(*s))).collect();
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
    let scale = power_of_two(-i32::from(packed.fraction));
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
    unit_quaternion(&q).unwrap_or([0.0, 0.0, 0.0, 1.0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_two_are_exact() {
        assert_eq!([0, 1, 20, -1, -24].map(power_of_two), [1.0, 2.0, 1_048_576.0, 0.5, 1.0 / 16_777_216.0]);
    }

    #[test]
    fn values_outside_of_the_ranges_and_coarse_steps_are_told() {
        // The last values that are held, and the first that are not.
        let mut gaussians = HostGaussians { log_scales: vec![-10.0, 5.9375, -5.0], sh_dc: vec![-3.33, 3.33, 0.0], ..Default::default() };
        (gaussians.means, gaussians.sh_rest) = (vec![10.0, 0.0, 0.0], vec![-1.0, 127.0 / 128.0, 0.0]);
        let remarks = |gaussians: &HostGaussians| remarks(gaussians, &SpzOptions::version(4));
        assert!(remarks(&gaussians).is_empty() && remarks(&HostGaussians::default()).is_empty());
        (gaussians.log_scales, gaussians.sh_dc, gaussians.sh_rest) = (vec![-10.1, 6.0, -5.0], vec![-3.4, 0.0, 0.0], vec![1.1, -1.1, 0.0]);
        let counts = "2 scales (e^-10 to e^5.94), 1 coefficients of degree 0 (±3.33), 2 coefficients of higher degrees (±1)";
        assert_eq!(remarks(&gaussians), [format!("limited to the range of the format: {counts}")]);
        // 24 bits for 2e5 units: six of them are left for fractions.
        gaussians.means[1] = -1e5;
        let told = remarks(&gaussians);
        assert!(told.len() == 2 && told[1].starts_with("centres are in steps of 0.015625, "), "{told:?}");
    }

    #[test]
    fn the_usual_fractional_bits_are_taken_where_they_are_enough() {
        let options = |usual_fraction| SpzOptions { usual_fraction, ..SpzOptions::version(4) };
        for (farthest, log_scale, fraction) in [(7.0, -5.0, 12), (2040.0, -5.0, 12), (3000.0, -5.0, 11), (7.0, -7.0, 20), (0.0, -5.0, 12)] {
            let gaussians = HostGaussians { log_scales: vec![log_scale; 3], means: vec![farthest, 0.0, 0.0], opacity_logits: vec![0.0], ..Default::default() };
            assert_eq!(fraction_of(&gaussians, &options(true)), fraction, "{farthest} and {log_scale}");
            assert_eq!(fraction_of(&gaussians, &options(false)), most_fraction(farthest));
            let told = remarks(&gaussians, &options(true));
            let says = told.iter().any(|told| told.contains(&format!("{fraction} fractional bits")));
            assert_eq!(says, fraction != 12, "{told:?}");
        }
        assert!(remarks(&HostGaussians::default(), &options(true)).is_empty());
    }

    #[test]
    fn rotations_come_back_within_a_step() {
        for k in 0..2000u32 {
            let q = unit_quaternion(&std::array::from_fn(|c| ((k * 7 + c as u32 * 131) as f32 * 0.37).sin())).unwrap();
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
