//! L1 + SSIM of planar images with the gradient in the same passes (3DGS loss; SSIM as Inria computes it: 11x11 Gaussian of
//! sigma 1.5, zero padding, C1 = 0.01^2, C2 = 0.03^2).
//!
//! Three sweeps over rows, each parallel: a horizontal blur of four fields; a vertical blur, the SSIM map and its three derivative
//! fields, blurred horizontally while still in cache; a vertical blur of those and the gradient. The window is symmetric, so the
//! adjoint of the blur is the blur.
//!
//! Where image and target are equal the similarity is 1 and the gradient 0, so only the box of the pixels that differ is swept, with the margin that the
//! windows cover: on a plain background most of the image is skipped.

use crate::cpu::scratch::scratch;
use crate::cpu::simd::{Lanes, dispatch};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;
use std::ops::Range;

const RADIUS: usize = 5;
const C1: f32 = 1e-4;
const C2: f32 = 9e-4;
/// Rows of a field are padded to a multiple of this many columns, so that vector loops have no remainder.
const PADDING: usize = 16;
/// Rows per task: enough work to be worth a task, few enough to balance two threads on a small image.
const ROWS: usize = 8;

/// The terms of the loss, averaged over all pixels and channels.
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

/// One output row or run: the symmetric 11-tap sum of `taps`. `out` holds whole vectors.
#[inline(always)]
fn blur<S: Simd>(simd: S, out: &mut [f32], taps: [&[f32]; 11], g: &[f32; 6]) {
    let n = out.len();
    assert!(n.is_multiple_of(Lanes::<S>::COUNT) && taps.iter().all(|tap| tap.len() >= n), "blur: rows are not padded");
    // Written out: array `map` does not inline into code of a wider instruction set.
    let [g0, g1, g2, g3, g4, g5] = [
        Lanes::splat(simd, g[0]),
        Lanes::splat(simd, g[1]),
        Lanes::splat(simd, g[2]),
        Lanes::splat(simd, g[3]),
        Lanes::splat(simd, g[4]),
        Lanes::splat(simd, g[5]),
    ];
    let mut at = 0;
    while at < n {
        // SAFETY: `at` + COUNT is at most n, and every tap holds n values, checked above.
        let pair = |a: usize, b: usize| unsafe { Lanes::load_ptr(simd, taps[a].as_ptr().add(at)) + Lanes::load_ptr(simd, taps[b].as_ptr().add(at)) };
        // SAFETY: as above.
        let centre = unsafe { Lanes::load_ptr(simd, taps[5].as_ptr().add(at)) };
        let even = pair(4, 6).fma(g4, centre * g5);
        let odd = pair(2, 8).fma(g2, pair(3, 7) * g3);
        let ends = pair(0, 10).fma(g0, pair(1, 9) * g1);
        (even + odd + ends).store(&mut out[at..]);
        at += Lanes::<S>::COUNT;
    }
}

/// Horizontal blur of a row that carries [`RADIUS`] zeros on each side of its `out.len()` columns.
#[inline(always)]
fn blur_padded<S: Simd>(simd: S, out: &mut [f32], padded: &[f32], g: &[f32; 6]) {
    let p = padded;
    blur(simd, out, [p, &p[1..], &p[2..], &p[3..], &p[4..], &p[5..], &p[6..], &p[7..], &p[8..], &p[9..], &p[10..]], g);
}

/// Copies `row` to the start of `to` and clears the rest.
#[inline(always)]
fn copy_padded(to: &mut [f32], row: &[f32]) {
    to[..row.len()].copy_from_slice(row);
    to[row.len()..].fill(0.0);
}

