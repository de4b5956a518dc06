//! Coefficients: every Gaussian takes as few functions and as coarse steps as keep it within its tolerance.

use super::check_stop;
use super::functions::HeadFunctions;
use super::motion::{HeadOffsets, size_of};
use cc4dgs_core::Result;
use cc4dgs_core::playback::{CodedTrack, Head, Track, exponent_step};
use rayon::prelude::*;
use std::sync::atomic::AtomicBool;

/// Truncation may use up this much of the tolerance; rounding needs the rest.
const TRUNCATION: f32 = 0.9;
/// Halvings of the step before another function is taken instead.
const HALVINGS: u8 = 4;
/// Halvings for a Gaussian that has all functions there are.
const LAST_HALVINGS: u8 = 16;
/// The coarsest step is 2^COARSEST; steps are powers of two.
const COARSEST: i32 = 20;

/// What one Gaussian stores.
#[derive(Clone, Default)]
struct Row {
    exponent: u8,
    /// `[rank, width]`.
    coefficients: Vec<i32>,
    /// Largest error over the tolerance.
    error: f32,
}

impl Row {
    /// What players decode, at the samples of the segment, `[samples, width]`.
    fn decoded(&self, functions: &HeadFunctions) -> Vec<f32> {
        let (n, width) = (functions.samples, functions.width);
        let step = exponent_step((COARSEST as f32).exp2(), self.exponent);
        let mut out = vec![0.0f32; n * width];
        for (row, function) in self.coefficients.chunks_exact(width).zip(functions.values.chunks_exact(n)) {
            for (k, f) in function.iter().enumerate() {
                out[k * width..(k + 1) * width].iter_mut().zip(row).for_each(|(v, &q)| *v += f * (q as f32 * step));
            }
        }
        out
    }
}

/// A track that grows by chunks of Gaussians.
pub(super) struct TrackBuilder {
    head: Head,
    width: usize,
    rows: Vec<Row>,
}

impl TrackBuilder {
    pub(super) fn new(functions: &HeadFunctions) -> Self {
        Self { head: functions.head, width: functions.width, rows: Vec::new() }
    }
    pub(super) fn head(&self) -> Head {
        self.head
    }
    /// Most functions of any Gaussian.
    pub(super) fn rank(&self) -> usize {
        self.rows.iter().map(|r| r.coefficients.len() / self.width).max().unwrap_or(0)
    }
    /// Gaussians with coefficients.
    pub(super) fn users(&self) -> usize {
        self.rows.iter().filter(|r| !r.coefficients.is_empty()).count()
    }
    pub(super) fn coefficients(&self) -> usize {
        self.rows.iter().map(|r| r.coefficients.len()).sum()
    }
    /// The largest error over the tolerance.
    pub(super) fn worst(&self) -> f32 {
        self.rows.iter().map(|r| r.error).fold(0.0, f32::max)
    }
    /// Adds the Gaussians of `offsets`; the segment begins at its sample `first`. An error once `stop` is set.
    pub(super) fn extend(&mut self, functions: &HeadFunctions, offsets: &HeadOffsets, first: usize, stop: &AtomicBool) -> Result<()> {
        let (row_len, from, n) = (offsets.samples * offsets.width, first * offsets.width, functions.samples * offsets.width);
        let rows: Vec<Row> = offsets
            .values
            .par_chunks_exact(row_len)
            .zip(&offsets.tolerances)
            .map(|(values, &tolerance)| check_stop(stop).map(|()| fit(functions, &values[from..from + n], tolerance)))
            .collect::<Result<_>>()?;
        self.rows.extend(rows);
        Ok(())
    }
    /// The largest error of the Gaussian `row` half way between the samples of the segment, over its tolerance. The segment begins at sample `first` of the
    /// layer. `finer` has this Gaussian at index `at`, and twice as many intervals.
    pub(super) fn error_between(&self, row: usize, functions: &HeadFunctions, first: usize, finer: &HeadOffsets, at: usize) -> f32 {
        let (width, row_len, tolerance) = (self.width, finer.samples * self.width, finer.tolerances[at]);
        let wanted = &finer.values[at * row_len..(at + 1) * row_len];
        let found = self.rows[row].decoded(functions);
        let error = |k: usize| {
            let middle = (2 * (first + k) + 1) * width;
            let mean = |c: usize| 0.5 * (found[k * width + c] + found[(k + 1) * width + c]);
            size_of(self.head, (0..width).map(|c| wanted[middle + c] - mean(c) / tolerance))
        };
        (0..functions.samples.saturating_sub(1)).map(error).fold(0.0, f32::max)
    }
    /// The track as it is stored; `None` if it changes nothing.
    pub(super) fn finish(self, functions: &HeadFunctions) -> Option<CodedTrack> {
        let rank = self.rank();
        if rank == 0 {
            return None;
        }
        let least = self.rows.iter().filter(|r| !r.coefficients.is_empty()).map(|r| r.exponent).min().unwrap_or(0);
        let ranks: Vec<u8> = self.rows.iter().map(|r| (r.coefficients.len() / self.width) as u8).collect();
        debug_assert_eq!(Track::starts_of(&ranks).len(), ranks.len() + 1);
        Some(CodedTrack {
            head: self.head,
            peaks: functions.peaks[..rank].to_vec(),
            functions: functions.coded[..rank * functions.samples].to_vec(),
            ranks,
            step: exponent_step((COARSEST as f32).exp2(), least),
            exponents: self.rows.iter().map(|r| if r.coefficients.is_empty() { 0 } else { r.exponent - least }).collect(),
            coefficients: self.rows.into_iter().flat_map(|r| r.coefficients).collect(),
        })
    }
}

