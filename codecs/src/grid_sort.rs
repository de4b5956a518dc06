//! Sorts Gaussians into a square grid so that neighbours are similar (self-organising Gaussian grids, Morgenstern et al. 2024). An image of one of their
//! components is then smooth and compresses well.
//!
//! The initial order follows a space-filling curve. Then pairs of cells swap their Gaussians if that brings both closer to the blurred features around them.
//! The radius of the blur shrinks from round to round.

use cc4dgs_format::{HostGaussians, Seed};

/// Features compared per Gaussian: centre, log-scales, colour.
const FEATURES: usize = 9;
/// Features are clamped to this many standard deviations.
const FARTHEST: f32 = 3.0;
/// Rounds of swaps per radius.
const ROUNDS: u64 = 12;
/// Each radius over the one before.
const SHRINK: f32 = 0.8;
/// Side of the blocks of the initial order, in cells.
const BLOCK: usize = 8;

type Feature = [f32; FEATURES];

/// Side of the smallest square with at least `count` cells.
pub(crate) fn side_of(count: usize) -> usize {
    let side = (count as f64).sqrt().ceil() as usize;
    // The square root may be rounded down.
    if side * side < count { side + 1 } else { side }
}

/// An order of the Gaussians for a square with sides of [`side_of`] cells, row by row; the last cells stay empty. `by_curve` lists the Gaussians along a
/// space-filling curve.
pub(crate) fn square_order(gaussians: &HostGaussians, by_curve: &[usize], seed: Seed) -> Vec<usize> {
    let count = gaussians.len();
    let side = side_of(count);
    let features = features(gaussians);
    let mut square = laid_out(by_curve, side);
    let mut radius = side as f32 / 4.0;
    let mut turn = 0u64;
    while radius >= 1.0 {
        let around = blurred(&square, &features, side, radius as usize);
        for _ in 0..ROUNDS {
            let number = seed.index(turn).value();
            let distance = 1 + (number >> 8) as usize % (radius as usize);
            swap_round(&mut square, &features, &around, side, distance, number & 1 == 0);
            turn += 1;
        }
        radius *= SHRINK;
    }
    square
}

