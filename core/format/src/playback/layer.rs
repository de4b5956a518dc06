//! The layer in memory, and its evaluation.

use crate::HostGaussians;
use crate::gaussians::sh_rest_len;

/// Most samples of a layer.
pub const MAX_SAMPLES: usize = 4096;
/// Most segments of a layer.
pub const MAX_SEGMENTS: usize = 64;
/// Most functions of a track.
pub const MAX_FUNCTIONS: usize = 255;

/// Coefficients and functions are smaller in magnitude, so that their products and sums are finite.
const LARGEST: f32 = 1e18;

/// What a track changes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Head {
    /// Added to the centres, units of the model; width 3.
    Means,
    /// Added to the log-scales; width 3.
    LogScales,
    /// Added to the quaternions (w, x, y, z) after those were divided by their norms; width 4.
    Rotations,
    /// Added to the opacity in 0..1, that is after the sigmoid; sums are limited to 0..1; width 1.
    Opacities,
    /// Added to the spherical-harmonics coefficients, degree 0 first, coefficient-major; width 3 (degree + 1)^2.
    Colors,
}

impl Head {
    /// All heads, in the order in which layers store them.
    pub const ALL: [Self; 5] = [Self::Means, Self::LogScales, Self::Rotations, Self::Opacities, Self::Colors];
    /// Numbers per Gaussian, for Gaussians of spherical-harmonics degree `sh_degree`.
    pub fn width(self, sh_degree: usize) -> usize {
        match self {
            Self::Means | Self::LogScales => 3,
            Self::Rotations => 4,
            Self::Opacities => 1,
            Self::Colors => 3 * (sh_rest_len(sh_degree) + 1),
        }
    }
    /// The name in streams and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Means => "means",
            Self::LogScales => "log_scales",
            Self::Rotations => "rotations",
            Self::Opacities => "opacities",
            Self::Colors => "colors",
        }
    }
}

/// One head in one segment: functions of time and coefficients.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// What it changes.
    pub head: Head,
    /// Samples of the functions, `[R, samples of the segment]`.
    pub functions: Vec<f32>,
    /// The number of functions that each moving Gaussian uses, the first ones, `[M]`; 0 to R.
    pub ranks: Vec<u8>,
    /// Sums of the ranks before each moving Gaussian `[M + 1]`.
    pub starts: Vec<u32>,
    /// Coefficients of the moving Gaussians one after the other, each `[its rank, width]`.
    pub coefficients: Vec<f32>,
}

impl Track {
    /// The sums of `ranks` that [`Track::starts`] holds.
    pub fn starts_of(ranks: &[u8]) -> Vec<u32> {
        let mut sum = 0u32;
        std::iter::once(0)
            .chain(ranks.iter().map(|&r| {
                sum += u32::from(r);
                sum
            }))
            .collect()
    }
    /// The number of functions R.
    pub fn function_count(&self) -> usize {
        usize::from(self.ranks.iter().copied().max().unwrap_or(0))
    }
    /// A coefficient or function that is not finite, or so large that sums would not be.
    pub(super) fn impossible(&self) -> Option<f32> {
        self.coefficients.iter().chain(&self.functions).copied().find(|v| !v.is_finite() || v.abs() >= LARGEST)
    }
    /// φ at a time: one number per function.
    pub fn functions_at(&self, at: &TimeWeights) -> Vec<f32> {
        let row = |f: &[f32]| f[at.sample] * (1.0 - at.fraction) + f[at.sample + usize::from(at.fraction > 0.0)] * at.fraction;
        self.functions.chunks_exact(at.samples).map(row).collect()
    }
    /// C φ of the moving Gaussian `row`, added to `out` (width numbers). `functions` is φ at the wanted time.
    pub fn add(&self, row: usize, functions: &[f32], out: &mut [f32]) {
        let width = out.len();
        let rows = &self.coefficients[self.starts[row] as usize * width..self.starts[row + 1] as usize * width];
        for (coefficients, f) in rows.chunks_exact(width).zip(functions) {
            out.iter_mut().zip(coefficients).for_each(|(o, c)| *o += c * f);
        }
    }
}

/// A stretch of time with functions and coefficients of its own.
#[derive(Clone, Debug, PartialEq)]
pub struct Segment {
    /// Index of its first sample in the layer.
    pub first: usize,
    /// Index of its last sample, over `first` unless the layer has a single sample. It is the first of the next segment.
    pub last: usize,
    /// The heads that change, in the order of [`Head::ALL`].
    pub tracks: Vec<Track>,
}

/// Where a time lies in a segment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimeWeights {
    /// Index of the segment.
    pub segment: usize,
    /// Samples of the segment.
    pub samples: usize,
    /// Index within the segment of the sample at or before the time.
    pub sample: usize,
    /// Weight of the sample after it, 0 to below 1.
    pub fraction: f32,
}

/// Motion as coefficients and sampled functions. It belongs to the Gaussians of its archive, in their order there.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaybackLayer {
    /// Indices of the M Gaussians that move, ascending. All others stay as they are.
    pub rows: Vec<u32>,
    /// Samples S of time: sample k is at normalised time k / (S - 1).
    pub samples: usize,
    /// Spherical-harmonics degree of the Gaussians.
    pub sh_degree: usize,
    /// The segments in order; together they cover all samples.
    pub segments: Vec<Segment>,
}