/// The loss terms of `image` against `target`, both planar `[channels, height, width]`. To `gradient` `[channels, height, width]`, which holds zeros, it
/// writes d(lambda_c * l1 + (1 - lambda_c) * (1 - ssim)) / d image there; the derivative of |0| is 0.
pub fn photometric(
    image: &[f32],
    target: &[f32],
    (channels, height, width): (usize, usize, usize),
    lambda_c: f32,
    mut gradient: Option<&mut [f32]>,
) -> PhotometricTerms {
    let pixels = height * width;
    if channels * pixels == 0 {
        return PhotometricTerms::default();
    }
    let count = (channels * pixels) as f64;
    let scale = (1.0 / count) as f32;
    let scales = (lambda_c * scale, -(1.0 - lambda_c) * scale);
    let sweep = Sweep::of(image, target, (channels, height, width));
    let mut total = [0.0, (channels * (pixels - sweep.similar_pixels())) as f64, 0.0];
    // Channel by channel, so that the fields of one stay in cache between the sweeps.
    for channel in 0..channels {
        let plane = channel * pixels..(channel + 1) * pixels;
        let gradient = gradient.as_deref_mut().map(|gradient| &mut gradient[plane.clone()]);
        for terms in one_channel(&image[plane.clone()], &target[plane], &sweep, scales, gradient) {
            for (total, term) in total.iter_mut().zip(terms) {
                *total += term;
            }
        }
    }
    PhotometricTerms { l1: total[0] / count, ssim: total[1] / count, mse: total[2] / count }
}

/// The part of an image that the sweeps compute.
struct Sweep {
    /// Columns of the image.
    width: usize,
    /// Rows and columns whose gradient may differ from 0.
    rows: Range<usize>,
    columns: Range<usize>,
    /// The rows and columns whose similarity may differ from 1, counted from the start of `rows` and `columns`.
    similar_rows: Range<usize>,
    similar_columns: Range<usize>,
}

impl Sweep {
    /// The box of the pixels that differ in any plane, with its margins; empty where none does.
    fn of(image: &[f32], target: &[f32], (channels, height, width): (usize, usize, usize)) -> Self {
        // A NaN differs from everything.
        let differs = |(x, y): (&f32, &f32)| x != y;
        let span = |(x, y): (&[f32], &[f32])| {
            let first = x.iter().zip(y).position(differs)?;
            Some((first, x.iter().zip(y).rposition(differs)? + 1))
        };
        let join = |a: Option<(usize, usize)>, b: Option<(usize, usize)>| match (a, b) {
            (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
            (a, b) => a.or(b),
        };
        let of_row = |row: usize| {
            let own = |channel: usize| (channel * height + row) * width..(channel * height + row + 1) * width;
            (0..channels).map(|channel| span((&image[own(channel)], &target[own(channel)]))).fold(None, join)
        };
        let spans: Vec<Option<(usize, usize)>> = (0..height).into_par_iter().with_min_len(ROWS).map(of_row).collect();
        let rows = spans.iter().position(Option::is_some).unwrap_or(0)..spans.iter().rposition(Option::is_some).map_or(0, |last| last + 1);
        let columns = spans.iter().copied().fold(None, join).map_or(0..0, |(first, end)| first..end);
        let wider =
            |range: &Range<usize>, by: usize, end: usize| if range.is_empty() { 0..0 } else { range.start.saturating_sub(by)..(range.end + by).min(end) };
        let within = |inner: Range<usize>, outer: &Range<usize>| inner.start - outer.start..inner.end - outer.start;
        let (all_rows, all_columns) = (wider(&rows, 2 * RADIUS, height), wider(&columns, 2 * RADIUS, width));
        let similar_rows = within(wider(&rows, RADIUS, height), &all_rows);
        let similar_columns = within(wider(&columns, RADIUS, width), &all_columns);
        Self { width, rows: all_rows, columns: all_columns, similar_rows, similar_columns }
    }
    /// How many pixels of a plane have a similarity that is computed.
    fn similar_pixels(&self) -> usize {
        self.similar_rows.len() * self.similar_columns.len()
    }
    /// A row of a plane, counted from the first one, inside the columns.
    fn row<'a>(&self, plane: &'a [f32], row: usize) -> &'a [f32] {
        &plane[(self.rows.start + row) * self.width..][self.columns.clone()]
    }
}

