//! `sog`: PlayCanvas' SOG, version 2: a ZIP file of lossless WebP images and a `meta.json`.
//!
//! One pixel per Gaussian, along a Morton curve. Centres have 16 bits of sign(x) ln(1 + |x|) between their extremes, rotations the three smaller components in
//! 8 bits each, log-scales and colours an index into 256 values each, opacities 8 bits; harmonics share a palette of vectors.

mod codebook;
mod palette;
mod zip;

use crate::still::{self, byte, sigmoid, unit};
use cc4dgs_codecs::morton;
use cc4dgs_format::{Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, HostGaussians, Plugin, Result, config, inventory};
use codebook::Codebook;
use image_webp::{ColorType, WebPEncoder};
use serde::Deserialize;
use serde_json::json;
use std::path::Path;
pub use zip::stored;

const SCHEMA: &str = "\
palette = 4096           # vectors that the harmonics share, 64 to 65536; more are better, larger and slower
iterations = 6           # of k-means for the palette
";
/// Highest degree of harmonics of the format.
const HIGHEST_DEGREE: usize = 3;
/// Largest side of an image in pixels, a multiple of 4.
const LARGEST_SIDE: usize = 16_380;
/// Largest code of a coordinate: 16 bits.
const LARGEST_CODE: f64 = 65_535.0;
/// Steps of centres from this share of a Gaussian's standard deviation on are coarse.
const COARSE: f64 = 0.1;

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Sog {
    palette: usize,
    iterations: usize,
}

impl Default for Sog {
    fn default() -> Self {
        Self { palette: 4096, iterations: 6 }
    }
}

impl Exporter for Sog {
    fn loses(&self, facts: &ExportFacts) -> String {
        let parts = [
            (facts.sh_degree > HIGHEST_DEGREE, "harmonics over degree 3"),
            (true, "background"),
            (true, "dynamic scores"),
            (true, "all but 16 bits of positions and 8 of all else (harmonics: a palette)"),
        ];
        still::sentence(facts, &parts)
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let gaussians = still::instant(source, "SOG", 2)?;
        let file = self.to_bytes(&gaussians, source.facts().antialiased)?;
        source.progress(2, 2)?;
        still::write(path, &file)?;
        let notes = coarse_steps(&gaussians).into_iter().collect();
        Ok(Exported { gaussians: gaussians.len(), sh_degree: gaussians.sh_degree.min(HIGHEST_DEGREE), frames: 1, notes })
    }
}

/// RGBA pixels, one per Gaussian, and zeros up to the size of the image.
struct Pixels {
    width: usize,
    height: usize,
    data: Vec<u8>,
}

impl Pixels {
    /// An image that is as square as multiples of 4 allow.
    fn of(pixels: impl ExactSizeIterator<Item = [u8; 4]>) -> Result<Self> {
        let count = pixels.len();
        let width = ((count as f64).sqrt().ceil() as usize).next_multiple_of(4).max(4);
        let height = count.div_ceil(width).next_multiple_of(4).max(4);
        if width > LARGEST_SIDE {
            return Err(Error::limit("SOG image", count as u64, (LARGEST_SIDE * LARGEST_SIDE) as u64, "Prune the model"));
        }
        Ok(Self::sized(width, height, pixels))
    }
    fn sized(width: usize, height: usize, pixels: impl Iterator<Item = [u8; 4]>) -> Self {
        let mut data: Vec<u8> = pixels.flatten().collect();
        data.resize(4 * width * height, 0);
        Self { width, height, data }
    }
    fn to_webp(&self) -> Result<Vec<u8>> {
        let mut out = Vec::new();
        let encoded = WebPEncoder::new(&mut out).encode(&self.data, self.width as u32, self.height as u32, ColorType::Rgba8);
        encoded.map_err(|e| Error::backend("WebP", e.to_string(), "Report this as a defect"))?;
        Ok(out)
    }
}

impl Sog {
    /// The file: images and metadata.
    fn to_bytes(self, gaussians: &HostGaussians, antialiased: bool) -> Result<Vec<u8>> {
        let gaussians = &gaussians.select(&morton::order(&gaussians.means));
        let (low, high, mins, maxs) = positions(&gaussians.means)?;
        let scales = Codebook::of(&gaussians.log_scales);
        let colors = Codebook::of(&gaussians.sh_dc);
        let rotations: Vec<Option<[f32; 4]>> = gaussians.quaternions.as_chunks::<4>().0.iter().map(unit).collect();
        let indexed = |book: &Codebook, values: &[f32]| values.as_chunks::<3>().0.iter().map(|v| v.map(|v| book.index(v))).collect::<Vec<_>>();
        let scale_pixels = indexed(&scales, &gaussians.log_scales).into_iter().map(|[x, y, z]| [x, y, z, 255]);
        // A rotation of length zero is not drawn.
        let opacities = gaussians.opacity_logits.iter().zip(&rotations).map(|(o, q)| if q.is_some() { byte(sigmoid(*o)) } else { 0 });
        let color_pixels: Vec<[u8; 4]> = indexed(&colors, &gaussians.sh_dc).into_iter().zip(opacities).map(|([r, g, b], a)| [r, g, b, a]).collect();
        let mut files = vec![
            ("means_l.webp", low.to_webp()?),
            ("means_u.webp", high.to_webp()?),
            ("scales.webp", Pixels::of(scale_pixels)?.to_webp()?),
            ("quats.webp", Pixels::of(rotations.iter().map(|q| quaternion_pixel(q.unwrap_or([1.0, 0.0, 0.0, 0.0]))))?.to_webp()?),
            ("sh0.webp", Pixels::of(color_pixels.into_iter())?.to_webp()?),
        ];
        let mut meta = json!({
            "version": 2,
            "asset": { "generator": concat!("cc4dgs ", env!("CARGO_PKG_VERSION")) },
            "count": gaussians.len(),
            "antialias": antialiased,
            "means": { "mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"] },
            "scales": { "codebook": scales.values(), "files": ["scales.webp"] },
            "quats": { "files": ["quats.webp"] },
            "sh0": { "codebook": colors.values(), "files": ["sh0.webp"] },
        });
        if gaussians.sh_degree > 0 && !gaussians.is_empty() {
            let (harmonics, [centroids, labels]) = palette::harmonics(gaussians, self.palette, self.iterations)?;
            meta["shN"] = harmonics;
            files.extend([("shN_centroids.webp", centroids.to_webp()?), ("shN_labels.webp", labels.to_webp()?)]);
        }
        files.insert(0, ("meta.json", meta.to_string().into_bytes()));
        zip::store(&files)
    }
}

