//! L1 + SSIM of planar images with the gradient in the same passes (3DGS loss; SSIM as Inria computes it: 11x11 Gaussian of
//! sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2).
//!
//! Three sweeps over rows, each parallel: a horizontal blur of four fields; a vertical blur, the SSIM map and its three derivative
//! fields, blurred horizontally while still in cache; a vertical blur of those and the gradient. The window is symmetric, so the
//! adjoint of the blur is the blur.

use crate::cpu::scratch::scratch;
use pulp::Arch;
use rayon::prelude::*;

const RADIUS: usize = 5;
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
/// Rows of a field are padded to this many columns, so that vector loops have no remainder.
const LANES: usize = 64;
/// Rows per task: enough work to be worth a task, few enough to balance two threads on a small image.
const ROWS: usize = 8;

/// What the loss is made of, averaged over all pixels and channels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotometricTerms {
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean structural similarity.
    pub ssim: f64,
    /// Mean squared difference.
    pub mse: f64,
}

/// Weights of the window from its edge to its centre; the window is symmetric and sums to 1.
fn half_window() -> [f32; RADIUS + 1] {
    let weight = |i: usize| (-((RADIUS - i) as f64).powi(2) / (2.0 * 1.5 * 1.5)).exp();
    let sum: f64 = (0..RADIUS).map(|i| 2.0 * weight(i)).sum::<f64>() + weight(RADIUS);
    std::array::from_fn(|i| (weight(i) / sum) as f32)
}

/// One output row or run: the symmetric 11-tap sum of `taps`, all of one length.
#[inline(always)]
fn blur(out: &mut [f32], taps: [&[f32]; 11], g: &[f32; 6]) {
    let n = out.len();
    let t = taps.map(|tap| &tap[..n]);
    for i in 0..n {
        let mut sum = g[5] * t[5][i];
        sum += g[4] * (t[4][i] + t[6][i]);
        sum += g[3] * (t[3][i] + t[7][i]);
        sum += g[2] * (t[2][i] + t[8][i]);
        sum += g[1] * (t[1][i] + t[9][i]);
        sum += g[0] * (t[0][i] + t[10][i]);
        out[i] = sum;
    }
}

/// Horizontal blur of a row that carries [`RADIUS`] zeros on each side of its `out.len()` columns.
#[inline(always)]
fn blur_padded(out: &mut [f32], padded: &[f32], g: &[f32; 6]) {
    blur(out, std::array::from_fn(|k| &padded[k..]), g);
}

/// Sum in a fixed order that vectorises; float64 at the end, because a plane has many rows.
#[inline(always)]
fn sum(values: &[f32]) -> f64 {
    let mut lanes = [0.0f32; 16];
    let chunks = values.chunks_exact(16);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for (lane, v) in lanes.iter_mut().zip(chunk) {
            *lane += v;
        }
    }
    lanes.iter().map(|&l| f64::from(l)).sum::<f64>() + f64::from(rest)
}

/// The loss terms of `image` against `target`, both planar [channels, height, width]. With `gradient` [channels, height, width],
/// writes d(lambda_c * l1 + (1 - lambda_c) * (1 - ssim)) / d image there; the derivative of |0| is 0.
pub fn photometric(
    image: &[f32],
    target: &[f32],
    (channels, height, width): (usize, usize, usize),
    lambda_c: f32,
    gradient: Option<&mut [f32]>,
) -> PhotometricTerms {
    let rows = channels * height;
    if rows * width == 0 {
        return PhotometricTerms::default();
    }
    let g = half_window();
    let stride = width.next_multiple_of(LANES);
    let arch = Arch::new();

    let mut blurred = scratch(rows * 4 * stride);
    let mut row_terms = vec![[0.0f64; 3]; rows];
    blurred.par_chunks_mut(ROWS * 4 * stride).zip(row_terms.par_chunks_mut(ROWS)).enumerate().for_each(|(task, (fields, terms))| {
        let mut padded = scratch(4 * (stride + 2 * RADIUS) + 2 * width);
        for (i, (fields, terms)) in fields.chunks_exact_mut(4 * stride).zip(terms).enumerate() {
            let at = (task * ROWS + i) * width;
            let (x, y) = (&image[at..at + width], &target[at..at + width]);
            arch.dispatch(|| first_row(x, y, fields, terms, &mut padded, &g));
        }
    });

    let zeros = vec![0.0f32; 4 * stride];
    let with_gradient = gradient.is_some();
    let mut derivatives = scratch(if with_gradient { rows * 3 * stride } else { 0 });
    // Without a gradient the second sweep writes no field; chunks of one float keep the zip below alive.
    let mut none = scratch(if with_gradient { 0 } else { rows });
    let (sink, width_out) = if with_gradient { (&mut *derivatives, 3 * stride) } else { (&mut *none, 1) };
    sink.par_chunks_mut(ROWS * width_out).zip(row_terms.par_chunks_mut(ROWS)).enumerate().for_each(|(task, (out, terms))| {
        let mut work = scratch(4 * stride + stride + 3 * (stride + 2 * RADIUS));
        for (i, (out, terms)) in out.chunks_exact_mut(width_out).zip(terms).enumerate() {
            let taps = neighbours(task * ROWS + i, height, &blurred, 4 * stride, &zeros);
            let out = with_gradient.then_some(out);
            arch.dispatch(|| second_row(taps, width, out, terms, &mut work, &g));
        }
    });

    if let Some(gradient) = gradient {
        let scale = 1.0 / (rows * width) as f32;
        let (l1_scale, ssim_scale) = (lambda_c * scale, -(1.0 - lambda_c) * scale);
        gradient[..rows * width].par_chunks_mut(ROWS * width).enumerate().for_each(|(task, out)| {
            let mut work = scratch(3 * stride);
            for (i, out) in out.chunks_exact_mut(width).enumerate() {
                let row = task * ROWS + i;
                let taps = neighbours(row, height, &derivatives, 3 * stride, &zeros);
                let (x, y) = (&image[row * width..][..width], &target[row * width..][..width]);
                arch.dispatch(|| third_row(taps, x, y, out, &mut work, (l1_scale, ssim_scale), &g));
            }
        });
    }

    let total = row_terms.iter().fold([0.0f64; 3], |a, t| [a[0] + t[0], a[1] + t[1], a[2] + t[2]]);
    let count = (rows * width) as f64;
    PhotometricTerms { l1: total[0] / count, ssim: total[1] / count, mse: total[2] / count }
}

