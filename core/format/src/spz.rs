//! Niantic's SPZ: static Gaussians in some 20 bytes plus harmonics, read by most viewers. The layout is that of the format's published description,
//! version 3 written, 2 and 3 read: a gzip stream of a header of 16 bytes and the attributes one after the other.
//!
//! SPZ's axes are right, up, back; those of cameras and PLY files here are right, down, forward. Reading and writing rotate by 180 degrees around x.

use crate::gaussians::sh_rest_len;
use crate::{Error, HostGaussians, Limits, Result};
use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use std::f32::consts::FRAC_1_SQRT_2;
use std::io::{Read, Write};

/// "NGSP".
const MAGIC: u32 = 0x5053_474e;
const HEADER: usize = 16;
/// Largest number of fractional bits of fixed-point coordinates.
const MOST_FRACTION: u8 = 20;
/// Largest absolute coordinate, world units: 24 bits without fractional bits.
pub const LARGEST: f32 = 8_388_607.0;
/// Largest vendor extension that is skipped, in bytes.
const MOST_EXTENSION: usize = 1 << 24;
/// Scale of the degree-0 coefficient in the stored colour range 0..1.
const COLOR: f32 = 0.15;
/// Largest code of a quaternion component in version 3.
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

/// An SPZ file of `gaussians`, which must be valid ([`HostGaussians::validate`]). Dynamic scores and plug-in attributes are not stored. `sh1_bits` and
/// `sh_rest_bits` (1 to 8) are the bits per coefficient of degree 1 and of higher degrees.
///
/// # Errors
/// [`Error::Parameter`] or [`Error::Limit`] for coordinates or counts that the format cannot store.
pub fn to_spz(gaussians: &HostGaussians, sh1_bits: u8, sh_rest_bits: u8) -> Result<Vec<u8>> {
    let n = gaussians.len();
    let count = u32::try_from(n).map_err(|_| Error::limit("SPZ file", n as u64, u64::from(u32::MAX), "Prune the model"))?;
    let farthest = gaussians.means.iter().fold(0.0f32, |a, v| a.max(v.abs()));
    if farthest > LARGEST {
        return Err(Error::data(
            "Gaussians to write as SPZ",
            format!("a coordinate of {farthest:e} does not fit 24 bits"),
            "Remove far outliers, or use another codec",
        ));
    }
    let fraction = (0..=MOST_FRACTION).rev().find(|&bits| farthest * f32::from(bits).exp2() <= LARGEST).unwrap_or(0);
    let mut raw = Vec::with_capacity(HEADER + n * 64);
    raw.extend(MAGIC.to_le_bytes());
    raw.extend(3u32.to_le_bytes());
    raw.extend(count.to_le_bytes());
    raw.extend([gaussians.sh_degree as u8, fraction, 0, 0]);
    let scale = f32::from(fraction).exp2();
    for point in gaussians.means.as_chunks::<3>().0 {
        for value in turned(*point) {
            raw.extend(&((value * scale).round() as i32).to_le_bytes()[..3]);
        }
    }
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let unit: Vec<Option<[f32; 4]>> = gaussians.quaternions.as_chunks::<4>().0.iter().map(|q| normalized(*q)).collect();
    // A quaternion of norm zero is not drawn, so its Gaussian is stored with an opacity of zero.
    raw.extend(gaussians.opacity_logits.iter().zip(&unit).map(|(o, q)| if q.is_some() { byte(255.0 / (1.0 + (-o).exp())) } else { 0 }));
    raw.extend(gaussians.sh_dc.iter().map(|c| byte((c * COLOR + 0.5) * 255.0)));
    raw.extend(gaussians.log_scales.iter().map(|s| byte((s + 10.0) * 16.0)));
    for q in &unit {
        let [w, x, y, z] = q.unwrap_or([1.0, 0.0, 0.0, 0.0]);
        raw.extend(pack_rotation([x, -y, -z, w]).to_le_bytes());
    }
    let per_point = sh_rest_len(gaussians.sh_degree);
    for (i, value) in gaussians.sh_rest.iter().enumerate() {
        let k = 1 + i / 3 % per_point.max(1);
        let value = if is_odd(k) { -value } else { *value };
        let step = 1i32 << (8 - if k <= 3 { sh1_bits } else { sh_rest_bits });
        let level = (value * 128.0).round().clamp(-1e6, 1e6) as i32 + 128;
        raw.push(((level + step / 2).div_euclid(step) * step).clamp(0, 255) as u8);
    }
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(&raw).and_then(|()| encoder.finish()).map_err(|e| Error::backend("SPZ", e.to_string(), "Report this as a defect"))
}

