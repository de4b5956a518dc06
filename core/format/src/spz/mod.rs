//! Niantic's SPZ: static Gaussians in some 20 bytes plus harmonics, read by most viewers. The layouts are those of the format's published description.
//!
//! Versions 2 and 3 are one gzip stream of a header of 16 bytes and the attributes one after the other; version 4 has a plain header of 32 bytes, a table and
//! one Zstandard frame per attribute, so that a reader can start with what it needs. Versions 3 and 4 are written, 2 to 4 are read. `values` has the
//! quantisation, which the versions share.
//!
//! SPZ's axes are right, up, back; those of cameras and PLY files here are right, down, forward. Reading and writing rotate by 180 degrees around x.

mod frames;
mod gzip;
mod values;

use crate::gaussians::sh_rest_len;
use crate::{Error, GaussianFile, HostGaussians, Limits, Result};

pub use values::LARGEST;

/// "NGSP".
const MAGIC: u32 = 0x5053_474e;
/// The first bytes of an SPZ file of version 4, which is not compressed as a whole.
pub const PLAIN_MAGIC: [u8; 4] = MAGIC.to_le_bytes();
/// How SPZ files up to version 3 start: they are gzip streams.
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Whether a file that begins with `head` may be an SPZ file of any version.
pub fn begins_as_spz(head: &[u8]) -> bool {
    head.starts_with(&GZIP_MAGIC) || head.starts_with(&PLAIN_MAGIC)
}

/// The flag of models trained with Mip-Splatting's 2D filter.
const ANTIALIASED: u8 = 1;
/// The flag of files with vendor extensions. One of them states other axes.
const EXTENDED: u8 = 2;

/// How an SPZ file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SpzOptions {
    /// Version of the file: 3 or 4.
    pub version: u32,
    /// Bits per spherical-harmonics coefficient of degree 1, 1 to 8.
    pub sh1_bits: u8,
    /// Bits per coefficient of higher degrees, 1 to 8.
    pub sh_rest_bits: u8,
    /// Whether the model wants Mip-Splatting's 2D filter.
    pub antialiased: bool,
    /// Whether centres have 12 fractional bits, as in Niantic's own writer, where all fit and steps of 2^-12 are not coarse: some readers refuse others. Else
    /// they have as many as fit.
    pub usual_fraction: bool,
}

impl SpzOptions {
    /// The written version with the best quality it has: 8 bits per coefficient.
    pub const fn version(version: u32) -> Self {
        Self { version, sh1_bits: 8, sh_rest_bits: 8, antialiased: false, usual_fraction: false }
    }
}

/// The attributes as an SPZ file holds them, before compression.
struct Packed {
    count: usize,
    sh_degree: usize,
    /// Fractional bits of the fixed-point coordinates.
    fraction: u8,
    flags: u8,
    /// Bytes per rotation: 4 from version 3 on, 3 before.
    rotation_bytes: usize,
    /// Positions, alphas, colours, scales, rotations and harmonics.
    streams: [Vec<u8>; 6],
}

impl Packed {
    /// Bytes per Gaussian of each stream.
    fn widths(sh_degree: usize, rotation_bytes: usize) -> [usize; 6] {
        [9, 1, 3, 3, rotation_bytes, 3 * sh_rest_len(sh_degree)]
    }
}

/// An SPZ file of `gaussians`, which must be valid ([`HostGaussians::validate`]). Dynamic scores and plug-in attributes are not stored.
///
/// # Errors
/// [`Error::Data`] or [`Error::Limit`] for coordinates or counts that the format cannot store, [`Error::Parameter`] for versions that are not written.
pub fn to_spz(gaussians: &HostGaussians, options: &SpzOptions) -> Result<Vec<u8>> {
    if !(3..=4).contains(&options.version) {
        return Err(Error::parameter("SPZ version", format!("{} is not written", options.version), "Write version 3 or 4"));
    }
    if [options.sh1_bits, options.sh_rest_bits].iter().any(|bits| !(1..=8).contains(bits)) {
        let problem = format!("{} and {} bits per harmonic coefficient", options.sh1_bits, options.sh_rest_bits);
        return Err(Error::parameter("SPZ harmonics", problem, "Give 1 to 8 bits"));
    }
    let packed = values::pack(gaussians, options)?;
    if options.version == 3 { gzip::write(&packed) } else { frames::write(&packed) }
}

/// What [`to_spz`] limits or rounds coarsely, in words: values outside of the ranges of the format, and centres in steps that are large beside the Gaussians;
/// and whether centres have other than the usual fractional bits that are asked for.
pub fn remarks(gaussians: &HostGaussians, options: &SpzOptions) -> Vec<String> {
    values::remarks(gaussians, options)
}