impl PlaybackLayer {
    /// Where `time_norm` lies; times outside 0..1, and what is no number, count as the nearest end.
    pub fn weights_at(&self, time_norm: f32) -> TimeWeights {
        let last = self.samples.saturating_sub(1);
        let at = (f64::from(time_norm.clamp(0.0, 1.0)).max(0.0) * last as f64).min(last as f64);
        let sample = (at.floor() as usize).min(last.saturating_sub(1));
        let segment = self.segments.iter().position(|s| sample < s.last).unwrap_or(self.segments.len() - 1);
        let found = &self.segments[segment];
        let (mut sample, mut fraction) = (sample - found.first, (at - sample as f64) as f32);
        if fraction >= 1.0 {
            (sample, fraction) = (sample + 1, 0.0);
        }
        TimeWeights { segment, samples: found.last - found.first + 1, sample, fraction }
    }
    /// The Gaussians of the archive, `canonical`, at `time_norm` (0..1), in the same order.
    pub fn apply(&self, canonical: &HostGaussians, time_norm: f32) -> HostGaussians {
        let mut out = canonical.clone();
        let at = self.weights_at(time_norm);
        for track in &self.segments[at.segment].tracks {
            let functions = track.functions_at(&at);
            for (row, &gaussian) in self.rows.iter().enumerate() {
                if track.ranks[row] > 0 {
                    change(track, row, &functions, &mut out, gaussian as usize);
                }
            }
        }
        out
    }
    /// Coefficients of all tracks.
    pub fn coefficient_count(&self) -> usize {
        self.segments.iter().flat_map(|s| &s.tracks).map(|t| t.coefficients.len()).sum()
    }
}

fn change(track: &Track, row: usize, functions: &[f32], out: &mut HostGaussians, gaussian: usize) {
    match track.head {
        Head::Means => track.add(row, functions, &mut out.means[3 * gaussian..3 * gaussian + 3]),
        Head::LogScales => track.add(row, functions, &mut out.log_scales[3 * gaussian..3 * gaussian + 3]),
        Head::Rotations => {
            let quaternion = &mut out.quaternions[4 * gaussian..4 * gaussian + 4];
            // In float64: squares of float32 may leave its range.
            let norm = quaternion.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
            quaternion.iter_mut().for_each(|v| *v = (f64::from(*v) / norm) as f32);
            track.add(row, functions, quaternion);
        }
        Head::Opacities => {
            let logit = &mut out.opacity_logits[gaussian];
            let mut opacity = [1.0 / (1.0 + libm::expf(-*logit))];
            track.add(row, functions, &mut opacity);
            let opacity = opacity[0].clamp(LEAST_OPACITY, 1.0 - LEAST_OPACITY);
            *logit = libm::logf(opacity / (1.0 - opacity));
        }
        Head::Colors => {
            let rest = 3 * sh_rest_len(out.sh_degree);
            let mut colors = vec![0.0; 3 + rest];
            track.add(row, functions, &mut colors);
            out.sh_dc[3 * gaussian..3 * gaussian + 3].iter_mut().zip(&colors).for_each(|(v, c)| *v += c);
            out.sh_rest[rest * gaussian..rest * (gaussian + 1)].iter_mut().zip(&colors[3..]).for_each(|(v, c)| *v += c);
        }
    }
}

/// Opacities of 0 and 1 have no logit; this is invisible.
const LEAST_OPACITY: f32 = 1e-6;

#[cfg(test)]
mod tests {
    use super::*;

    fn layer() -> PlaybackLayer {
        let track = |functions: Vec<f32>| {
            let ranks = vec![1, 2];
            Track { head: Head::Means, functions, starts: Track::starts_of(&ranks), ranks, coefficients: vec![1., 0., 0., 0., 1., 0., 0., 0., 1.] }
        };
        PlaybackLayer {
            rows: vec![0, 2],
            samples: 5,
            sh_degree: 0,
            segments: vec![
                Segment { first: 0, last: 2, tracks: vec![track(vec![0., 1., 2., 5., 5., 5.])] },
                Segment { first: 2, last: 4, tracks: vec![track(vec![2., 4., 6., 5., 6., 7.])] },
            ],
        }
    }

    #[test]
    fn times_fall_into_segments_and_are_interpolated() {
        let layer = layer();
        let at = |t: f32| {
            let w = layer.weights_at(t);
            (w.segment, w.sample, w.fraction)
        };
        assert_eq!([at(-1.0), at(0.125), at(0.5), at(0.625), at(1.0), at(7.0)], [(0, 0, 0.0), (0, 0, 0.5), (1, 0, 0.0), (1, 0, 0.5), (1, 2, 0.0), (1, 2, 0.0)]);
        assert_eq!(at(f32::NAN).1, 0);
    }

    #[test]
    fn rows_move_by_their_own_coefficients() {
        let canonical = HostGaussians {
            means: vec![10.0; 9],
            log_scales: vec![0.0; 9],
            quaternions: vec![1.0; 12],
            opacity_logits: vec![0.0; 3],
            sh_dc: vec![0.0; 9],
            dynamic_scores: vec![0.0; 3],
            ..Default::default()
        };
        let moved = layer().apply(&canonical, 0.625);
        assert_eq!(moved.means, [13.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 13.0, 15.5]);
        assert_eq!(moved.log_scales, canonical.log_scales);
    }
}
