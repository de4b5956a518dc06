//! Depth by plane sweep: at each candidate depth other views are warped into a view and compared by normalised cross-correlation over 5x5 windows.

use super::views::{Level, WorkSet, WorkView};
use rayon::prelude::*;

/// Half-width of the comparison window.
const RADIUS: usize = 2;
/// Variance (of grey in 0..1) below which a window counts as flat.
const FLAT: f32 = 3e-5;
/// The most planes of the first level.
const MAX_PLANES: usize = 256;

/// Depth of a view at its finest level.
pub(super) struct DepthMap {
    /// Inverse depth per pixel.
    pub inverse: Vec<f32>,
    /// Correlation of the best depth, up to 1.
    pub score: Vec<f32>,
    /// Inverse depth that moves a match by about a pixel at the finest level.
    pub step: f32,
}

/// The depth maps of all keys.
pub(super) fn depth_maps(set: &WorkSet) -> Vec<DepthMap> {
    set.key_views().par_iter().map(|view| depth_map(set, view)).collect()
}

fn depth_map(set: &WorkSet, view: &WorkView) -> DepthMap {
    let others: Vec<&WorkView> = view.partners.iter().map(|&i| &set.views[i]).collect();
    let [near, far] = view.depth_range;
    let (most, least) = ((1.0 / near) as f32, (1.0 / far) as f32);
    let baseline = others.iter().map(|o| (o.center - view.center).length()).fold(0.0, f64::max).max(1e-9);
    let coarse = &view.levels[0];
    let wanted = (f64::from(most - least) * coarse.k.x_axis.x * baseline).ceil();
    let planes = if wanted.is_finite() { (wanted as usize).clamp(16, MAX_PLANES) } else { 16 };
    let mut step = (most - least) / planes as f32;
    let pixels = coarse.width * coarse.height;
    let first = Sweep { view, others: &others, level: 0, range: [least, most] };
    let (mut inverse, mut score) = first.best(&vec![0.5 * (most + least); pixels], step, planes / 2);
    for level in 1..view.levels.len() {
        let (from, to) = (&view.levels[level - 1], &view.levels[level]);
        step *= from.width as f32 / to.width as f32;
        let base = upsample(from, to, &inverse, &score);
        let reach = if level == 1 { 3 } else { 2 };
        (inverse, score) = Sweep { view, others: &others, level, range: [least, most] }.best(&base, step, reach);
    }
    DepthMap { inverse, score, step }
}

/// Each fine pixel starts from the best-matched depth around its coarse one, which carries good matches into poor surroundings.
fn upsample(from: &Level, to: &Level, inverse: &[f32], score: &[f32]) -> Vec<f32> {
    let mut spread = inverse.to_vec();
    for y in 0..from.height {
        for x in 0..from.width {
            let mut best = (f32::NEG_INFINITY, 0);
            for j in y.saturating_sub(1)..(y + 2).min(from.height) {
                for i in x.saturating_sub(1)..(x + 2).min(from.width) {
                    let p = j * from.width + i;
                    // The pixel's own depth wins unless a neighbour is clearly better.
                    let s = score[p] + if (i, j) == (x, y) { 0.1 } else { 0.0 };
                    if s > best.0 {
                        best = (s, p);
                    }
                }
            }
            spread[y * from.width + x] = inverse[best.1];
        }
    }
    let source = |i: usize, n_to: usize, n_from: usize| ((i * 2 + 1) * n_from / (2 * n_to)).min(n_from - 1);
    (0..to.width * to.height).map(|p| spread[source(p / to.width, to.height, from.height) * from.width + source(p % to.width, to.width, from.width)]).collect()
}

struct Sweep<'a> {
    view: &'a WorkView,
    others: &'a [&'a WorkView],
    level: usize,
    /// Least and most inverse depth.
    range: [f32; 2],
}