/// Row sums of |x - y|, SSIM and (x - y)^2 of one plane, and its gradient where it may differ from 0.
fn one_channel(image: &[f32], target: &[f32], sweep: &Sweep, (l1_scale, ssim_scale): (f32, f32), gradient: Option<&mut [f32]>) -> Vec<[f64; 3]> {
    let (rows, width) = (sweep.rows.len(), sweep.columns.len());
    if rows == 0 {
        return Vec::new();
    }
    let g = half_window();
    let stride = width.next_multiple_of(PADDING);
    let mut blurred = scratch(rows * 4 * stride);
    let mut row_terms = vec![[0.0f64; 3]; rows];
    blurred.par_chunks_mut(ROWS * 4 * stride).zip(row_terms.par_chunks_mut(ROWS)).enumerate().for_each(|(task, (fields, terms))| {
        let mut padded = scratch(4 * (stride + 2 * RADIUS));
        for (i, (fields, terms)) in fields.chunks_exact_mut(4 * stride).zip(terms).enumerate() {
            let row = task * ROWS + i;
            dispatch(FirstRow { x: sweep.row(image, row), y: sweep.row(target, row), fields, terms, padded: &mut padded, g: &g });
        }
    });

    let zeros = vec![0.0f32; 4 * stride];
    let with_gradient = gradient.is_some();
    // Without a gradient the second sweep writes no field; one float per row, because the zip below ends with its shortest part.
    let width_out = if with_gradient { 3 * stride } else { 1 };
    let mut derivatives = scratch(rows * width_out);
    derivatives.par_chunks_mut(ROWS * width_out).zip(row_terms.par_chunks_mut(ROWS)).enumerate().for_each(|(task, (out, terms))| {
        let mut work = scratch(4 * stride + stride + 3 * (stride + 2 * RADIUS));
        for (i, (out, terms)) in out.chunks_exact_mut(width_out).zip(terms).enumerate() {
            let row = task * ROWS + i;
            if !sweep.similar_rows.contains(&row) {
                out.fill(0.0);
                continue;
            }
            let taps = neighbours(row, &blurred, 4 * stride, &zeros);
            dispatch(SecondRow { taps, columns: sweep.similar_columns.clone(), out: with_gradient.then_some(out), terms, work: &mut work, g: &g });
        }
    });

    if let Some(gradient) = gradient {
        let gradient = &mut gradient[sweep.rows.start * sweep.width..sweep.rows.end * sweep.width];
        gradient.par_chunks_mut(ROWS * sweep.width).enumerate().for_each(|(task, out)| {
            let mut work = scratch(6 * stride);
            for (i, out) in out.chunks_exact_mut(sweep.width).enumerate() {
                let row = task * ROWS + i;
                let taps = neighbours(row, &derivatives, 3 * stride, &zeros);
                let (x, y, out) = (sweep.row(image, row), sweep.row(target, row), &mut out[sweep.columns.clone()]);
                dispatch(ThirdRow { taps, x, y, out, work: &mut work, l1_scale, ssim_scale, g: &g });
            }
        });
    }
    row_terms
}

/// The rows `row - 5 ..= row + 5`; zeros beyond the fields.
fn neighbours<'a>(row: usize, fields: &'a [f32], row_len: usize, zeros: &'a [f32]) -> [&'a [f32]; 11] {
    let rows = fields.len() / row_len;
    std::array::from_fn(|k| {
        let inside = row + k >= RADIUS && row + k - RADIUS < rows;
        if inside { &fields[(row + k - RADIUS) * row_len..][..row_len] } else { &zeros[..row_len] }
    })
}

