//! Loss terms: their values.

use cc4dgs_core::HostGaussians;

/// Pixels of the window of SSIM on each side of its centre, and its standard deviation in pixels (3DGS).
const RADIUS: usize = 5;
const DEVIATION: f64 = 1.5;
/// Constants of SSIM, for values in 0..1 (Wang et al. 2004).
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;
/// The weight of L1 in `photometric`; 1 - SSIM has the rest.
const L1_SHARE: f64 = 0.8;

/// What loss terms read.
pub struct LossValues<'a> {
    /// Rendered planes, three or more `[C,H,W]`.
    pub planes: &'a [f32],
    /// Recorded planes `[3,H,W]`, the first of which also serves as the mask.
    pub target: &'a [f32],
    /// Recorded depth `[H,W]`, 0 where it is unknown.
    pub depth: &'a [f32],
    /// H and W.
    pub size: [usize; 2],
    /// One Gaussian or more.
    pub gaussians: &'a HostGaussians,
    /// Extent of the cameras, world units, above 0.
    pub extent: f32,
}

impl LossValues<'_> {
    /// Pixels of a plane.
    fn pixels(&self) -> usize {
        self.size[0] * self.size[1]
    }
    /// Rendered and recorded values, plane by plane.
    fn pairs(&self) -> impl Iterator<Item = (f64, f64)> {
        self.planes.iter().zip(self.target).map(|(x, y)| (f64::from(*x), f64::from(*y)))
    }
}

type Term = fn(&LossValues) -> f64;

/// The terms that have formulas, by name.
pub const TERMS: [(&str, Term); 8] = [
    ("depth", depth),
    ("dssim", dssim),
    ("l1", l1),
    ("mask-bce", mask_bce),
    ("mse", mse),
    ("opacity", opacity),
    ("photometric", photometric),
    ("scale", scale),
];

/// The value of the term called `name`; `None` where there is no formula of it.
pub fn value(name: &str, input: &LossValues) -> Option<f64> {
    TERMS.into_iter().find(|(known, _)| *known == name).map(|(_, term)| term(input))
}

/// Mean difference of the fifth plane and the depth that the fourth, alpha, leaves of the recorded one, over the recorded one where it is known.
fn depth(input: &LossValues) -> f64 {
    let plane = |index: usize| input.planes[index * input.pixels()..].iter().map(|v| f64::from(*v));
    let known = plane(3).zip(plane(4)).zip(input.depth).filter(|(_, d)| **d > 0.0);
    mean(known.map(|((alpha, z), d)| (z - alpha * f64::from(*d)).abs() / f64::from(*d)))
}

fn l1(input: &LossValues) -> f64 {
    mean(input.pairs().map(|(x, y)| (x - y).abs()))
}

fn mse(input: &LossValues) -> f64 {
    mean(input.pairs().map(|(x, y)| (x - y).powi(2)))
}

fn photometric(input: &LossValues) -> f64 {
    L1_SHARE * l1(input) + (1.0 - L1_SHARE) * dssim(input)
}

/// 1 minus the mean structural similarity of all pixels of the three channels.
fn dssim(input: &LossValues) -> f64 {
    let (pixels, size, window) = (input.pixels(), input.size, window());
    let planes = input.planes.chunks_exact(pixels).zip(input.target.chunks_exact(pixels));
    1.0 - mean(planes.flat_map(|(x, y)| (0..pixels).map(move |at| similarity(x, y, size, at, &window))))
}

/// Weights along an axis of the window: a Gaussian whose sum is 1.
fn window() -> [f64; 2 * RADIUS + 1] {
    let weights: [f64; 2 * RADIUS + 1] = std::array::from_fn(|i| (-0.5 * ((i as f64 - RADIUS as f64) / DEVIATION).powi(2)).exp());
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// SSIM of the planes `x` and `y` at the pixel `at`, from means, variances and the covariance under the window. Pixels beyond the image are zeros.
fn similarity(x: &[f32], y: &[f32], [height, width]: [usize; 2], at: usize, window: &[f64]) -> f64 {
    let mut moments = [0.0f64; 5];
    for (i, in_rows) in window.iter().enumerate() {
        for (j, in_columns) in window.iter().enumerate() {
            // What is before the first row or column wraps, and so is past the last.
            let (row, column) = ((at / width + i).wrapping_sub(RADIUS), (at % width + j).wrapping_sub(RADIUS));
            if row < height && column < width {
                let (x, y) = (f64::from(x[row * width + column]), f64::from(y[row * width + column]));
                moments.iter_mut().zip([x, y, x * x, y * y, x * y]).for_each(|(sum, v)| *sum += in_rows * in_columns * v);
            }
        }
    }
    let [mean_x, mean_y, mean_xx, mean_yy, mean_xy] = moments;
    let (squares, product) = (mean_x * mean_x + mean_y * mean_y, mean_x * mean_y);
    (2.0 * product + C1) * (2.0 * (mean_xy - product) + C2) / ((squares + C1) * (mean_xx + mean_yy - squares + C2))
}

/// Mean cross-entropy of the sigmoids of the first plane against the mask z: max(x, 0) - x z + ln(1 + exp(-|x|)).
fn mask_bce(input: &LossValues) -> f64 {
    mean(input.pairs().take(input.pixels()).map(|(x, z)| x.max(0.0) - x * z + (-x.abs()).exp().ln_1p()))
}

fn opacity(input: &LossValues) -> f64 {
    mean(input.gaussians.opacity_logits.iter().map(|logit| 1.0 / (1.0 + (-f64::from(*logit)).exp())))
}

/// Mean standard deviation over the extent.
fn scale(input: &LossValues) -> f64 {
    mean(input.gaussians.log_scales.iter().map(|log| f64::from(*log).exp())) / f64::from(input.extent)
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0f64, 0.0f64), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_one_pixel_are_those_by_hand() {
        let gaussians = HostGaussians { log_scales: vec![0.0; 3], opacity_logits: vec![0.0], ..Default::default() };
        let of = |planes: &[f32], name: &str| {
            let input = LossValues { planes, target: &[0.0; 3], depth: &[2.0], size: [1, 1], gaussians: &gaussians, extent: 2.0 };
            value(name, &input).unwrap()
        };
        // 1 over the sum of exp(-k² / 4.5), k from -5 to 5, is 0.266; the window has its square at the centre. Of the channels, one is a 1 beside a 0.
        let centre = 0.266_011_7f64.powi(2);
        let lonely = C1 * C2 / ((centre * centre + C1) * (centre - centre * centre + C2));
        let planes = [1.0f32, 0.0, 0.0, 7.0, 7.0];
        let dssim = (1.0 - lonely) / 3.0;
        let softplus = 1.0f64.exp().ln_1p();
        // Alpha times depth is 14, and 7 was rendered.
        let wanted = [3.5, dssim, 1.0 / 3.0, softplus, 1.0 / 3.0, 0.5, 0.8 / 3.0 + 0.2 * dssim, 0.5];
        for ((name, _), wanted) in TERMS.into_iter().zip(wanted) {
            assert!((of(&planes, name) - wanted).abs() < 1e-6, "{name}: {} instead of {wanted}", of(&planes, name));
        }
        let gray = [0.5f32; 3];
        assert!(of(&[0.0; 3], "dssim").abs() < 1e-12 && (of(&gray, "l1") - 0.5).abs() < 1e-12 && (of(&gray, "mse") - 0.25).abs() < 1e-12);
        let input = LossValues { planes: &gray, target: &gray, depth: &[2.0], size: [1, 1], gaussians: &gaussians, extent: 2.0 };
        assert!(value("no such term", &input).is_none());
    }
}