impl Sweep<'_> {
    /// The best of `base + k * step`, k = -reach..=reach, per pixel, refined between the steps; and its score.
    fn best(&self, base: &[f32], step: f32, reach: usize) -> (Vec<f32>, Vec<f32>) {
        let own = &self.view.levels[self.level];
        let n = own.width * own.height;
        let planes = 2 * reach + 1;
        let window = Window::new(own);
        let mut volume = vec![-1.0f32; planes * n];
        let mut warped = vec![0.0f32; n];
        let mut ncc = vec![0.0f32; n];
        let mut second = vec![-1.0f32; n];
        let mut scratch = Scratch::new(n);
        for (plane, scores) in volume.chunks_exact_mut(n).enumerate() {
            let offset = (plane as f32 - reach as f32) * step;
            second.fill(-1.0);
            for other in self.others {
                // A view with fewer levels is used at its finest.
                let theirs = &other.levels[self.level.min(other.levels.len() - 1)];
                self.warp(own, other, theirs, base, offset, &mut warped);
                window.correlate(own, &warped, &mut scratch, &mut ncc);
                // The two best partners count: the others may be looking at something in between.
                for ((first, second), &value) in scores.iter_mut().zip(&mut second).zip(&ncc) {
                    let v = if value.is_nan() { -1.0 } else { value };
                    *second = second.max(v.min(*first));
                    *first = first.max(v);
                }
            }
            let lone = self.others.len() < 2;
            for (first, second) in scores.iter_mut().zip(&second) {
                *first = if lone { *first } else { 0.5 * (*first + *second) };
            }
        }
        let mut inverse = vec![0.0f32; n];
        let mut score = vec![0.0f32; n];
        for p in 0..n {
            let at = |plane: usize| volume[plane * n + p];
            let best = (0..planes).fold(0, |b, k| if at(k) > at(b) { k } else { b });
            let mut offset = best as f32 - reach as f32;
            if best > 0 && best + 1 < planes {
                let (l, c, r) = (at(best - 1), at(best), at(best + 1));
                let curve = l - 2.0 * c + r;
                if curve < -1e-6 {
                    offset += (0.5 * (l - r) / curve).clamp(-0.5, 0.5);
                }
            }
            inverse[p] = (base[p] + offset * step).clamp(self.range[0], self.range[1]);
            score[p] = at(best);
        }
        (inverse, score)
    }

    /// Samples `theirs` where the pixels of `own` would be at their candidate depths; NaN outside.
    fn warp(&self, own: &Level, other: &WorkView, theirs: &Level, base: &[f32], offset: f32, out: &mut [f32]) {
        let (m, b) = self.view.warp_to(own, other, theirs);
        let (w, h) = (theirs.width as f32, theirs.height as f32);
        for (y, (row, bases)) in out.chunks_exact_mut(own.width).zip(base.chunks_exact(own.width)).enumerate() {
            let start = m.y_axis * (y as f32 + 0.5) + m.z_axis;
            for (x, (o, base)) in row.iter_mut().zip(bases).enumerate() {
                let inverse = (base + offset).clamp(self.range[0], self.range[1]);
                // Depth times a ray plus an offset, divided by the depth: only the ratio counts.
                let q = start + m.x_axis * (x as f32 + 0.5) + b * inverse;
                let (u, v) = (q.x / q.z - 0.5, q.y / q.z - 0.5);
                let inside = q.z > 0.0 && u >= 0.0 && v >= 0.0 && u < w - 1.0 && v < h - 1.0;
                *o = if inside {
                    let (i, j) = (u as usize, v as usize);
                    let (a, c) = (u - i as f32, v - j as f32);
                    let p = j * theirs.width + i;
                    let g = &theirs.gray;
                    let top = g[p] + a * (g[p + 1] - g[p]);
                    let bottom = g[p + theirs.width] + a * (g[p + theirs.width + 1] - g[p + theirs.width]);
                    top + c * (bottom - top)
                } else {
                    f32::NAN
                };
            }
        }
    }
}

struct Scratch {
    product: Vec<f32>,
    rows: Vec<f32>,
    sum_j: Vec<f32>,
    sum_jj: Vec<f32>,
    sum_ij: Vec<f32>,
}