/// What an SPZ file of version 2, 3 or 4 holds; dynamic scores are zero. A remark says where vendor extensions are skipped. `object` names the file in errors.
///
/// # Errors
/// [`Error::Data`] for invalid files, [`Error::Unsupported`] for other versions, [`Error::Limit`].
pub fn from_spz(object: &str, bytes: &[u8], limits: &Limits) -> Result<GaussianFile> {
    let packed = if bytes.starts_with(&PLAIN_MAGIC) { frames::read(object, bytes, limits)? } else { gzip::read(object, bytes, limits)? };
    let gaussians = values::unpack(&packed);
    gaussians.validate_read(object, limits)?;
    let mut remarks = Vec::new();
    if packed.flags & EXTENDED != 0 {
        remarks.push("vendor extensions are not read; if one states other axes than right, up and back, the model is turned or mirrored".to_string());
    }
    Ok(GaussianFile { gaussians, antialiased: packed.flags & ANTIALIASED != 0, remarks })
}

/// Refuses counts over the limits and headers that no writer makes, before memory is allocated.
fn check_header(object: &str, count: u64, sh_degree: usize, fraction: u8, limits: &Limits) -> Result<()> {
    limits.check_gaussians(object, count)?;
    if sh_degree > 4 || fraction > 24 {
        let problem = format!("degree {sh_degree} and {fraction} fractional bits are impossible");
        return Err(Error::data(object, problem, "Fetch the file again"));
    }
    limits.check_bytes(object, count.saturating_mul(4 * (15 + 3 * sh_rest_len(sh_degree) as u64)))
}

fn unknown_version(object: &str, version: u32) -> Error {
    Error::unsupported(object, format!("SPZ version {version}"), "Versions 2 to 4 are read; convert the file")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Seed;
    use crate::conformance::uniform;

    fn sample(count: usize, sh_degree: usize) -> HostGaussians {
        let draw = |i: usize, k: usize| uniform(Seed::root(3).index(i as u64), k);
        let mut g = HostGaussians { sh_degree, ..Default::default() };
        let fill = |width: usize, scale: f32, from: usize| -> Vec<f32> {
            (0..count).flat_map(|i| (0..width).map(move |k| (i, k))).map(|(i, k)| scale * draw(i, from + k)).collect()
        };
        g.means = fill(3, 20.0, 0);
        g.log_scales = fill(3, 4.0, 3);
        g.quaternions = fill(4, 2.0, 6);
        g.opacity_logits = fill(1, 4.0, 10);
        g.sh_dc = fill(3, 1.5, 11);
        g.sh_rest = fill(3 * sh_rest_len(sh_degree), 0.9, 14);
        g.dynamic_scores = vec![0.0; count];
        g
    }

    #[test]
    fn both_versions_hold_the_same_values() {
        for (count, degree) in [(0, 0), (1, 3), (300, 0), (300, 2), (50, 4)] {
            let gaussians = sample(count, degree);
            let read = |version| {
                let antialiased = count == 300;
                let bytes = to_spz(&gaussians, &SpzOptions { antialiased, ..SpzOptions::version(version) }).unwrap();
                assert_eq!(bytes.starts_with(&PLAIN_MAGIC), version == 4);
                let file = from_spz("t", &bytes, &Limits::default()).unwrap();
                assert_eq!(file.antialiased, antialiased);
                file.gaussians
            };
            let (three, four) = (read(3), read(4));
            assert!(three == four, "{count} Gaussians of degree {degree}");
            let far = gaussians.means.iter().zip(&four.means).fold(0.0f32, |a, (x, y)| a.max((x - y).abs()));
            assert!(four.len() == count && far < 1e-5, "{far}");
        }
        assert!(to_spz(&sample(1, 0), &SpzOptions::version(2)).is_err());
    }

    #[test]
    fn extensions_that_are_skipped_are_told() {
        let mut bytes = to_spz(&sample(5, 1), &SpzOptions::version(4)).unwrap();
        let read = |bytes: &[u8]| from_spz("t", bytes, &Limits::default()).unwrap();
        let plain = read(&bytes);
        assert!(plain.remarks.is_empty());
        // The flags of the header.
        bytes[14] |= EXTENDED;
        let extended = read(&bytes);
        assert!(extended.remarks[0].contains("vendor extensions are not read") && extended.gaussians == plain.gaussians);
    }

    #[test]
    fn damaged_files_of_version_4_are_errors_or_valid() {
        let good = to_spz(&sample(40, 1), &SpzOptions::version(4)).unwrap();
        for cut in 0..good.len() {
            assert!(from_spz("t", &good[..cut], &Limits::default()).is_err(), "truncated at {cut}");
        }
        for at in 0..good.len().min(400) {
            for flip in [1u8, 0x80, 0xff] {
                let mut bad = good.clone();
                bad[at] ^= flip;
                from_spz("t", &bad, &Limits { max_bytes: 1 << 20, max_gaussians: 1000, ..Limits::default() }).ok();
            }
        }
        let mut many = good.clone();
        many[8..12].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(matches!(from_spz("t", &many, &Limits::default()), Err(Error::Limit { .. })));
        assert!(from_spz("t", &[good.as_slice(), &[0]].concat(), &Limits::default()).is_err());
    }
}
