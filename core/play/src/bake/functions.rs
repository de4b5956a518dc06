//! Functions of time by singular value decomposition, and the division of time into segments.

use super::check_stop;
use super::motion::{HeadOffsets, Offsets};
use cc4dgs_core::Result;
use cc4dgs_core::playback::{Head, MAX_FUNCTIONS};
use rayon::prelude::*;
use std::ops::RangeInclusive;
use std::sync::atomic::AtomicBool;

/// Root-mean-square error over the tolerance that the choice of segments aims at.
const AIM: f32 = 0.3;
/// Gaussians whose needs are looked at for it.
const COST_ROWS: usize = 384;
/// Numbers of segments that are tried, and the fewest samples of a segment.
const SEGMENTS: [usize; 5] = [1, 2, 4, 8, 16];
const FEWEST_SAMPLES: usize = 6;
/// Sweeps of Jacobi's method; it converges in fewer than ten.
const SWEEPS: usize = 30;

/// Orthonormal functions of a head in a segment, the most important first.
pub(super) struct HeadFunctions {
    pub(super) head: Head,
    pub(super) width: usize,
    /// Samples n of the segment.
    pub(super) samples: usize,
    /// All n functions, `[n, n]`, as the layer will hold them.
    pub(super) values: Vec<f32>,
    /// Their largest absolute values.
    pub(super) peaks: Vec<f32>,
    /// The integers that stand for them.
    pub(super) coded: Vec<i16>,
    /// Sums of the squares that each function explains.
    #[cfg(test)]
    energies: Vec<f64>,
}

impl HeadFunctions {
    /// The functions of the samples `span` of `offsets`; an error once `stop` is set.
    pub(super) fn of(offsets: &HeadOffsets, span: RangeInclusive<usize>, stop: &AtomicBool) -> Result<Self> {
        check_stop(stop)?;
        let (first, n) = (*span.start(), span.end() - span.start() + 1);
        let (_energies, vectors) = eigen(gram(offsets, first, n), n);
        let (mut values, mut coded, mut peaks) = (Vec::new(), Vec::new(), Vec::new());
        for function in vectors.chunks_exact(n).take(MAX_FUNCTIONS) {
            let peak = function.iter().fold(0.0f64, |a, v| a.max(v.abs())) as f32;
            let integers: Vec<i16> = function.iter().map(|v| (v / f64::from(peak) * 32767.0).round() as i16).collect();
            values.extend(integers.iter().map(|&q| f32::from(q) / 32767.0 * peak));
            coded.extend(integers);
            peaks.push(peak);
        }
        Ok(Self {
            head: offsets.head,
            width: offsets.width,
            samples: n,
            values,
            peaks,
            coded,
            #[cfg(test)]
            energies: _energies,
        })
    }
    /// An estimate of what `moving` Gaussians need in the segment that begins at sample `first`, in numbers: the functions that Gaussians of the sample need,
    /// and the functions themselves.
    fn cost(&self, offsets: &HeadOffsets, first: usize, moving: usize) -> f64 {
        let (n, width, row_len) = (self.samples, self.width, offsets.samples * offsets.width);
        let rows: Vec<&[f32]> = offsets.values.chunks_exact(row_len).collect();
        let few: Vec<&[f32]> = rows.iter().step_by(rows.len().div_ceil(COST_ROWS).max(1)).map(|row| &row[first * width..(first + n) * width]).collect();
        let rank_of = |row: &[f32]| {
            let mut left = row.iter().map(|v| v * v).sum::<f32>();
            let mut rank = 0;
            for function in self.values.chunks_exact(n) {
                if left <= AIM * AIM * n as f32 {
                    break;
                }
                let part = |c: usize| function.iter().enumerate().map(|(k, f)| f * row[k * width + c]).sum::<f32>().powi(2);
                left -= (0..width).map(part).sum::<f32>();
                rank += 1;
            }
            rank
        };
        let ranks: Vec<usize> = few.iter().map(|row| rank_of(row)).collect();
        let most = ranks.iter().copied().max().unwrap_or(0);
        let mean = ranks.iter().sum::<usize>() as f64 / ranks.len().max(1) as f64;
        mean * (moving * width) as f64 + (most * n) as f64
    }
}

/// Ends of the segments: sample indices from 0 to `samples` - 1, each the last of one segment and the first of the next; an error once `stop` is set.
pub(super) fn segment_ends(sample: &Offsets, samples: usize, moving: usize, stop: &AtomicBool) -> Result<Vec<usize>> {
    let ends = |count: usize| -> Vec<usize> { (0..=count).map(|k| k * (samples - 1) / count).collect() };
    let allowed = |count: usize| count == 1 || (samples - 1) / count >= FEWEST_SAMPLES;
    let least = (samples - 1).div_ceil(MAX_FUNCTIONS - 1).max(1);
    let cost = |count: usize| -> Result<f64> {
        let mut total = 0.0;
        for span in ends(count).windows(2) {
            for head in &sample.heads {
                total += HeadFunctions::of(head, span[0]..=span[1], stop)?.cost(head, span[0], moving);
            }
        }
        Ok(total)
    };
    let counts: Vec<usize> = SEGMENTS.into_iter().filter(|&c| c >= least && allowed(c)).collect();
    let costs: Vec<f64> = counts.par_iter().map(|&c| cost(c)).collect::<Result<_>>()?;
    // A tie goes to fewer segments.
    let best = (0..counts.len()).min_by(|&a, &b| costs[a].total_cmp(&costs[b]));
    Ok(ends(best.map_or(least, |i| counts[i])))
}