/// The fewest functions and the coarsest step for one Gaussian. `wanted` `[samples, width]` is in units of `tolerance`.
fn fit(functions: &HeadFunctions, wanted: &[f32], tolerance: f32) -> Row {
    let (n, width) = (functions.samples, functions.width);
    let worst = |left: &[f32]| left.chunks_exact(width).map(|e| size_of(functions.head, e.iter().copied())).fold(0.0, f32::max);
    let mut left = wanted.to_vec();
    let mut best = Row { error: worst(&left), ..Row::default() };
    if best.error <= 1.0 {
        return best;
    }
    let available = functions.peaks.len();
    let mut exact: Vec<f32> = Vec::new();
    for rank in 1..=available {
        let function = &functions.values[(rank - 1) * n..rank * n];
        for c in 0..width {
            let coefficient = function.iter().enumerate().map(|(k, f)| f * left[k * width + c]).sum::<f32>();
            function.iter().enumerate().for_each(|(k, f)| left[k * width + c] -= coefficient * f);
            exact.push(coefficient * tolerance);
        }
        if rank < available && worst(&left) > TRUNCATION {
            continue;
        }
        // Errors of rounding add up over functions, whose squares sum to 1 over the samples.
        let start = tolerance * (2.0 * n as f32 / rank as f32).sqrt();
        let coarsest = (COARSEST - start.log2().floor() as i32).clamp(0, 62) as u8;
        for exponent in coarsest..=coarsest.saturating_add(if rank < available { HALVINGS } else { LAST_HALVINGS }).min(62) {
            let step = exponent_step((COARSEST as f32).exp2(), exponent);
            let coefficients: Vec<i32> = exact.iter().map(|c| (c / step).round() as i32).collect();
            let error = error_of(functions, wanted, &coefficients, step / tolerance);
            if error < best.error {
                best = Row { exponent, coefficients, error };
            }
            if best.error <= 1.0 {
                return best;
            }
        }
    }
    best
}

/// The largest error of rounded coefficients, over the tolerance.
fn error_of(functions: &HeadFunctions, wanted: &[f32], coefficients: &[i32], step: f32) -> f32 {
    let (n, width) = (functions.samples, functions.width);
    let mut left = wanted.to_vec();
    for (row, function) in coefficients.chunks_exact(width).zip(functions.values.chunks_exact(n)) {
        for (k, f) in function.iter().enumerate() {
            left[k * width..(k + 1) * width].iter_mut().zip(row).for_each(|(v, &q)| *v -= f * (q as f32 * step));
        }
    }
    left.chunks_exact(width).map(|e| size_of(functions.head, e.iter().copied())).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_gaussian_keeps_to_its_tolerance_with_the_functions_it_needs() {
        let samples = 24;
        let time = |k: usize| k as f32 / (samples - 1) as f32;
        // Still, drifting, waving, and one of its own kind; in units of the tolerance.
        let motions: [fn(f32) -> f32; 4] = [|_| 0.3, |t| 50.0 * t, |t| 80.0 * (7.0 * t).sin(), |t| if t > 0.8 { 200.0 } else { 0.0 }];
        let rows: Vec<usize> = (0..300).map(|r| if r == 299 { 3 } else { r % 3 }).collect();
        let values = rows
            .iter()
            .enumerate()
            .flat_map(|(r, &m)| {
                (0..samples).flat_map(move |k| {
                    let v = motions[m](time(k)) * (1.0 + 0.001 * r as f32);
                    [v, 0.5 * v, 0.0]
                })
            })
            .collect();
        let offsets = HeadOffsets { head: Head::Means, width: 3, samples, values, tolerances: rows.iter().map(|r| 0.001 * (1 + r) as f32).collect() };
        let functions = HeadFunctions::of(&offsets, 0..=samples - 1, &AtomicBool::new(false)).unwrap();
        let mut builder = TrackBuilder::new(&functions);
        assert_eq!(builder.extend(&functions, &offsets, 0, &AtomicBool::new(true)).unwrap_err().exit_code(), 130);
        builder.extend(&functions, &offsets, 0, &AtomicBool::new(false)).unwrap();
        assert!(builder.worst() <= 1.0);
        let coded = builder.finish(&functions).unwrap();
        assert_eq!(coded.ranks[0], 0);
        assert!((1..=3).contains(&coded.ranks[1]) && (1..=3).contains(&coded.ranks[2]) && coded.ranks[299] >= coded.ranks[1], "{:?}", &coded.ranks[..6]);
        // What is decoded is within the tolerance too.
        let track = coded.decoded(3);
        for (row, &tolerance) in offsets.tolerances.iter().enumerate() {
            for k in 0..samples {
                let f: Vec<f32> = track.functions.chunks_exact(samples).map(|f| f[k]).collect();
                let mut found = [0.0; 3];
                track.add(row, &f, &mut found);
                let wanted = &offsets.values[(row * samples + k) * 3..(row * samples + k + 1) * 3];
                let error = found.iter().zip(wanted).map(|(a, b)| (a - b * tolerance).powi(2)).sum::<f32>().sqrt();
                assert!(error <= 1.01 * tolerance, "row {row} sample {k}: {error} over {tolerance}");
            }
        }
    }
}