impl Scratch {
    fn new(n: usize) -> Self {
        let zeros = || vec![0.0; n];
        Self { product: zeros(), rows: zeros(), sum_j: zeros(), sum_jj: zeros(), sum_ij: zeros() }
    }
}

/// Window sums of the reference, which stay the same over all planes.
struct Window {
    count: Vec<f32>,
    mean: Vec<f32>,
    variance: Vec<f32>,
}

impl Window {
    fn new(level: &Level) -> Self {
        let n = level.width * level.height;
        let (mut rows, mut count, mut mean, mut square) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        box_sum(&vec![1.0; n], level.width, &mut rows, &mut count);
        box_sum(&level.gray, level.width, &mut rows, &mut mean);
        let squares: Vec<f32> = level.gray.iter().map(|v| v * v).collect();
        box_sum(&squares, level.width, &mut rows, &mut square);
        mean.iter_mut().zip(&count).for_each(|(m, c)| *m /= c);
        let variance = square.iter().zip(&count).zip(&mean).map(|((s, c), m)| (s / c - m * m).max(0.0)).collect();
        Self { count, mean, variance }
    }
    /// Normalised cross-correlation with `other`; 0 for flat windows, NaN where `other` is partly missing.
    fn correlate(&self, level: &Level, other: &[f32], scratch: &mut Scratch, out: &mut [f32]) {
        let Scratch { product, rows, sum_j, sum_jj, sum_ij } = scratch;
        box_sum(other, level.width, rows, sum_j);
        product.iter_mut().zip(other).for_each(|(p, j)| *p = j * j);
        box_sum(product, level.width, rows, sum_jj);
        product.iter_mut().zip(other).zip(&level.gray).for_each(|((p, j), i)| *p = i * j);
        box_sum(product, level.width, rows, sum_ij);
        for (p, o) in out.iter_mut().enumerate() {
            let scale = 1.0 / self.count[p];
            let mean = sum_j[p] * scale;
            let variance = sum_jj[p] * scale - mean * mean;
            let covariance = sum_ij[p] * scale - mean * self.mean[p];
            *o = covariance / ((self.variance[p] + FLAT) * (variance.max(0.0) + FLAT)).sqrt() + 0.0 * variance;
        }
    }
}

/// Sums over 5x5 windows, cut at the border. NaN stays within the windows that hold it.
fn box_sum(values: &[f32], width: usize, rows: &mut [f32], out: &mut [f32]) {
    let height = values.len() / width;
    for (line, row) in values.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        if width > 2 * RADIUS {
            for (r, w) in row[RADIUS..].iter_mut().zip(line.windows(2 * RADIUS + 1)) {
                *r = w[0] + w[1] + w[2] + w[3] + w[4];
            }
        }
        let edge = |x: usize| line[x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(width)].iter().sum::<f32>();
        for x in (0..RADIUS.min(width)).chain(width.saturating_sub(RADIUS)..width) {
            row[x] = edge(x);
        }
    }
    for (y, line) in out.chunks_exact_mut(width).enumerate() {
        line.fill(0.0);
        for j in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
            for (o, r) in line.iter_mut().zip(&rows[j * width..][..width]) {
                *o += r;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn box_sums_match_the_definition() {
        for (w, h) in [(7usize, 6usize), (3, 9), (1, 1), (5, 5)] {
            let values: Vec<f32> = (0..w * h).map(|i| ((i * 37) % 11) as f32).collect();
            let (mut rows, mut out) = (vec![0.0; w * h], vec![0.0; w * h]);
            box_sum(&values, w, &mut rows, &mut out);
            for y in 0..h {
                for x in 0..w {
                    let mut sum = 0.0;
                    for j in y.saturating_sub(2)..(y + 3).min(h) {
                        for i in x.saturating_sub(2)..(x + 3).min(w) {
                            sum += values[j * w + i];
                        }
                    }
                    assert_eq!(out[y * w + x], sum, "{w}x{h} at ({x}, {y})");
                }
            }
        }
    }
}
