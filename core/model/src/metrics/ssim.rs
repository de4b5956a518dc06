//! Structural similarity with an 11-tap Gaussian window, separable, in float64.

use super::{Padding, Planes, Window};
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A convention of SSIM. All share the 11-tap Gaussian window of sigma 1.5, C1 = 0.01^2, C2 = 0.03^2 for data range 1,
/// population covariances, and average over channels; they differ at the border and therefore in the second decimal.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SsimConvention {
    /// scikit-image with `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`: only windows that lie inside the image.
    Skimage,
    /// Inria's 3DGS code and its descendants: the image is padded with 5 zeros per side, every pixel counts.
    Inria,
}

impl SsimConvention {
    /// The window, which both conventions share.
    pub fn window(self) -> Window {
        Window { taps: 11, sigma: 1.5 }
    }
    /// The rule at the border.
    pub fn padding(self) -> Padding {
        match self {
            Self::Skimage => Padding::Valid,
            Self::Inria => Padding::Zero,
        }
    }
}

/// SSIM of two images of data range 1, mean over windows and channels. With a mask `[H,W]`, only windows centred on set pixels count.
///
/// # Errors
/// [`Error::Parameter`] for different shapes, an image smaller than the window, or a mask without pixels.
pub fn ssim(a: &Planes, b: &Planes, convention: SsimConvention, mask: Option<&[bool]>) -> Result<f64> {
    a.check_pair(b, mask)?;
    let means = channel_means(a, b, convention.padding(), mask)?;
    Ok(means.iter().map(|m| m.ssim).sum::<f64>() / means.len() as f64)
}

const TAPS: usize = 11;
const RADIUS: usize = TAPS / 2;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;
/// Output rows per task: enough to amortise the ten rows of overlap, few enough to give every thread work.
const BAND: usize = 48;

