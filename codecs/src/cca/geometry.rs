//! The quantised attributes (log-scales, opacity logits, quaternions, dynamic scores), and the autoencoder's conditions computed from them.

use super::profile::Profile;
use cc4dgs_format::archive::ByteReader;
use cc4dgs_format::storage::{
    StreamSet,
    column::{self, Column, Target},
    interleave, load, relative_rms, split, store,
};
use cc4dgs_format::{HostGaussians, Result, Stream};

/// Share of a scalar column's values at either end that may be stored as outliers.
const TAIL: f64 = 5e-4;
/// Condition channels of a Gaussian: position 3, log-scales 3, opacity 1, rotation 4, dynamic score 1 (paper Section IV-D).
pub(super) const CONDITIONS: usize = 12;
/// Normalised conditions are clipped to this many standard deviations.
const CLIP: f64 = 4.0;

const QUATERNIONS: &str = "quaternions";

/// Encodes the quantised attributes. Returns the streams and the decoded attributes (with exact positions).
pub(super) fn encode(gaussians: &HostGaussians, profile: &Profile, meta: &mut Vec<u8>, escapes: &mut Vec<u8>) -> (Vec<Stream>, HostGaussians) {
    let scalar = Target { bits: profile.scalar_bits, mu_law: false, loss: profile.scalar_loss, tail: TAIL };
    let score = Target { bits: profile.dynamic_bits, mu_law: true, loss: profile.dynamic_loss, tail: TAIL };
    let n = gaussians.len();
    let mut known = HostGaussians { sh_degree: gaussians.sh_degree, means: gaussians.means.clone(), sh_dc: gaussians.sh_dc.clone(), ..Default::default() };
    let mut streams = Vec::new();
    let mut put = |name: &str, columns: Vec<Column>| {
        streams.push(Stream { name: name.into(), bytes: store(&columns, meta, escapes) });
        interleave(&columns.iter().map(|c| column::dequantise(c, n)).collect::<Vec<_>>(), n)
    };
    known.log_scales = put("log_scales", split(&gaussians.log_scales, 3).iter().map(|c| column::encode(c, scalar)).collect());
    known.opacity_logits = put("opacity_logits", vec![column::encode(&gaussians.opacity_logits, scalar)]);
    known.dynamic_scores = put("dynamic_scores", vec![column::encode(&gaussians.dynamic_scores, score)]);
    let columns: Vec<Column> = unit_and_norm(&gaussians.quaternions).iter().map(|c| column::encode(c, scalar)).collect();
    let product = times_norm(&columns.iter().map(|c| column::dequantise(c, n)).collect::<Vec<_>>(), n);
    if relative_rms(&gaussians.quaternions, &product) <= profile.scalar_loss {
        put(QUATERNIONS, columns);
        known.quaternions = product;
    } else {
        // Norms span so many magnitudes that quantisation would ruin the small ones: store the raw components, and norms of one (log 0).
        let mut columns: Vec<Column> = split(&gaussians.quaternions, 4).iter().map(|c| column::encode(c, scalar)).collect();
        columns.push(column::encode(&vec![0.0; n], scalar));
        known.quaternions = times_norm(&columns.iter().map(|c| column::dequantise(c, n)).collect::<Vec<_>>(), n);
        put(QUATERNIONS, columns);
    }
    (streams, known)
}

/// Decodes the quantised attributes of `count` Gaussians into `out`.
pub(super) fn decode(set: &StreamSet, count: usize, meta: &mut ByteReader, escapes: &mut ByteReader, out: &mut HostGaussians) -> Result<()> {
    let mut take = |name: &str, width: usize| load(set.reader(name)?, count, width, meta, escapes);
    out.log_scales = interleave(&take("log_scales", 3)?, count);
    out.opacity_logits = interleave(&take("opacity_logits", 1)?, count);
    out.dynamic_scores = interleave(&take("dynamic_scores", 1)?, count);
    out.quaternions = times_norm(&take(QUATERNIONS, 5)?, count);
    Ok(())
}

/// Columns w, x, y, z of the unit quaternions with their signs, and the natural logarithm of the norms. A zero quaternion becomes the
/// identity with the smallest norm.
fn unit_and_norm(quaternions: &[f32]) -> [Vec<f32>; 5] {
    let mut out: [Vec<f32>; 5] = Default::default();
    for q in quaternions.chunks_exact(4) {
        let norm = q.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
        let unit = if norm > 0.0 { q.iter().map(|&v| (f64::from(v) / norm) as f32).collect() } else { vec![1.0, 0.0, 0.0, 0.0] };
        unit.iter().zip(&mut out).for_each(|(&v, column)| column.push(v));
        // Norms within rounding of 1 are set to 1, so that unit quaternions have a constant norm.
        let log = if (norm - 1.0).abs() < 1e-6 { 0.0 } else { libm::log(norm.max(f64::from(f32::MIN_POSITIVE))) };
        out[4].push(log as f32);
    }
    out
}

