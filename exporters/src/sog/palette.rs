//! Harmonics as a palette of vectors and a label per Gaussian.

use super::codebook::Codebook;
use super::{HIGHEST_DEGREE, Pixels};
use cc4dgs_codecs::kmeans;
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::{HostGaussians, Result, Seed};
use serde_json::{Value, json};

/// Vectors per row of the palette's image.
const PER_ROW: usize = 64;
/// Vectors that the palette is trained on, per vector of the palette.
const SAMPLES: usize = 12;

/// The entry `shN` of the metadata, and the images of palette and labels.
pub fn harmonics(gaussians: &HostGaussians, size: usize, iterations: usize) -> Result<(Value, [Pixels; 2])> {
    let bands = gaussians.sh_degree.min(HIGHEST_DEGREE);
    let (coefficients, stored) = (sh_rest_len(bands), sh_rest_len(gaussians.sh_degree));
    let width = 3 * coefficients;
    let vectors: Vec<f32> = gaussians.sh_rest.chunks_exact(3 * stored).flat_map(|all| &all[..width]).copied().collect();
    let count = gaussians.len();
    // Evenly spread along the Morton curve, so that every region of the scene takes part.
    let samples = count.min(size.saturating_mul(SAMPLES));
    let sample: Vec<f32> = (0..samples).flat_map(|i| &vectors[(i as u64 * count as u64 / samples as u64) as usize * width..][..width]).copied().collect();
    // A constant seed for the start of k-means, so that equal models give equal bytes.
    let centers = kmeans::cluster(&sample, width, size, iterations, Seed::root(0).child("sog-palette"));
    let labels = kmeans::assign(&vectors, width, &centers).labels;
    let book = Codebook::of(&centers);
    let entries = centers.len() / width;
    let label_pixels = labels.iter().map(|&label| [label as u8, (label >> 8) as u8, 0, 255]);
    let value = |entry: usize, k: usize| -> [u8; 4] {
        let at = entry * width + 3 * k;
        let [r, g, b] = [centers[at], centers[at + 1], centers[at + 2]].map(|v| book.index(v));
        [r, g, b, 255]
    };
    let palette_pixels = (0..entries).flat_map(|entry| (0..coefficients).map(move |k| value(entry, k)));
    let height = entries.div_ceil(PER_ROW).next_multiple_of(4);
    let palette = Pixels::sized(PER_ROW * coefficients, height, palette_pixels);
    let meta = json!({ "count": entries, "bands": bands, "codebook": book.values(), "files": ["shN_centroids.webp", "shN_labels.webp"] });
    Ok((meta, [palette, Pixels::of(label_pixels)?]))
}