/// The rows `row - 5 ..= row + 5` of the same channel; zeros beyond its edges.
fn neighbours<'a>(row: usize, height: usize, fields: &'a [f32], row_len: usize, zeros: &'a [f32]) -> [&'a [f32]; 11] {
    let in_channel = row % height;
    std::array::from_fn(|k| {
        let inside = in_channel + k >= RADIUS && in_channel + k - RADIUS < height;
        if inside { &fields[(row + k - RADIUS) * row_len..][..row_len] } else { &zeros[..row_len] }
    })
}

/// Horizontal blur of x, y, x^2 + y^2 and xy; row sums of |x - y| and (x - y)^2.
#[inline(always)]
fn first_row(x: &[f32], y: &[f32], fields: &mut [f32], terms: &mut [f64; 3], work: &mut [f32], g: &[f32; 6]) {
    let width = x.len();
    let stride = fields.len() / 4;
    let padded_len = stride + 2 * RADIUS;
    let (padded, differences) = work.split_at_mut(4 * padded_len);
    for row in padded.chunks_exact_mut(padded_len) {
        row[..RADIUS].fill(0.0);
        row[RADIUS + width..].fill(0.0);
    }
    let mut rows = padded.chunks_exact_mut(padded_len);
    if let (Some(px), Some(py), Some(ps), Some(pp)) = (rows.next(), rows.next(), rows.next(), rows.next()) {
        let inner = RADIUS..RADIUS + width;
        let (px, py, ps, pp) = (&mut px[inner.clone()], &mut py[inner.clone()], &mut ps[inner.clone()], &mut pp[inner]);
        let (absolute, squared) = differences.split_at_mut(width);
        let squared = &mut squared[..width];
        let y = &y[..width];
        for i in 0..width {
            px[i] = x[i];
            py[i] = y[i];
            ps[i] = x[i] * x[i] + y[i] * y[i];
            pp[i] = x[i] * y[i];
            let d = x[i] - y[i];
            absolute[i] = d.abs();
            squared[i] = d * d;
        }
        terms[0] = sum(absolute);
        terms[2] = sum(squared);
    }
    for (out, padded) in fields.chunks_exact_mut(stride).zip(padded.chunks_exact(padded_len)) {
        blur_padded(out, padded, g);
    }
}