fn times_norm(columns: &[Vec<f32>], count: usize) -> Vec<f32> {
    let mut rows = Vec::with_capacity(4 * count);
    for i in 0..count {
        let norm = libm::exp(f64::from(columns[4][i]));
        rows.extend(columns[..4].iter().map(|c| ((f64::from(c[i]) * norm) as f32).clamp(f32::MIN, f32::MAX)));
    }
    rows
}

/// Shift and scale per condition channel.
pub(super) struct Normalisation {
    shift: [f32; CONDITIONS],
    scale: [f32; CONDITIONS],
}

impl Normalisation {
    /// Positions: the box of the 1st to 99th percentile is mapped to -1..1. Rotations are unchanged. All others: mean 0, standard deviation 1.
    pub(super) fn of(known: &HostGaussians) -> Self {
        let n = known.len().max(1) as f64;
        let mut out = Self { shift: [0.0; CONDITIONS], scale: [1.0; CONDITIONS] };
        let mut set = |channel: usize, shift: f64, spread: f64| {
            out.shift[channel] = (shift as f32).clamp(f32::MIN, f32::MAX);
            out.scale[channel] = if spread > 0.0 { (1.0 / spread).min(1e30) as f32 } else { 0.0 };
        };
        for (axis, mut values) in split(&known.means, 3).into_iter().enumerate() {
            values.sort_unstable_by(f32::total_cmp);
            let cut = values.len() / 100;
            let low = values.get(cut).copied().unwrap_or(0.0);
            let high = values.get(values.len().saturating_sub(1 + cut)).copied().unwrap_or(0.0);
            set(axis, 0.5 * (f64::from(low) + f64::from(high)), 0.5 * (f64::from(high) - f64::from(low)));
        }
        let columns = split(&known.log_scales, 3).into_iter().zip(3..6);
        for (values, channel) in columns.chain([(known.opacity_logits.clone(), 6), (known.dynamic_scores.clone(), 11)]) {
            let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
            let variance = values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
            set(channel, mean, variance.sqrt());
        }
        out
    }
    pub(super) fn write(&self, meta: &mut Vec<u8>) {
        self.shift.iter().chain(&self.scale).for_each(|v| meta.extend(v.to_le_bytes()));
    }
    pub(super) fn read(meta: &mut ByteReader) -> Result<Self> {
        let mut out = Self { shift: [0.0; CONDITIONS], scale: [0.0; CONDITIONS] };
        for value in out.shift.iter_mut().chain(&mut out.scale) {
            *value = meta.f32()?;
        }
        Ok(out)
    }
    /// The conditions of Gaussian `i`, from values that encoder and decoder have: exact positions, everything else as decoded. Rotations are unit
    /// quaternions with w >= 0, since q and -q are one rotation.
    pub(super) fn conditions(&self, known: &HostGaussians, i: usize) -> [f32; CONDITIONS] {
        let mut raw = [0.0f64; CONDITIONS];
        for k in 0..3 {
            raw[k] = f64::from(known.means[3 * i + k]);
            raw[3 + k] = f64::from(known.log_scales[3 * i + k]);
        }
        raw[6] = f64::from(known.opacity_logits[i]);
        let q = &known.quaternions[4 * i..4 * i + 4];
        let norm = q.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
        let sign = if q[0] < 0.0 { -1.0 } else { 1.0 };
        for k in 0..4 {
            raw[7 + k] = if norm > 0.0 { sign * f64::from(q[k]) / norm } else { 0.0 };
        }
        raw[11] = f64::from(known.dynamic_scores[i]);
        std::array::from_fn(|c| ((raw[c] - f64::from(self.shift[c])) * f64::from(self.scale[c])).clamp(-CLIP, CLIP) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signs_and_norms_of_quaternions_survive() {
        let q = [-0.5f32, 0.5, 0.5, 0.5, 3.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e-30, 0.0, 0.0, 0.0];
        let back = times_norm(&unit_and_norm(&q), 4);
        for (a, b) in q.iter().zip(&back) {
            assert!((a - b).abs() <= 1e-6 * a.abs().max(1e-6), "{a} became {b}");
        }
    }

    #[test]
    fn conditions_are_finite_for_extreme_gaussians() {
        let known = HostGaussians {
            means: vec![f32::MAX, f32::MIN, 0.0, f32::MIN, f32::MAX, 0.0],
            log_scales: vec![1e38; 6],
            quaternions: vec![0.0; 8],
            opacity_logits: vec![f32::MAX, f32::MIN],
            sh_dc: vec![0.0; 6],
            dynamic_scores: vec![0.0, 1e-45],
            ..Default::default()
        };
        let norm = Normalisation::of(&known);
        assert!((0..2).all(|i| norm.conditions(&known, i).iter().all(|v| v.abs() <= CLIP as f32)));
    }
}