/// The centres in the logarithmic domain, and their extremes per axis.
fn logarithmic(means: &[f32]) -> (Vec<[f64; 3]>, [f64; 3], [f64; 3]) {
    let log = |v: f32| f64::from(v).signum() * f64::from(v).abs().ln_1p();
    let points: Vec<[f64; 3]> = means.as_chunks::<3>().0.iter().map(|p| p.map(log)).collect();
    let corner =
        |pick: fn(f64, f64) -> f64| -> [f64; 3] { points.iter().copied().reduce(|a, p| std::array::from_fn(|k| pick(a[k], p[k]))).unwrap_or_default() };
    let (mins, maxs) = (corner(f64::min), corner(f64::max));
    (points, mins, maxs)
}

/// A message where the steps of centres are coarse compared with the Gaussians: steps grow with the logarithm of the extremes, and with the distance from the
/// origin.
fn coarse_steps(gaussians: &HostGaussians) -> Option<String> {
    let (points, mins, maxs) = logarithmic(&gaussians.means);
    // A step in the logarithmic domain is 1 + |x| times as long at x.
    let step = |p: &[f64; 3]| (0..3).map(|k| (maxs[k] - mins[k]) / LARGEST_CODE * p[k].abs().exp()).fold(0.0, f64::max);
    let mut steps: Vec<f64> = points.iter().map(step).collect();
    let mut sizes: Vec<f64> = gaussians.log_scales.iter().map(|s| f64::from(*s).exp()).collect();
    let [step, size] = [median(&mut steps)?, median(&mut sizes)?];
    (step > COARSE * size).then(|| format!("centres are in steps of {step:.2e} (median), coarse beside the median standard deviation of {size:.2e}"))
}

/// The middle one of `values`, which are reordered; `None` without any.
fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Lower and upper bytes of the centres, and the extremes per axis in the logarithmic domain.
fn positions(means: &[f32]) -> Result<(Pixels, Pixels, [f64; 3], [f64; 3])> {
    let (points, mins, maxs) = logarithmic(means);
    let code = |p: &[f64; 3]| -> [u16; 3] {
        std::array::from_fn(|k| {
            let width = maxs[k] - mins[k];
            if width > 0.0 { ((p[k] - mins[k]) / width * LARGEST_CODE).round() as u16 } else { 0 }
        })
    };
    let codes: Vec<[u16; 3]> = points.iter().map(code).collect();
    let pixel = |shift: u32| codes.iter().map(move |c| [(c[0] >> shift) as u8, (c[1] >> shift) as u8, (c[2] >> shift) as u8, 255]);
    Ok((Pixels::of(pixel(0))?, Pixels::of(pixel(8))?, mins, maxs))
}

/// The three smaller components of a unit quaternion (w,x,y,z), and in alpha which one is missing.
fn quaternion_pixel(q: [f32; 4]) -> [u8; 4] {
    let largest = (1..4).fold(0, |a, k| if q[k].abs() > q[a].abs() { k } else { a });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut pixel = [0, 0, 0, 252 + largest as u8];
    for (to, k) in pixel.iter_mut().zip((0..4).filter(|&k| k != largest)) {
        *to = byte(sign * q[k] * std::f32::consts::SQRT_2 * 0.5 + 0.5);
    }
    pixel
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    let sog: Sog = config::parse_section("exporter sog", settings)?;
    if !(64..=65_536).contains(&sog.palette) || sog.iterations > 100 {
        let problem = format!("a palette of {} after {} iterations", sog.palette, sog.iterations);
        return Err(Error::parameter("exporter sog", problem, "Give a palette of 64 to 65536 and at most 100 iterations"));
    }
    Ok(Box::new(sog))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "sog",
            version: "2",
            summary: "PlayCanvas' SOG: images in a ZIP file",
            paper: "The SOG Format (PlayCanvas 2025), version 2",
            schema: SCHEMA,
            capabilities: &["still"],
        },
        target: ExportTarget::File("sog"),
        build,
    }
}
