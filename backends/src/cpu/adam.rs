//! Adam in one sweep over parameters, moments and gradients (Kingma and Ba 2015, as PyTorch computes it).

use pulp::Arch;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Elements per task; rows are never split.
const CHUNK: usize = 16 << 10;

/// The scalars of one step, bias corrections folded in.
#[derive(Clone, Copy, Debug)]
pub struct AdamScalars {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// 1 - beta1, from float64.
    pub one_minus_beta1: f32,
    /// 1 - beta2, from float64.
    pub one_minus_beta2: f32,
    /// Learning rate over the first bias correction.
    pub step_size: f32,
    /// 1 / sqrt(second bias correction).
    pub inverse_sqrt_correction: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

/// One step in place over rows of `width` elements. Rows whose entry in `rows` is false are left alone, moments included; so are
/// rows with a gradient that is not finite. Returns the number of the latter.
pub fn adam(param: &mut [f32], m: &mut [f32], v: &mut [f32], grad: &[f32], width: usize, rows: Option<&[bool]>, scalars: &AdamScalars) -> u64 {
    if param.is_empty() || width == 0 {
        return 0;
    }
    let arch = Arch::new();
    let rows_per_chunk = (CHUNK / width).max(1);
    let chunk = rows_per_chunk * width;
    let skipped = AtomicU64::new(0);
    let chunks = param.par_chunks_mut(chunk).zip(m.par_chunks_mut(chunk)).zip(v.par_chunks_mut(chunk)).zip(grad.par_chunks(chunk));
    chunks.enumerate().for_each(|(i, (((p, m), v), g))| {
        let count = p.len() / width;
        let visible = rows.map(|rows| &rows[i * rows_per_chunk..][..count]);
        let finite = arch.dispatch(|| all_finite(g));
        if finite && visible.is_none_or(|rows| rows.iter().all(|&r| r)) {
            arch.dispatch(|| update(p, m, v, g, scalars));
            return;
        }
        let mut bad = 0;
        let keep: Vec<bool> = (0..count)
            .map(|row| {
                let wanted = visible.is_none_or(|rows| rows[row]);
                let row_finite = finite || g[row * width..][..width].iter().all(|v| v.is_finite());
                bad += u64::from(wanted && !row_finite);
                wanted && row_finite
            })
            .collect();
        skipped.fetch_add(bad, Ordering::Relaxed);
        // Spread over the elements, so that the arithmetic below stays free of branches.
        let mut mask = vec![0u32; p.len()];
        for (mask, &keep) in mask.chunks_exact_mut(width).zip(&keep) {
            mask.fill(if keep { u32::MAX } else { 0 });
        }
        arch.dispatch(|| update_masked(p, m, v, g, &mask, scalars));
    });
    skipped.into_inner()
}

/// x * 0 is 0 for finite numbers and NaN for all others.
#[inline(always)]
fn all_finite(values: &[f32]) -> bool {
    let mut lanes = [0.0f32; 64];
    let chunks = values.chunks_exact(64);
    let rest = chunks.remainder().iter().all(|v| v.is_finite());
    for chunk in chunks {
        for (lane, v) in lanes.iter_mut().zip(chunk) {
            *lane += v * 0.0;
        }
    }
    rest && lanes.iter().all(|l| *l == 0.0)
}

#[inline(always)]
fn advance(p: f32, m: f32, v: f32, g: f32, s: &AdamScalars) -> (f32, f32, f32) {
    let m = s.beta1 * m + s.one_minus_beta1 * g;
    let v = s.beta2 * v + s.one_minus_beta2 * g * g;
    let p = p - s.step_size * m / (v.sqrt() * s.inverse_sqrt_correction + s.epsilon);
    (p, m, v)
}

#[inline(always)]
fn update(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], s: &AdamScalars) {
    let n = p.len();
    let (m, v, g) = (&mut m[..n], &mut v[..n], &g[..n]);
    for i in 0..n {
        (p[i], m[i], v[i]) = advance(p[i], m[i], v[i], g[i], s);
    }
}

#[inline(always)]
fn update_masked(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], mask: &[u32], s: &AdamScalars) {
    let n = p.len();
    let (m, v, g, mask) = (&mut m[..n], &mut v[..n], &g[..n], &mask[..n]);
    for i in 0..n {
        let (p1, m1, v1) = advance(p[i], m[i], v[i], g[i], s);
        let keep = mask[i] != 0;
        p[i] = if keep { p1 } else { p[i] };
        m[i] = if keep { m1 } else { m[i] };
        v[i] = if keep { v1 } else { v[i] };
    }
}