/// Vertical blur, the SSIM of the row and, if asked for, the horizontally blurred derivatives of SSIM with respect to
/// E[x], E[x^2] and E[xy].
#[inline(always)]
fn second_row(taps: [&[f32]; 11], width: usize, out: Option<&mut [f32]>, terms: &mut [f64; 3], work: &mut [f32], g: &[f32; 6]) {
    let stride = taps[0].len() / 4;
    let (moments, work) = work.split_at_mut(4 * stride);
    blur(moments, taps, g);
    let (map, padded) = work.split_at_mut(stride);
    let map = &mut map[..width];
    let (mu_x, moments) = moments.split_at(stride);
    let (mu_y, moments) = moments.split_at(stride);
    let (squares, products) = moments.split_at(stride);
    let (mu_x, mu_y, squares, products) = (&mu_x[..width], &mu_y[..width], &squares[..width], &products[..width]);
    let Some(out) = out else {
        for i in 0..width {
            map[i] = similarity(mu_x[i], mu_y[i], squares[i], products[i]).0;
        }
        terms[1] = sum(map);
        return;
    };
    let padded_len = stride + 2 * RADIUS;
    for row in padded.chunks_exact_mut(padded_len) {
        row[..RADIUS].fill(0.0);
        row[RADIUS + width..].fill(0.0);
    }
    let (d_mu, rest) = padded.split_at_mut(padded_len);
    let (d_square, d_product) = rest.split_at_mut(padded_len);
    {
        let inner = RADIUS..RADIUS + width;
        let (d_mu, d_square, d_product) = (&mut d_mu[inner.clone()], &mut d_square[inner.clone()], &mut d_product[inner]);
        for i in 0..width {
            let (s, [a, b, c]) = similarity(mu_x[i], mu_y[i], squares[i], products[i]);
            map[i] = s;
            d_mu[i] = a;
            d_square[i] = b;
            d_product[i] = c;
        }
    }
    terms[1] = sum(map);
    let (out_mu, rest) = out.split_at_mut(stride);
    let (out_square, out_product) = rest.split_at_mut(stride);
    blur_padded(out_mu, d_mu, g);
    blur_padded(out_square, d_square, g);
    blur_padded(out_product, d_product, g);
}

/// SSIM from the local moments E[x], E[y], E[x^2 + y^2], E[xy], and its derivatives with respect to E[x], E[x^2], E[xy].
#[inline(always)]
fn similarity(mu_x: f32, mu_y: f32, squares: f32, products: f32) -> (f32, [f32; 3]) {
    let mu_product = mu_x * mu_y;
    let mu_squares = mu_x * mu_x + mu_y * mu_y;
    let a = 2.0 * mu_product + C1;
    let b = 2.0 * (products - mu_product) + C2;
    let c = mu_squares + C1;
    let d = squares - mu_squares + C2;
    let inverse = 1.0 / (c * d);
    let s = a * b * inverse;
    let (inverse_c, inverse_d) = (d * inverse, c * inverse);
    let d_mu = 2.0 * (mu_y * (b - a) * inverse + mu_x * s * (inverse_d - inverse_c));
    (s, [d_mu, -s * inverse_d, 2.0 * a * inverse])
}

/// Vertical blur of the derivative fields and the gradient of the row.
#[inline(always)]
fn third_row(taps: [&[f32]; 11], x: &[f32], y: &[f32], out: &mut [f32], work: &mut [f32], (l1_scale, ssim_scale): (f32, f32), g: &[f32; 6]) {
    blur(work, taps, g);
    let stride = work.len() / 3;
    let width = out.len();
    let (d_mu, d_square, d_product) = (&work[..width], &work[stride..][..width], &work[2 * stride..][..width]);
    let (x, y) = (&x[..width], &y[..width]);
    for i in 0..width {
        let difference = x[i] - y[i];
        let sign = f32::from(u8::from(difference > 0.0)) - f32::from(u8::from(difference < 0.0));
        out[i] = l1_scale * sign + ssim_scale * (d_mu[i] + 2.0 * x[i] * d_square[i] + y[i] * d_product[i]);
    }
}

/// Mean binary cross-entropy of logits against targets in 0..1, stable for logits of any size: max(x,0) - x z + ln(1 + e^-|x|).
/// With `gradient`, writes (sigmoid(x) - z) / n there.
pub fn bce_with_logits(logits: &[f32], targets: &[f32], gradient: Option<&mut [f32]>) -> f64 {
    const CHUNK: usize = 4096;
    if logits.is_empty() {
        return 0.0;
    }
    let n = logits.len() as f64;
    let loss = |x: f32, z: f32| x.max(0.0) - x * z + (-x.abs()).exp().ln_1p();
    let partial: Vec<f64> =
        logits.par_chunks(CHUNK).zip(targets.par_chunks(CHUNK)).map(|(x, z)| x.iter().zip(z).map(|(&x, &z)| f64::from(loss(x, z))).sum()).collect();
    if let Some(gradient) = gradient {
        let scale = (1.0 / n) as f32;
        gradient.par_chunks_mut(CHUNK).zip(logits.par_chunks(CHUNK)).zip(targets.par_chunks(CHUNK)).for_each(|((out, x), z)| {
            for ((out, &x), &z) in out.iter_mut().zip(x).zip(z) {
                // exp(-|x|) never overflows; both branches of the sigmoid are exact in it.
                let e = (-x.abs()).exp();
                let sigmoid = if x >= 0.0 { 1.0 / (1.0 + e) } else { e / (1.0 + e) };
                *out = scale * (sigmoid - z);
            }
        });
    }
    partial.iter().sum::<f64>() / n
}