fn gaussian_window() -> [f64; TAPS] {
    let raw: [f64; TAPS] = std::array::from_fn(|i| {
        let x = i as f64 - RADIUS as f64;
        (-0.5 * x * x / (SIGMA * SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

/// Means over the windows of one channel.
#[derive(Clone, Copy, Debug)]
pub(super) struct ChannelMeans {
    /// Luminance times contrast-structure.
    pub ssim: f64,
    /// Contrast-structure alone (the factor MS-SSIM takes from every scale but the last).
    pub contrast: f64,
}

/// SSIM and contrast means per channel; shapes are already checked.
pub(super) fn channel_means(a: &Planes, b: &Planes, padding: Padding, mask: Option<&[bool]>) -> Result<Vec<ChannelMeans>> {
    let pad = match padding {
        Padding::Valid => 0,
        Padding::Zero => RADIUS,
    };
    let (out_width, out_height) = ((a.width() + 2 * pad).saturating_sub(TAPS - 1), (a.height() + 2 * pad).saturating_sub(TAPS - 1));
    if out_width == 0 || out_height == 0 {
        let problem = format!("the image is {}x{}, smaller than the {TAPS}x{TAPS} window", a.width(), a.height());
        return Err(Error::parameter("SSIM without padding", problem, "Compare larger images or use the inria convention"));
    }
    let bands = out_height.div_ceil(BAND);
    let sums: Vec<Sums> = (0..a.channels() * bands)
        .into_par_iter()
        .map(|task| {
            let (channel, first) = (task / bands, task % bands * BAND);
            let rows = first..(first + BAND).min(out_height);
            band_sums(a.plane(channel), b.plane(channel), a.width(), a.height(), pad, rows, mask)
        })
        .collect();
    sums.chunks(bands)
        .map(|chunk| {
            let total = chunk.iter().fold(Sums::default(), |t, s| Sums { ssim: t.ssim + s.ssim, contrast: t.contrast + s.contrast, count: t.count + s.count });
            if total.count == 0 {
                return Err(Error::parameter("metric mask", "no whole window is centred on a set pixel", "Exclude such frames from the frame set"));
            }
            Ok(ChannelMeans { ssim: total.ssim / total.count as f64, contrast: total.contrast / total.count as f64 })
        })
        .collect()
}

#[derive(Clone, Copy, Default)]
struct Sums {
    ssim: f64,
    contrast: f64,
    count: u64,
}

/// Filtered maps needed per pixel: a, b, a^2 + b^2 (the two variances only ever occur as a sum) and a*b.
const MAPS: usize = 4;

/// Sums over output rows `rows` of one plane. A ring of eleven horizontally filtered rows keeps the working set in cache.
fn band_sums(a: &[f64], b: &[f64], width: usize, height: usize, pad: usize, rows: std::ops::Range<usize>, mask: Option<&[bool]>) -> Sums {
    let window = gaussian_window();
    let out_width = width + 2 * pad - (TAPS - 1);
    let mut products: [Vec<f64>; MAPS] = std::array::from_fn(|_| vec![0.0; width + 2 * pad]);
    let mut ring = vec![0.0; TAPS * MAPS * out_width];
    let mut filtered = vec![0.0; MAPS * out_width];
    let mut total = Sums::default();
    for padded_row in rows.start..rows.end + TAPS - 1 {
        let slot = padded_row % TAPS * MAPS * out_width;
        let slot = &mut ring[slot..slot + MAPS * out_width];
        match padded_row.checked_sub(pad).filter(|&r| r < height) {
            None => slot.fill(0.0),
            Some(row) => {
                let (a, b) = (&a[row * width..(row + 1) * width], &b[row * width..(row + 1) * width]);
                let [pa, pb, pq, pc] = &mut products;
                let inner = pad..pad + width;
                pa[inner.clone()].copy_from_slice(a);
                pb[inner.clone()].copy_from_slice(b);
                for ((q, c), (x, y)) in pq[inner.clone()].iter_mut().zip(&mut pc[inner]).zip(a.iter().zip(b)) {
                    *q = x * x + y * y;
                    *c = x * y;
                }
                for (map, out) in products.iter().zip(slot.chunks_exact_mut(out_width)) {
                    for (x, o) in out.iter_mut().enumerate() {
                        let taps = &map[x..x + TAPS];
                        *o = (0..TAPS).fold(0.0, |sum, k| sum + window[k] * taps[k]);
                    }
                }
            }
        }
        let Some(row) = padded_row.checked_sub(TAPS - 1).filter(|&r| r >= rows.start) else { continue };
        filtered.fill(0.0);
        for (k, w) in window.iter().enumerate() {
            let from = (row + k) % TAPS * MAPS * out_width;
            for (f, r) in filtered.iter_mut().zip(&ring[from..from + MAPS * out_width]) {
                *f += w * r;
            }
        }
        let sums = row_sums(&filtered, out_width, |x| mask.is_none_or(|m| m[(row + RADIUS - pad) * width + x + RADIUS - pad]));
        total = Sums { ssim: total.ssim + sums.ssim, contrast: total.contrast + sums.contrast, count: total.count + sums.count };
    }
    total
}

fn row_sums(filtered: &[f64], out_width: usize, keep: impl Fn(usize) -> bool) -> Sums {
    let (mean_a, rest) = filtered.split_at(out_width);
    let (mean_b, rest) = rest.split_at(out_width);
    let (squares, cross) = rest.split_at(out_width);
    let mut sums = Sums::default();
    for x in 0..out_width {
        if !keep(x) {
            continue;
        }
        let (ma, mb) = (mean_a[x], mean_b[x]);
        let energy = ma * ma + mb * mb;
        let contrast = (2.0 * (cross[x] - ma * mb) + C2) / (squares[x] - energy + C2);
        sums.contrast += contrast;
        sums.ssim += (2.0 * ma * mb + C1) / (energy + C1) * contrast;
        sums.count += 1;
    }
    sums
}