/// Horizontal blur of x, y, x^2 + y^2 and xy; row sums of |x - y| and (x - y)^2.
struct FirstRow<'a> {
    x: &'a [f32],
    y: &'a [f32],
    /// Four blurred rows.
    fields: &'a mut [f32],
    terms: &'a mut [f64; 3],
    /// Four rows with [`RADIUS`] more columns on each side.
    padded: &'a mut [f32],
    g: &'a [f32; 6],
}

impl WithSimd for FirstRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let stride = self.fields.len() / 4;
        let padded_len = stride + 2 * RADIUS;
        let (px, rest) = self.padded.split_at_mut(padded_len);
        let (py, rest) = rest.split_at_mut(padded_len);
        let (squares, products) = rest.split_at_mut(padded_len);
        for row in [&mut *px, py, squares, products] {
            row[..RADIUS].fill(0.0);
            row[RADIUS + stride..].fill(0.0);
        }
        copy_padded(&mut px[RADIUS..RADIUS + stride], self.x);
        copy_padded(&mut py[RADIUS..RADIUS + stride], self.y);
        let (mut absolute, mut squared) = (Lanes::splat(simd, 0.0), Lanes::splat(simd, 0.0));
        for at in (RADIUS..RADIUS + stride).step_by(Lanes::<S>::COUNT) {
            let (x, y) = (Lanes::load(simd, &px[at..]), Lanes::load(simd, &py[at..]));
            x.fma(x, y * y).store(&mut squares[at..]);
            (x * y).store(&mut products[at..]);
            let d = x - y;
            absolute += d.max(-d);
            squared = d.fma(d, squared);
        }
        // A NaN must reach the loss, and `max` may drop it; the square does not.
        let squared = squared.sum();
        self.terms[0] = if squared.is_nan() { f64::NAN } else { f64::from(absolute.sum()) };
        self.terms[2] = f64::from(squared);
        let (out_x, rest) = self.fields.split_at_mut(stride);
        let (out_y, rest) = rest.split_at_mut(stride);
        let (out_squares, out_products) = rest.split_at_mut(stride);
        blur_padded(simd, out_x, px, self.g);
        blur_padded(simd, out_y, py, self.g);
        blur_padded(simd, out_squares, squares, self.g);
        blur_padded(simd, out_products, products, self.g);
    }
}

/// Vertical blur, the SSIM of the row and, for the gradient, the horizontally blurred derivatives of SSIM with respect to
/// `E[x]`, `E[x^2]` and `E[xy]`.
struct SecondRow<'a> {
    taps: [&'a [f32]; 11],
    /// The columns whose similarity counts; in the others the derivatives are 0.
    columns: Range<usize>,
    /// Three rows of blurred derivatives.
    out: Option<&'a mut [f32]>,
    terms: &'a mut [f64; 3],
    /// Four rows of moments, one of similarities, three with [`RADIUS`] more columns on each side.
    work: &'a mut [f32],
    g: &'a [f32; 6],
}

impl WithSimd for SecondRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let stride = self.taps[0].len() / 4;
        let padded_len = stride + 2 * RADIUS;
        let (moments, work) = self.work.split_at_mut(4 * stride);
        blur(simd, moments, self.taps, self.g);
        let (map, padded) = work.split_at_mut(stride);
        let (d_mu, rest) = padded.split_at_mut(padded_len);
        let (d_square, d_product) = rest.split_at_mut(padded_len);
        for at in (0..stride).step_by(Lanes::<S>::COUNT) {
            let (mu_x, mu_y) = (Lanes::load(simd, &moments[at..]), Lanes::load(simd, &moments[stride + at..]));
            let (squares, products) = (Lanes::load(simd, &moments[2 * stride + at..]), Lanes::load(simd, &moments[3 * stride + at..]));
            let (s, [a, b, c]) = similarity(mu_x, mu_y, squares, products);
            s.store(&mut map[at..]);
            a.store(&mut d_mu[RADIUS + at..]);
            b.store(&mut d_square[RADIUS + at..]);
            c.store(&mut d_product[RADIUS + at..]);
        }
        // The blur runs over into the margin and into the padding.
        map[..self.columns.start].fill(0.0);
        map[self.columns.end..].fill(0.0);
        let mut total = Lanes::splat(simd, 0.0);
        for at in (0..stride).step_by(Lanes::<S>::COUNT) {
            total += Lanes::load(simd, &map[at..]);
        }
        self.terms[1] = f64::from(total.sum());
        let Some(out) = self.out else { return };
        for row in [&mut *d_mu, d_square, d_product] {
            row[..RADIUS + self.columns.start].fill(0.0);
            row[RADIUS + self.columns.end..].fill(0.0);
        }
        let (out_mu, rest) = out.split_at_mut(stride);
        let (out_square, out_product) = rest.split_at_mut(stride);
        blur_padded(simd, out_mu, d_mu, self.g);
        blur_padded(simd, out_square, d_square, self.g);
        blur_padded(simd, out_product, d_product, self.g);
    }
}