/// Standardised features: mean 0, standard deviation 1, clamped.
fn features(gaussians: &HostGaussians) -> Vec<Feature> {
    let mut out = vec![[0.0; FEATURES]; gaussians.len()];
    for (part, values) in [&gaussians.means, &gaussians.log_scales, &gaussians.sh_dc].into_iter().enumerate() {
        for c in 0..3 {
            let column = || values.iter().skip(c).step_by(3).map(|v| f64::from(*v));
            let n = out.len().max(1) as f64;
            let mean = column().sum::<f64>() / n;
            let deviation = (column().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            let scale = if deviation > 0.0 { 1.0 / deviation } else { 0.0 };
            for (feature, value) in out.iter_mut().zip(column()) {
                feature[3 * part + c] = (((value - mean) * scale) as f32).clamp(-FARTHEST, FARTHEST);
            }
        }
    }
    out
}

/// Fills the square with the curve, block by block, every other row of blocks in reverse, so that neighbouring cells are near on the curve.
fn laid_out(by_curve: &[usize], side: usize) -> Vec<usize> {
    let mut cells: Vec<(usize, usize)> = (0..side * side).filter(|&p| p < by_curve.len()).map(|p| (p / side, p % side)).collect();
    cells.sort_by_key(|&(row, column)| {
        let line = row / BLOCK;
        let block = if line.is_multiple_of(2) { column / BLOCK } else { side / BLOCK - column / BLOCK };
        (line, block, row, column)
    });
    let mut square = vec![0; by_curve.len()];
    for (cell, gaussian) in cells.into_iter().zip(by_curve) {
        square[cell.0 * side + cell.1] = *gaussian;
    }
    square
}

/// For each cell, the mean of the features within `radius` along both axes.
fn blurred(square: &[usize], features: &[Feature], side: usize, radius: usize) -> Vec<Feature> {
    let rows = square.len().div_ceil(side);
    let mut along_rows = Vec::with_capacity(square.len());
    for line in square.chunks(side) {
        let values: Vec<&Feature> = line.iter().map(|&g| &features[g]).collect();
        along_rows.extend(means(&values, radius));
    }
    let mut out = vec![[0.0; FEATURES]; square.len()];
    for column in 0..side {
        let values: Vec<&Feature> = (0..rows).filter_map(|row| along_rows.get(row * side + column)).collect();
        for (row, mean) in means(&values, radius).enumerate() {
            out[row * side + column] = mean;
        }
    }
    out
}

/// Means over windows from i - radius to i + radius, clipped at the ends.
fn means<'a>(values: &'a [&'a Feature], radius: usize) -> impl Iterator<Item = Feature> + 'a {
    let mut sum = [0.0f64; FEATURES];
    let (mut from, mut to) = (0, 0);
    (0..values.len()).map(move |i| {
        while to < values.len() && to <= i + radius {
            sum.iter_mut().zip(values[to]).for_each(|(s, v)| *s += f64::from(*v));
            to += 1;
        }
        while from + radius < i {
            sum.iter_mut().zip(values[from]).for_each(|(s, v)| *s -= f64::from(*v));
            from += 1;
        }
        sum.map(|s| (s / (to - from) as f64) as f32)
    })
}

/// Pairs every cell with the one `distance` to the right (or below), each cell at most once. A pair swaps if that lowers the sum of its squared distances from
/// `around`.
fn swap_round(square: &mut [usize], features: &[Feature], around: &[Feature], side: usize, distance: usize, sideways: bool) {
    let apart = |a: &Feature, b: &Feature| a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum::<f32>();
    for here in 0..square.len() {
        let (row, column) = (here / side, here % side);
        let (along, there) = if sideways { (column, here + distance) } else { (row, here + distance * side) };
        if (along / distance) % 2 == 1 || there >= square.len() || (sideways && column + distance >= side) {
            continue;
        }
        let (a, b) = (&features[square[here]], &features[square[there]]);
        let (at_a, at_b) = (&around[here], &around[there]);
        if apart(a, at_b) + apart(b, at_a) < apart(a, at_a) + apart(b, at_b) {
            square.swap(here, there);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::morton;

    fn cloud(count: usize) -> HostGaussians {
        let mut g = HostGaussians::default();
        for i in 0..count as u64 {
            let draw = |k: u64| (Seed::root(5).index(i).index(k).value() >> 40) as f32 / (1u64 << 24) as f32;
            g.means.extend([draw(0), draw(1), draw(2)]);
            g.log_scales.extend([draw(0), draw(0), draw(3)]);
            g.sh_dc.extend([draw(1), draw(2), draw(0) * draw(1)]);
            g.opacity_logits.push(0.0);
        }
        g
    }

    /// Mean squared difference of neighbours, side by side and one below the other.
    fn roughness(order: &[usize], g: &HostGaussians) -> f32 {
        let f = features(g);
        let side = side_of(order.len());
        let across = order.chunks(side).flat_map(|line| line.windows(2)).map(|p| (p[0], p[1]));
        let down = order.iter().zip(order.iter().skip(side)).map(|(a, b)| (*a, *b));
        let sum: f32 = across.chain(down).map(|(a, b)| f[a].iter().zip(&f[b]).map(|(x, y)| (x - y).powi(2)).sum::<f32>()).sum();
        sum / order.len() as f32
    }

    #[test]
    fn neighbours_become_alike_and_nothing_is_lost() {
        for count in [0, 1, 2, 7, 64, 65, 1500] {
            let g = cloud(count);
            let curve = morton::order(&g.means);
            let order = square_order(&g, &curve, Seed::root(1));
            let mut all = order.clone();
            all.sort_unstable();
            assert_eq!(all, (0..count).collect::<Vec<_>>());
            assert_eq!(order, square_order(&g, &curve, Seed::root(1)));
            if count > 1000 {
                let start = laid_out(&curve, side_of(count));
                assert!(roughness(&order, &g) < 0.8 * roughness(&start, &g), "{} from {}", roughness(&order, &g), roughness(&start, &g));
            }
        }
    }
}
