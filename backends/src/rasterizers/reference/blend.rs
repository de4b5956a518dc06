//! Blending pixel by pixel over the whole depth-sorted list, forwards and backwards.

use super::gaussian::TileRange;
use crate::ops::rasterize::camera::{ALPHA_MIN, RuleConstants, TRANSMITTANCE_STOP};
use crate::ops::rasterize::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, RECORD, RasterSettings};

/// A Gaussian on the screen.
#[derive(Clone, Debug)]
pub struct Item {
    /// Which Gaussian.
    pub index: usize,
    /// Centre (2), conic (3), opacity, colour (3), depth.
    pub numbers: [f64; RECORD],
    /// Tiles it is restricted to: first and end per axis.
    pub tiles: Option<TileRange>,
}

/// One Gaussian at one pixel.
struct Touch {
    item: usize,
    dx: f64,
    dy: f64,
    alpha: f64,
    /// Alpha before the cap.
    uncapped: f64,
    /// Transmittance in front of it.
    before: f64,
}

/// The Gaussians that contribute at a pixel, front to back, and the transmittance left.
fn touches(items: &[Item], settings: &RasterSettings, column: usize, row: usize) -> (Vec<Touch>, f64) {
    let rules = RuleConstants::new(settings);
    let (cap, least, stop) = (f64::from(rules.alpha_max), f64::from(ALPHA_MIN), f64::from(TRANSMITTANCE_STOP));
    let mut found = Vec::new();
    let mut left = 1.0;
    for (k, item) in items.iter().enumerate() {
        if let Some([columns, rows]) = item.tiles
            && !((columns[0]..columns[1]).contains(&(column / 16)) && (rows[0]..rows[1]).contains(&(row / 16)))
        {
            continue;
        }
        let [x, y, a, b, c, opacity, ..] = item.numbers;
        let (dx, dy) = (column as f64 + 0.5 - x, row as f64 + 0.5 - y);
        let sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy;
        let uncapped = opacity * (-sigma).exp();
        let alpha = uncapped.min(cap);
        if sigma < 0.0 || alpha < least || alpha.is_nan() {
            continue;
        }
        let after = left * (1.0 - alpha);
        if after <= stop {
            break;
        }
        found.push(Touch { item: k, dx, dy, alpha, uncapped, before: left });
        left = after;
    }
    (found, left)
}

/// The image and what was counted.
pub struct Blended {
    /// Red, green, blue, alpha, depth `[5,H,W]`.
    pub planes: Vec<f64>,
    /// Largest weight per item.
    pub max_weights: Vec<f64>,
    /// Contributing (Gaussian, pixel) pairs.
    pub pairs: u64,
}

/// Blends depth-sorted `items`.
pub fn blend(items: &[Item], settings: &RasterSettings, background: [f64; 3]) -> Blended {
    let plane = settings.width * settings.height;
    let mut image = Blended { planes: vec![0.0; 5 * plane], max_weights: vec![0.0; items.len()], pairs: 0 };
    for row in 0..settings.height {
        for column in 0..settings.width {
            let pixel = row * settings.width + column;
            let (found, left) = touches(items, settings, column, row);
            image.pairs += found.len() as u64;
            for touch in &found {
                let weight = touch.alpha * touch.before;
                let numbers = &items[touch.item].numbers;
                for c in 0..3 {
                    image.planes[c * plane + pixel] += weight * numbers[AT_COLOR + c];
                }
                image.planes[4 * plane + pixel] += weight * numbers[AT_DEPTH];
                image.max_weights[touch.item] = image.max_weights[touch.item].max(weight);
            }
            for c in 0..3 {
                image.planes[c * plane + pixel] += left * background[c];
            }
            image.planes[3 * plane + pixel] = 1.0 - left;
        }
    }
    image
}

/// What flows out of [`blend`].
pub struct BlendGradients {
    /// Of the numbers of every item.
    pub items: Vec<[f64; RECORD]>,
    /// Sums over pixels of the absolute gradients of every item's centre.
    pub absolute_centers: Vec<[f64; 2]>,
    /// Of the background.
    pub background: [f64; 3],
}

/// Gradients for `upstream` `[5,H,W]`.
pub fn blend_backward(items: &[Item], settings: &RasterSettings, background: [f64; 3], upstream: &[f64]) -> BlendGradients {
    let rules = RuleConstants::new(settings);
    let plane = settings.width * settings.height;
    let mut out = BlendGradients { items: vec![[0.0; RECORD]; items.len()], absolute_centers: vec![[0.0; 2]; items.len()], background: [0.0; 3] };
    for row in 0..settings.height {
        for column in 0..settings.width {
            let pixel = row * settings.width + column;
            let g: [f64; 5] = std::array::from_fn(|k| upstream[k * plane + pixel]);
            let (found, left) = touches(items, settings, column, row);
            for c in 0..3 {
                out.background[c] += left * g[c];
            }
            // d loss / d transmittance behind everything.
            let mut d_left = (0..3).map(|c| g[c] * background[c]).sum::<f64>() - g[3];
            for touch in found.iter().rev() {
                let numbers = &items[touch.item].numbers;
                let d = &mut out.items[touch.item];
                let shown = (0..3).map(|c| g[c] * numbers[AT_COLOR + c]).sum::<f64>() + g[4] * numbers[AT_DEPTH];
                let weight = touch.alpha * touch.before;
                for c in 0..3 {
                    d[AT_COLOR + c] += weight * g[c];
                }
                d[AT_DEPTH] += weight * g[4];
                let d_alpha = touch.before * (shown - d_left);
                // The loss is linear in the transmittance in front of this Gaussian.
                d_left = touch.alpha * shown + (1.0 - touch.alpha) * d_left;
                if touch.uncapped > f64::from(rules.alpha_max) && !rules.pass_capped {
                    continue;
                }
                let [_, _, a, b, c, opacity, ..] = *numbers;
                d[AT_OPACITY] += d_alpha * touch.uncapped / opacity;
                let d_sigma = -d_alpha * touch.uncapped;
                let d_center = [-d_sigma * (a * touch.dx + b * touch.dy), -d_sigma * (b * touch.dx + c * touch.dy)];
                d[AT_X] += d_center[0];
                d[AT_Y] += d_center[1];
                for (sum, value) in out.absolute_centers[touch.item].iter_mut().zip(d_center) {
                    *sum += value.abs();
                }
                d[AT_A] += d_sigma * 0.5 * touch.dx * touch.dx;
                d[AT_B] += d_sigma * touch.dx * touch.dy;
                d[AT_C] += d_sigma * 0.5 * touch.dy * touch.dy;
            }
        }
    }
    out
}