/// SSIM from the local moments `E[x]`, `E[y]`, `E[x^2 + y^2]`, `E[xy]`, and its derivatives with respect to `E[x]`, `E[x^2]`, `E[xy]`.
#[inline(always)]
fn similarity<S: Simd>(mu_x: Lanes<S>, mu_y: Lanes<S>, squares: Lanes<S>, products: Lanes<S>) -> (Lanes<S>, [Lanes<S>; 3]) {
    let mu_product = mu_x * mu_y;
    let mu_squares = mu_x * mu_x + mu_y * mu_y;
    let a = mu_product * 2.0 + C1;
    let b = (products - mu_product) * 2.0 + C2;
    let c = mu_squares + C1;
    let d = squares - mu_squares + C2;
    let inverse = a.like(1.0) / (c * d);
    let s = a * b * inverse;
    let (inverse_c, inverse_d) = (d * inverse, c * inverse);
    let d_mu = (mu_y * (b - a) * inverse + mu_x * s * (inverse_d - inverse_c)) * 2.0;
    (s, [d_mu, -(s * inverse_d), a * inverse * 2.0])
}

/// Vertical blur of the derivative fields and the gradient of the row.
struct ThirdRow<'a> {
    taps: [&'a [f32]; 11],
    x: &'a [f32],
    y: &'a [f32],
    out: &'a mut [f32],
    /// Three rows of derivatives, then x, y and the gradient, padded.
    work: &'a mut [f32],
    l1_scale: f32,
    ssim_scale: f32,
    g: &'a [f32; 6],
}

impl WithSimd for ThirdRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let stride = self.work.len() / 6;
        let (fields, rest) = self.work.split_at_mut(3 * stride);
        blur(simd, fields, self.taps, self.g);
        let (x_row, rest) = rest.split_at_mut(stride);
        let (y_row, gradient) = rest.split_at_mut(stride);
        copy_padded(x_row, self.x);
        copy_padded(y_row, self.y);
        let zero = Lanes::splat(simd, 0.0);
        let (up, down) = (Lanes::splat(simd, self.l1_scale), Lanes::splat(simd, -self.l1_scale));
        for at in (0..stride).step_by(Lanes::<S>::COUNT) {
            let (d_mu, d_square, d_product) =
                (Lanes::load(simd, &fields[at..]), Lanes::load(simd, &fields[stride + at..]), Lanes::load(simd, &fields[2 * stride + at..]));
            let (x, y) = (Lanes::load(simd, &x_row[at..]), Lanes::load(simd, &y_row[at..]));
            let sign = x.gt(y).select(up, x.lt(y).select(down, zero));
            let ssim = (x * 2.0).fma(d_square, y.fma(d_product, d_mu));
            (ssim * self.ssim_scale + sign).store(&mut gradient[at..]);
        }
        self.out.copy_from_slice(&gradient[..self.out.len()]);
    }
}
