//! Blending pixel by pixel over the whole depth-sorted list, forwards and backwards. Sums over pixels and planes are float64; everything that is summed is
//! computed in the precision T.

use super::gaussian::TileRange;
use super::real::Real;
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
struct Touch<T> {
    item: usize,
    dx: T,
    dy: T,
    alpha: T,
    /// Alpha before the cap.
    uncapped: T,
    /// Transmittance in front of it.
    before: T,
}

/// The numbers of an item in the precision T; they come from there, so nothing is rounded.
fn numbers<T: Real>(item: &Item) -> [T; RECORD] {
    item.numbers.map(T::constant)
}

/// Whether the tiles that an item is restricted to, if any, hold a pixel.
fn reaches(item: &Item, column: usize, row: usize) -> bool {
    item.tiles.is_none_or(|[columns, rows]| (columns[0]..columns[1]).contains(&(column / 16)) && (rows[0]..rows[1]).contains(&(row / 16)))
}

/// The Gaussians that contribute at a pixel, front to back, and the transmittance left.
fn touches<T: Real>(items: &[Item], settings: &RasterSettings, column: usize, row: usize) -> (Vec<Touch<T>>, T) {
    let rules = RuleConstants::new(settings);
    let (cap, least, stop) = (f64::from(rules.alpha_max), f64::from(ALPHA_MIN), f64::from(TRANSMITTANCE_STOP));
    let (one, half) = (T::constant(1.0), T::constant(0.5));
    let mut found = Vec::new();
    let mut left = one;
    for (k, item) in items.iter().enumerate() {
        if !reaches(item, column, row) {
            continue;
        }
        let [x, y, a, b, c, opacity, ..] = numbers::<T>(item);
        let (dx, dy) = (T::constant(column as f64 + 0.5) - x, T::constant(row as f64 + 0.5) - y);
        let sigma = half * (a * dx * dx + c * dy * dy) + b * dx * dy;
        let uncapped = opacity * (-sigma).exp();
        let alpha = uncapped.smaller(T::constant(cap));
        if sigma.value() < 0.0 || alpha.value() < least || alpha.value().is_nan() {
            continue;
        }
        let after = left * (one - alpha);
        if after.value() <= stop {
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
pub fn blend<T: Real>(items: &[Item], settings: &RasterSettings, background: [f64; 3]) -> Blended {
    let plane = settings.width * settings.height;
    let mut image = Blended { planes: vec![0.0; 5 * plane], max_weights: vec![0.0; items.len()], pairs: 0 };
    for row in 0..settings.height {
        for column in 0..settings.width {
            let pixel = row * settings.width + column;
            let (found, left) = touches::<T>(items, settings, column, row);
            image.pairs += found.len() as u64;
            for touch in &found {
                let weight = touch.alpha * touch.before;
                let numbers = numbers::<T>(&items[touch.item]);
                for c in 0..3 {
                    image.planes[c * plane + pixel] += (weight * numbers[AT_COLOR + c]).value();
                }
                image.planes[4 * plane + pixel] += (weight * numbers[AT_DEPTH]).value();
                image.max_weights[touch.item] = image.max_weights[touch.item].max(weight.value());
            }
            for c in 0..3 {
                image.planes[c * plane + pixel] += (left * T::constant(background[c])).value();
            }
            image.planes[3 * plane + pixel] = (T::constant(1.0) - left).value();
        }
    }
    image
}

/// The gradients of the inputs of [`blend`].
pub struct BlendGradients {
    /// Of the numbers of every item.
    pub items: Vec<[f64; RECORD]>,
    /// Sums over pixels of the absolute gradients of every item's centre.
    pub absolute_centers: Vec<[f64; 2]>,
    /// Of the background.
    pub background: [f64; 3],
}

/// Gradients for `upstream` `[5,H,W]`.
pub fn blend_backward<T: Real>(items: &[Item], settings: &RasterSettings, background: [f64; 3], upstream: &[f64]) -> BlendGradients {
    let rules = RuleConstants::new(settings);
    let plane = settings.width * settings.height;
    let mut out = BlendGradients { items: vec![[0.0; RECORD]; items.len()], absolute_centers: vec![[0.0; 2]; items.len()], background: [0.0; 3] };
    let (one, half, background) = (T::constant(1.0), T::constant(0.5), background.map(T::constant));
    let colored = |g: &[T; 5], color: &[T]| g[0] * color[0] + g[1] * color[1] + g[2] * color[2];
    for row in 0..settings.height {
        for column in 0..settings.width {
            let pixel = row * settings.width + column;
            let g: [T; 5] = std::array::from_fn(|k| T::constant(upstream[k * plane + pixel]));
            let (found, left) = touches::<T>(items, settings, column, row);
            for c in 0..3 {
                out.background[c] += (left * g[c]).value();
            }
            // d loss / d transmittance behind everything.
            let mut d_left = colored(&g, &background) - g[3];
            for touch in found.iter().rev() {
                let numbers = numbers::<T>(&items[touch.item]);
                let d = &mut out.items[touch.item];
                let shown = colored(&g, &numbers[AT_COLOR..]) + g[4] * numbers[AT_DEPTH];
                let weight = touch.alpha * touch.before;
                for c in 0..3 {
                    d[AT_COLOR + c] += (weight * g[c]).value();
                }
                d[AT_DEPTH] += (weight * g[4]).value();
                let d_alpha = touch.before * (shown - d_left);
                // The loss is linear in the transmittance in front of this Gaussian.
                d_left = touch.alpha * shown + (one - touch.alpha) * d_left;
                if touch.uncapped.value() > f64::from(rules.alpha_max) && !rules.pass_capped {
                    continue;
                }
                let [_, _, a, b, c, opacity, ..] = numbers;
                let (dx, dy) = (touch.dx, touch.dy);
                d[AT_OPACITY] += (d_alpha * touch.uncapped / opacity).value();
                let d_sigma = -(d_alpha * touch.uncapped);
                let d_center = [-(d_sigma * (a * dx + b * dy)), -(d_sigma * (b * dx + c * dy))].map(T::value);
                d[AT_X] += d_center[0];
                d[AT_Y] += d_center[1];
                for (sum, value) in out.absolute_centers[touch.item].iter_mut().zip(d_center) {
                    *sum += value.abs();
                }
                d[AT_A] += (d_sigma * half * dx * dx).value();
                d[AT_B] += (d_sigma * dx * dy).value();
                d[AT_C] += (d_sigma * half * dy * dy).value();
            }
        }
    }
    out
}

/// How near the decisions at a pixel are to the opposite outcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Margin {
    /// The least relative distance of an alpha from 1/255 or from its cap, or of a transmittance from where a pixel stops. The transmittance behind capped
    /// alphas alone does not count, however near: it is a product of constants.
    pub relative: f64,
    /// The least distance of such a decision in units of what rounding to float32 can change it by.
    pub roundings: f64,
}

/// The margins of all pixels, in float64.
///
/// Rounding moves the exponent sigma by the rounding of its terms, which may be far larger than their sum, and by that of the centre: for a needle, several
/// percent of alpha.
pub fn margins(items: &[Item], settings: &RasterSettings) -> Vec<Margin> {
    let rules = RuleConstants::new(settings);
    let (cap, least, stop) = (f64::from(rules.alpha_max), f64::from(ALPHA_MIN), f64::from(TRANSMITTANCE_STOP));
    let rounding = f64::from(f32::EPSILON);
    let mut margins = Vec::with_capacity(settings.width * settings.height);
    for row in 0..settings.height {
        for column in 0..settings.width {
            let mut margin = Margin { relative: f64::INFINITY, roundings: f64::INFINITY };
            let mut note = |value: f64, threshold: f64, error: f64, constant: bool| {
                let distance = (value / threshold - 1.0).abs();
                if !constant {
                    margin.relative = margin.relative.min(distance);
                }
                margin.roundings = margin.roundings.min(distance / error);
            };
            let (mut left, mut error_left, mut all_capped) = (1.0f64, 0.0f64, true);
            for item in items.iter().filter(|item| reaches(item, column, row)) {
                let [x, y, a, b, c, opacity, ..] = item.numbers;
                let (dx, dy) = (column as f64 + 0.5 - x, row as f64 + 0.5 - y);
                let sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy;
                let terms = 0.5 * (a * dx * dx + c * dy * dy) + (b * dx * dy).abs();
                let slopes = ((a * dx).abs() + (b * dy).abs()) * x.abs().max(1.0) + ((c * dy).abs() + (b * dx).abs()) * y.abs().max(1.0);
                // Relative error of alpha.
                let error = rounding * (1.0 + terms + slopes);
                let uncapped = opacity * (-sigma).exp();
                note(uncapped, least, error, false);
                if sigma < 0.0 || uncapped < least || uncapped.is_nan() {
                    continue;
                }
                note(uncapped, cap, error, false);
                let alpha = uncapped.min(cap);
                // A capped alpha has no error.
                if uncapped <= cap {
                    all_capped = false;
                    error_left += alpha * error / (1.0 - alpha);
                }
                let after = left * (1.0 - alpha);
                note(after, stop, error_left + rounding, all_capped);
                if after <= stop {
                    break;
                }
                left = after;
            }
            margins.push(margin);
        }
    }
    margins
}
