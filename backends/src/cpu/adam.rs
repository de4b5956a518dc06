//! Adam in one sweep over parameters, moments and gradients (Kingma and Ba 2015, as PyTorch computes it).

use crate::cpu::scratch::scratch;
use crate::cpu::simd::{Lanes, dispatch};
use crate::ops::adam::{AdamScalars, GRADIENT_LIMIT};
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Elements per task; rows are never split.
const CHUNK: usize = 8 << 10;
/// From this width on, runs of selected rows are updated one after the other; narrower rows are masked element by element.
const WIDE_ROW: usize = 16;

/// One step in place over rows of `width` elements. Rows whose entry in `rows` is 0 are unchanged, moments included; so are
/// rows with a gradient that is not finite, or of [`GRADIENT_LIMIT`] or more.
pub fn adam(param: &mut [f32], m: &mut [f32], v: &mut [f32], grad: &[f32], width: usize, rows: Option<&[i64]>, scalars: &AdamScalars) {
    if param.is_empty() || width == 0 {
        return;
    }
    let rows_per_chunk = (CHUNK / width).max(1);
    let chunk = rows_per_chunk * width;
    let chunks = param.par_chunks_mut(chunk).zip(m.par_chunks_mut(chunk)).zip(v.par_chunks_mut(chunk)).zip(grad.par_chunks(chunk));
    chunks.enumerate().for_each(|(i, (((p, m), v), g))| {
        let visible = rows.map(|rows| &rows[i * rows_per_chunk..][..p.len() / width]);
        let sound = dispatch(AllSound(g));
        if sound && visible.is_none_or(|rows| rows.iter().all(|&r| r != 0)) {
            return dispatch(Update { p, m, v, g, keep: None, scalars });
        }
        // 1 for rows that are updated, 0 for others.
        let mut updated = scratch(p.len() / width);
        match visible {
            Some(visible) => updated.iter_mut().zip(visible).for_each(|(updated, &visible)| *updated = if visible != 0 { 1.0 } else { 0.0 }),
            None => updated.fill(1.0),
        }
        if !sound {
            for (updated, g) in updated.iter_mut().zip(g.chunks_exact(width)) {
                if !g.iter().all(is_sound) {
                    *updated = 0.0;
                }
            }
        }
        if width >= WIDE_ROW {
            let mut start = 0;
            for row in 0..=updated.len() {
                if updated.get(row).is_some_and(|updated| *updated != 0.0) {
                    continue;
                }
                let run = start * width..row * width;
                dispatch(Update { p: &mut p[run.clone()], m: &mut m[run.clone()], v: &mut v[run.clone()], g: &g[run], keep: None, scalars });
                start = row + 1;
            }
        } else {
            let mut keep = scratch(p.len());
            match width {
                1 => keep.copy_from_slice(&updated),
                3 => repeat::<3>(&mut keep, &updated),
                4 => repeat::<4>(&mut keep, &updated),
                9 => repeat::<9>(&mut keep, &updated),
                _ => keep.chunks_exact_mut(width).zip(updated.iter()).for_each(|(keep, updated)| keep.fill(*updated)),
            }
            dispatch(Update { p, m, v, g, keep: Some(&keep), scalars });
        }
    });
}

/// Each of `values`, `W` times.
fn repeat<const W: usize>(out: &mut [f32], values: &[f32]) {
    for (out, value) in out.as_chunks_mut::<W>().0.iter_mut().zip(values) {
        *out = [*value; W];
    }
}

/// Whether a gradient is a number of less than [`GRADIENT_LIMIT`].
fn is_sound(gradient: &f32) -> bool {
    gradient.abs() < GRADIENT_LIMIT
}

/// Whether [`is_sound`] holds for all.
struct AllSound<'a>(&'a [f32]);

impl WithSimd for AllSound<'_> {
    type Output = bool;
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        let chunks = self.0.chunks_exact(Lanes::<S>::COUNT);
        let rest = chunks.remainder().iter().all(is_sound);
        let (limit, one) = (Lanes::splat(simd, GRADIENT_LIMIT), Lanes::splat(simd, 1.0));
        // 1 in lanes with a gradient that is not sound.
        let mut found = Lanes::splat(simd, 0.0);
        for chunk in chunks {
            let gradient = Lanes::load(simd, chunk);
            found = gradient.max(-gradient).lt(limit).select(found, one);
        }
        rest && found.sum() == 0.0
    }
}

/// The update of a run of elements; where `keep` is 0, nothing changes.
struct Update<'a> {
    p: &'a mut [f32],
    m: &'a mut [f32],
    v: &'a mut [f32],
    g: &'a [f32],
    keep: Option<&'a [f32]>,
    scalars: &'a AdamScalars,
}

impl WithSimd for Update<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let lanes = Lanes::<S>::COUNT;
        let whole = self.p.len() / lanes * lanes;
        for at in (0..whole).step_by(lanes) {
            let keep = self.keep.map(|keep| &keep[at..]);
            advance(simd, &mut self.p[at..], &mut self.m[at..], &mut self.v[at..], &self.g[at..], keep, self.scalars);
        }
        // The rest goes through a vector of its own, so that an element's arithmetic does not depend on its index.
        let rest = self.p.len() - whole;
        if rest > 0 {
            let mut padded = [[0.0f32; MAX_LANES]; 5];
            let rows = [&*self.p, &*self.m, &*self.v, self.g, self.keep.unwrap_or(&[])];
            for (row, padded) in rows.iter().zip(&mut padded) {
                if let Some(tail) = row.get(whole..) {
                    padded[..tail.len()].copy_from_slice(tail);
                }
            }
            let [p, m, v, g, keep] = &mut padded;
            advance(simd, p, m, v, g, self.keep.map(|_| keep.as_slice()), self.scalars);
            self.p[whole..].copy_from_slice(&p[..rest]);
            self.m[whole..].copy_from_slice(&m[..rest]);
            self.v[whole..].copy_from_slice(&v[..rest]);
        }
    }
}

/// At least the lanes of every instruction set.
const MAX_LANES: usize = 16;

/// One vector.
#[inline(always)]
fn advance<S: Simd>(simd: S, p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], keep: Option<&[f32]>, s: &AdamScalars) {
    let (p0, m0, v0, g) = (Lanes::load(simd, p), Lanes::load(simd, m), Lanes::load(simd, v), Lanes::load(simd, g));
    let m1 = m0 * s.beta1 + g * s.one_minus_beta1;
    let v1 = v0 * s.beta2 + g * g * s.one_minus_beta2;
    let p1 = p0 - m1 * s.step_size / (v1.sqrt() * s.inverse_sqrt_correction + s.epsilon);
    let (p1, m1, v1) = match keep {
        Some(keep) => {
            let keep = Lanes::load(simd, keep).gt(p0.like(0.0));
            (keep.select(p1, p0), keep.select(m1, m0), keep.select(v1, v0))
        }
        None => (p1, m1, v1),
    };
    p1.store(p);
    m1.store(m);
    v1.store(v);
}
