//! Lives on the CPU: every row is read once, for all times, and a block of rows is worked on in vectors.

use super::heads::row_blocks;
use crate::cpu::simd::{Lanes, Mask, dispatch, each};
use crate::ops::life::{HIDDEN, LASTING, LEAST_FALLOFF, LifeRules, MOST_LOG, OUTPUTS, WIDTH};
use cc4dgs_core::LIFE_GATE_STEEPNESS;
use pulp::{Simd, WithSimd};
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 256;
/// Rows of a block: whole vectors of every instruction set.
const BLOCK: usize = 16;
/// e^[`HIDDEN`].
const LEAST_FACTOR: f32 = 9.357_623e-14;

/// Up to [`BLOCK`] rows of `N` numbers, column by column; zeros where there is no row.
type Columns<const N: usize> = [[f32; BLOCK]; N];

#[inline(always)]
fn columns(rows: &[[f32; WIDTH]]) -> Columns<WIDTH> {
    let mut out = [[0.0; BLOCK]; WIDTH];
    for (row, attributes) in rows.iter().enumerate() {
        for (column, value) in out.iter_mut().zip(attributes) {
            column[row] = *value;
        }
    }
    out
}

/// The quantities of a life that do not depend on time.
#[derive(Clone, Copy)]
struct Life<S: Simd> {
    center: Lanes<S>,
    half_width: Lanes<S>,
    falloff: Lanes<S>,
    gate: Lanes<S>,
    /// 1 - gate, computed without cancellation.
    rest: Lanes<S>,
    /// `rest`, but 0 where it is at most [`LASTING`].
    temporary: Lanes<S>,
    velocity: [Lanes<S>; 3],
}

/// A life at a time.
#[derive(Clone, Copy)]
struct At<S: Simd> {
    since: Lanes<S>,
    in_falloffs: Lanes<S>,
    life: Lanes<S>,
    factor: Lanes<S>,
}

#[inline(always)]
fn absolute<S: Simd>(x: Lanes<S>) -> Lanes<S> {
    x.max(-x)
}

/// `values`, and NaN where `of` is not a number: vector operations may drop it.
#[inline(always)]
fn unless_nan<S: Simd>(values: Lanes<S>, of: Lanes<S>) -> Lanes<S> {
    of.equal(of).select(values, of)
}

impl<S: Simd> Life<S> {
    /// The vector of rows from `at` on.
    #[inline(always)]
    fn of(simd: S, columns: &Columns<WIDTH>, at: usize) -> Self {
        let [center, half_width, falloff, gate, x, y, z]: [Lanes<S>; WIDTH] = each(
            #[inline(always)]
            |k| Lanes::load(simd, &columns[k][at..]),
        );
        let (one, most) = (center.like(1.0), center.like(MOST_LOG));
        let logit = gate * LIFE_GATE_STEEPNESS;
        let small = (-absolute(logit)).exp();
        let inverse = one / (small + 1.0);
        let (larger, smaller) = (inverse, small * inverse);
        let below = logit.lt(center.like(0.0));
        // A gate that is NaN stays NaN.
        let rest = unless_nan(below.select(larger, smaller), logit);
        // So does what depends on time, where the width or the falloff is NaN: their bounds would hide it.
        let known = unless_nan(unless_nan(rest, half_width), falloff);
        Self {
            center,
            half_width: half_width.min(most).exp(),
            falloff: falloff.min(most).exp().max(center.like(LEAST_FALLOFF)),
            gate: unless_nan(below.select(smaller, larger), logit),
            rest,
            temporary: rest.le(center.like(LASTING)).select(center.like(0.0), known),
            velocity: [x, y, z],
        }
    }
    #[inline(always)]
    fn at(&self, time_norm: f32) -> At<S> {
        let like = |value: f32| self.center.like(value);
        let since = like(time_norm) - self.center;
        let outside = (absolute(since) - self.half_width).max(like(0.0));
        let in_falloffs = outside / self.falloff;
        let life = (-(in_falloffs * in_falloffs).min(like(-HIDDEN))).exp();
        let factor = self.gate + self.temporary * life;
        At { since, in_falloffs, life, factor: unless_nan(factor.max(like(LEAST_FACTOR)).min(like(1.0)), factor) }
    }
    /// The factor of the velocity.
    #[inline(always)]
    fn moving(&self, rules: &LifeRules) -> Lanes<S> {
        if rules.gated_velocity { self.temporary } else { self.center.like(1.0) }
    }
}

/// Widths of the outputs: shift and factor, time after time.
fn widths(rules: &LifeRules) -> Vec<usize> {
    rules.times_norm.iter().flat_map(|_| [3, OUTPUTS - 3]).collect()
}

/// Shifts `[M,3]` and logarithms of factors `[M]`, time after time, of `attributes` `[M,7]`.
pub fn forward(attributes: &[f32], rules: &LifeRules) -> Vec<f32> {
    let rows = attributes.as_chunks::<WIDTH>().0;
    let mut out = vec![0.0f32; rows.len() * OUTPUTS * rules.times_norm.len()];
    let tasks = row_blocks(&mut out, &widths(rules), rows.len(), ROWS).into_par_iter().zip(rows.par_chunks(ROWS));
    tasks.for_each(|(mut out, rows)| dispatch(Forward { rows, rules, out: &mut out }));
    out
}

/// Shift and factor of some rows, time after time.
struct Forward<'k, 'o> {
    rows: &'k [[f32; WIDTH]],
    rules: &'k LifeRules,
    out: &'k mut [&'o mut [f32]],
}