/// The Gaussians of an SPZ file; dynamic scores are zero. `object` names the file in errors.
///
/// # Errors
/// [`Error::Data`] for invalid files, [`Error::Unsupported`] for other versions, [`Error::Limit`].
pub fn from_spz(object: &str, bytes: &[u8], limits: &Limits) -> Result<HostGaussians> {
    let damaged = |problem: String| Error::data(object, problem, "Fetch the file again");
    let mut decoder = GzDecoder::new(bytes);
    let mut header = [0u8; HEADER];
    decoder.read_exact(&mut header).map_err(|e| damaged(format!("no SPZ header: {e}")))?;
    let word = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if word(0) != MAGIC {
        return Err(damaged("it is not an SPZ file".into()));
    }
    let version = word(4);
    if !(2..=3).contains(&version) {
        return Err(Error::unsupported(object.to_string(), format!("SPZ version {version}"), "Versions 2 and 3 are read; convert the file"));
    }
    let (n, sh_degree, fraction) = (u64::from(word(8)), usize::from(header[12]), header[13]);
    limits.check_gaussians(object, n)?;
    if sh_degree > 4 || fraction > 24 {
        return Err(damaged(format!("degree {sh_degree} and {fraction} fractional bits are impossible")));
    }
    let rest = 3 * sh_rest_len(sh_degree);
    limits.check_bytes(object, n.saturating_mul(4 * (15 + rest as u64)))?;
    let n = n as usize;
    let mut take = |width: usize| -> Result<Vec<u8>> {
        let mut part = Vec::new();
        (&mut decoder).take((n * width) as u64).read_to_end(&mut part).map_err(|e| damaged(e.to_string()))?;
        if part.len() == n * width { Ok(part) } else { Err(damaged(format!("it ends early: {} of {} bytes of an attribute", part.len(), n * width))) }
    };
    let scale = 1.0 / f32::from(fraction).exp2();
    let coordinate = |b: &[u8; 3]| (i32::from_le_bytes([0, b[0], b[1], b[2]]) >> 8) as f32 * scale;
    let means = take(9)?.as_chunks::<9>().0.iter().flat_map(|p| turned([0, 3, 6].map(|k| coordinate(&[p[k], p[k + 1], p[k + 2]])))).collect();
    // Half a step inside, where the logit is finite.
    let opacity_logits = take(1)?.iter().map(|&a| f32::from(a).clamp(0.5, 254.5)).map(|a| (a / (255.0 - a)).ln()).collect();
    let sh_dc = take(3)?.iter().map(|&c| (f32::from(c) / 255.0 - 0.5) / COLOR).collect();
    let log_scales = take(3)?.iter().map(|&s| f32::from(s) / 16.0 - 10.0).collect();
    let rotations: Vec<[f32; 4]> = if version == 3 {
        take(4)?.as_chunks::<4>().0.iter().map(|b| unpack_rotation(u32::from_le_bytes(*b))).collect()
    } else {
        take(3)?.as_chunks::<3>().0.iter().map(|b| with_largest(b.map(|v| f32::from(v) / 127.5 - 1.0), 3)).collect()
    };
    let quaternions = rotations.into_iter().flat_map(|[x, y, z, w]| [w, x, -y, -z]).collect();
    let level = |(i, v): (usize, &u8)| {
        let value = (f32::from(*v) - 128.0) / 128.0;
        if is_odd(1 + i / 3 % (rest / 3).max(1)) { -value } else { value }
    };
    let sh_rest = take(rest)?.iter().enumerate().map(level).collect();
    // Vendor extensions follow. Reading to the end verifies the checksum of the gzip stream.
    let mut beyond = vec![0u8; 1 << 16];
    let mut left = MOST_EXTENSION;
    while left > 0 {
        match decoder.read(&mut beyond).map_err(|e| damaged(e.to_string()))? {
            0 => break,
            more => left = left.saturating_sub(more),
        }
    }
    if left == 0 || !decoder.get_ref().is_empty() {
        return Err(damaged("unknown data follows the Gaussians".into()));
    }
    let found = HostGaussians { sh_degree, means, log_scales, quaternions, opacity_logits, sh_dc, sh_rest, dynamic_scores: vec![0.0; n], ..Default::default() };
    found.validate(object, limits)?;
    Ok(found)
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