/// Scalar products of the samples `first`.. `first` + `n` with each other, over all Gaussians and numbers: `[n, n]`.
fn gram(offsets: &HeadOffsets, first: usize, n: usize) -> Vec<f64> {
    let (width, row_len) = (offsets.width, offsets.samples * offsets.width);
    // By sample, so that scalar products run over neighbours in memory.
    let of_sample = |k: usize| -> Vec<f32> {
        offsets.values.chunks_exact(row_len).flat_map(|row| row[(first + k) * width..(first + k + 1) * width].iter().copied()).collect()
    };
    let samples: Vec<Vec<f32>> = (0..n).into_par_iter().map(of_sample).collect();
    let dot = |a: &[f32], b: &[f32]| a.chunks(1024).zip(b.chunks(1024)).map(|(a, b)| f64::from(a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>())).sum::<f64>();
    let upper: Vec<Vec<f64>> = (0..n).into_par_iter().map(|a| (a..n).map(|b| dot(&samples[a], &samples[b])).collect()).collect();
    let mut out = vec![0.0; n * n];
    for (a, row) in upper.iter().enumerate() {
        for (k, &value) in row.iter().enumerate() {
            out[a * n + a + k] = value;
            out[(a + k) * n + a] = value;
        }
    }
    out
}

/// Eigenvalues of the symmetric `matrix` `[n, n]` in descending order, and the unit eigenvectors as rows (cyclic Jacobi method).
fn eigen(mut matrix: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut vectors = vec![0.0; n * n];
    (0..n).for_each(|i| vectors[i * n + i] = 1.0);
    let total: f64 = matrix.iter().map(|v| v * v).sum();
    for _ in 0..SWEEPS {
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| matrix[i * n + j].powi(2)).sum();
        if off <= 1e-24 * total {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate(&mut matrix, &mut vectors, n, p, q);
            }
        }
    }
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| matrix[b * n + b].total_cmp(&matrix[a * n + a]).then(a.cmp(&b)));
    let values = order.iter().map(|&i| matrix[i * n + i].max(0.0)).collect();
    (values, order.iter().flat_map(|&i| vectors[i * n..(i + 1) * n].to_vec()).collect())
}

/// One rotation that makes the entry (p, q) zero. Only whole rows are touched where symmetry allows.
fn rotate(matrix: &mut [f64], vectors: &mut [f64], n: usize, p: usize, q: usize) {
    let off = matrix[p * n + q];
    if off == 0.0 {
        return;
    }
    let theta = (matrix[q * n + q] - matrix[p * n + p]) / (2.0 * off);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let t = if theta == 0.0 { 1.0 } else { t };
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    let turn = |values: &mut [f64]| {
        for k in 0..n {
            let (a, b) = (values[p * n + k], values[q * n + k]);
            values[p * n + k] = c * a - s * b;
            values[q * n + k] = s * a + c * b;
        }
    };
    turn(matrix);
    turn(vectors);
    for k in 0..n {
        let (a, b) = (matrix[k * n + p], matrix[k * n + q]);
        matrix[k * n + p] = c * a - s * b;
        matrix[k * n + q] = s * a + c * b;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Error;

    static RUNNING: AtomicBool = AtomicBool::new(false);

    fn offsets(rows: usize, samples: usize, value: impl Fn(usize, f64) -> f64) -> HeadOffsets {
        let values = (0..rows).flat_map(|r| (0..samples).map(move |k| (r, k as f64 / (samples - 1) as f64))).map(|(r, t)| value(r, t) as f32).collect();
        HeadOffsets { head: Head::Opacities, width: 1, samples, values, tolerances: vec![1.0; rows] }
    }

    #[test]
    fn a_linear_field_needs_as_many_functions_as_it_has() {
        let linear = offsets(50, 20, |r, t| (r as f64 * 0.7).sin() * 40.0 * t + (r as f64 * 1.3).cos() * 30.0 * (6.0 * t).sin() + 5.0);
        let functions = HeadFunctions::of(&linear, 0..=19, &RUNNING).unwrap();
        assert!(functions.energies[2] > 1.0 && functions.energies[3] < 1e-4 * functions.energies[2], "{:?}", &functions.energies[..5]);
        let product = |a: usize, b: usize| (0..20).map(|k| functions.values[a * 20 + k] * functions.values[b * 20 + k]).sum::<f32>();
        assert!((product(0, 0) - 1.0).abs() < 1e-3 && product(0, 1).abs() < 1e-3 && (product(19, 19) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn large_motion_is_divided_and_small_is_not() {
        let still = offsets(40, 61, |r, t| 10.0 * r as f64 * t);
        assert_eq!(segment_ends(&Offsets { heads: vec![still] }, 61, 1000, &RUNNING).unwrap(), [0, 60]);
        // Gaussians that each do something of their own at a time of their own.
        let busy = offsets(400, 61, |r, t| 300.0 * (-((t - (r % 60) as f64 / 60.0) * 40.0).powi(2)).exp());
        let busy = Offsets { heads: vec![busy] };
        assert!(segment_ends(&busy, 61, 1000, &RUNNING).unwrap().len() > 2);
        assert!(matches!(segment_ends(&busy, 61, 1000, &AtomicBool::new(true)), Err(Error::Interrupted(_))));
    }
}