impl WithSimd for Forward<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { rows, rules, out } = self;
        for (block, rows) in rows.chunks(BLOCK).enumerate() {
            let columns = columns(rows);
            for at in (0..rows.len()).step_by(Lanes::<S>::COUNT) {
                let life = Life::of(simd, &columns, at);
                let moving = life.moving(rules);
                let count = Lanes::<S>::COUNT.min(rows.len() - at);
                let first = block * BLOCK + at;
                for ([shift, log_factor], &time_norm) in out.as_chunks_mut::<2>().0.iter_mut().zip(&rules.times_norm) {
                    let now = life.at(time_norm);
                    let hidden = now.factor.lt(moving.like(rules.hidden_below));
                    let log = hidden.select(moving.like(HIDDEN), unless_nan(now.factor.ln(), now.factor));
                    let mut staged = [[0.0f32; BLOCK]; OUTPUTS];
                    for (staged, velocity) in staged.iter_mut().zip(life.velocity) {
                        (velocity * now.since * moving).store(staged);
                    }
                    log.store(&mut staged[3]);
                    for (lane, shift) in shift[3 * first..3 * (first + count)].as_chunks_mut::<3>().0.iter_mut().enumerate() {
                        *shift = [staged[0][lane], staged[1][lane], staged[2][lane]];
                    }
                    log_factor[first..first + count].copy_from_slice(&staged[3][..count]);
                }
            }
        }
    }
}

/// The gradient of `attributes` `[M,7]`: the sum over all times, in their order.
pub fn backward(attributes: &[f32], rules: &LifeRules, grad: &[f32]) -> Vec<f32> {
    let rows = attributes.as_chunks::<WIDTH>().0;
    let mut out = vec![0.0f32; WIDTH * rows.len()];
    let tasks = out.as_chunks_mut::<WIDTH>().0.par_chunks_mut(ROWS).zip(rows.par_chunks(ROWS)).enumerate();
    tasks.for_each(|(task, (out, own))| dispatch(Backward { rows: own, first: task * ROWS, count: rows.len(), rules, grad, out }));
    out
}

/// The gradient of the attributes of some rows, from `first` on, of `count` in all.
struct Backward<'k> {
    rows: &'k [[f32; WIDTH]],
    first: usize,
    count: usize,
    rules: &'k LifeRules,
    grad: &'k [f32],
    out: &'k mut [[f32; WIDTH]],
}

impl WithSimd for Backward<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { rows, first, count, rules, grad, out } = self;
        for ((block, rows), out) in rows.chunks(BLOCK).enumerate().zip(out.chunks_mut(BLOCK)) {
            let columns = columns(rows);
            let first = first + block * BLOCK;
            let mut sums = [[0.0f32; BLOCK]; WIDTH];
            for (of_time, &time_norm) in grad.chunks_exact(OUTPUTS * count).zip(&rules.times_norm) {
                let (shifts, log_factors) = of_time.split_at(3 * count);
                let mut upstream = [[0.0f32; BLOCK]; OUTPUTS];
                for (row, shift) in shifts[3 * first..3 * (first + rows.len())].as_chunks::<3>().0.iter().enumerate() {
                    for (upstream, value) in upstream.iter_mut().zip(shift) {
                        upstream[row] = *value;
                    }
                }
                upstream[3][..rows.len()].copy_from_slice(&log_factors[first..first + rows.len()]);
                for at in (0..rows.len()).step_by(Lanes::<S>::COUNT) {
                    add_gradient(simd, &columns, &upstream, at, time_norm, rules, &mut sums);
                }
            }
            for (row, out) in out.iter_mut().enumerate() {
                for (value, sum) in out.iter_mut().zip(&sums) {
                    *value = sum[row];
                }
            }
        }
    }
}

#[inline(always)]
fn add_gradient<S: Simd>(
    simd: S,
    columns: &Columns<WIDTH>,
    upstream: &Columns<OUTPUTS>,
    at: usize,
    time_norm: f32,
    rules: &LifeRules,
    sums: &mut Columns<WIDTH>,
) {
    let life = Life::of(simd, columns, at);
    let (now, moving) = (life.at(time_norm), life.moving(rules));
    let like = |value: f32| Lanes::<S>::splat(simd, value);
    let zero = like(0.0);
    let [x, y, z, log_factor]: [Lanes<S>; OUTPUTS] = each(
        #[inline(always)]
        |k| Lanes::load(simd, &upstream[k][at..]),
    );
    let along = x * life.velocity[0] + y * life.velocity[1] + z * life.velocity[2];
    let shown = now.factor.ge(like(rules.hidden_below));
    let factor = shown.keep(log_factor / now.factor);
    let of_gate = if rules.gated_velocity { -(along * now.since) } else { zero };
    let gate = of_gate + factor * (like(1.0) - now.life);
    let falls: Mask<S> = shown & now.in_falloffs.gt(zero) & (now.in_falloffs * now.in_falloffs).lt(like(-HIDDEN));
    let in_falloffs = falls.keep(now.in_falloffs * now.life * factor * life.temporary * -2.0);
    let outside = in_falloffs / life.falloff;
    let since = along * moving + now.since.lt(zero).select(-outside, outside);
    let reach = now.since * moving;
    let gradient = [
        -since,
        -(outside * life.half_width),
        -life.falloff.gt(like(LEAST_FALLOFF)).keep(in_falloffs * now.in_falloffs),
        gate * life.gate * life.rest * LIFE_GATE_STEEPNESS,
        x * reach,
        y * reach,
        z * reach,
    ];
    for (sum, value) in sums.iter_mut().zip(gradient) {
        (Lanes::load(simd, &sum[at..]) + value).store(&mut sum[at..]);
    }
}
