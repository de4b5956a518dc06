//! Lives on the CPU: every row is read once, for all times.

use super::heads::row_blocks;
use crate::ops::life::{HIDDEN, LEAST_FALLOFF, LifeRules, MOST_LOG, OUTPUTS, WIDTH};
use cc4dgs_core::LIFE_GATE_STEEPNESS;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 256;

/// What a row's attributes say, whatever the time.
struct Life {
    center: f32,
    half_width: f32,
    falloff: f32,
    gate: f32,
    /// 1 - gate, which does not cancel.
    temporary: f32,
    velocity: [f32; 3],
}

impl Life {
    fn of(&[center, half_width, falloff, gate, x, y, z]: &[f32; WIDTH]) -> Self {
        let logit = LIFE_GATE_STEEPNESS * gate;
        let small = (-logit.abs()).exp();
        let (larger, smaller) = (1.0 / (1.0 + small), small / (1.0 + small));
        // A gate that is not a number stays one.
        let (gate, temporary) = if logit < 0.0 { (smaller, larger) } else { (larger, smaller) };
        let half_width = half_width.min(MOST_LOG).exp();
        Self { center, half_width, falloff: falloff.min(MOST_LOG).exp().max(LEAST_FALLOFF), gate, temporary, velocity: [x, y, z] }
    }
    fn at(&self, time_norm: f32) -> At {
        let since = time_norm - self.center;
        let outside = (since.abs() - self.half_width).max(0.0);
        let in_falloffs = outside / self.falloff;
        let life = (-(in_falloffs * in_falloffs).min(-HIDDEN)).exp();
        At { since, in_falloffs, life, factor: (self.gate + self.temporary * life).clamp(HIDDEN.exp(), 1.0) }
    }
    /// What velocities are multiplied by.
    fn moving(&self, rules: &LifeRules) -> f32 {
        if rules.gated_velocity { self.temporary } else { 1.0 }
    }
}

/// A life at a time.
struct At {
    since: f32,
    in_falloffs: f32,
    life: f32,
    factor: f32,
}

/// Widths of the outputs: shift and factor, time after time.
fn widths(rules: &LifeRules) -> Vec<usize> {
    rules.times_norm.iter().flat_map(|_| [3, OUTPUTS - 3]).collect()
}

/// Shifts `[M,3]` and logarithms of factors `[M]`, time after time, of `attributes` `[M,7]`.
pub fn forward(attributes: &[f32], rules: &LifeRules) -> Vec<f32> {
    let rows = attributes.as_chunks::<WIDTH>().0;
    let mut out = vec![0.0f32; rows.len() * OUTPUTS * rules.times_norm.len()];
    row_blocks(&mut out, &widths(rules), rows.len(), ROWS).into_par_iter().zip(rows.par_chunks(ROWS)).for_each(|(mut out, rows)| {
        for (row, attributes) in rows.iter().enumerate() {
            let life = Life::of(attributes);
            let moving = life.moving(rules);
            for (out, &time_norm) in out.as_chunks_mut::<2>().0.iter_mut().zip(&rules.times_norm) {
                let at = life.at(time_norm);
                let [shift, log_factor] = out;
                for (k, v) in life.velocity.iter().enumerate() {
                    shift[3 * row + k] = v * at.since * moving;
                }
                log_factor[row] = if at.factor < rules.hidden_below { HIDDEN } else { at.factor.ln() };
            }
        }
    });
    out
}

/// The gradient of `attributes` `[M,7]`: the sum over all times, in their order.
pub fn backward(attributes: &[f32], rules: &LifeRules, grad: &[f32]) -> Vec<f32> {
    let rows = attributes.as_chunks::<WIDTH>().0;
    let count = rows.len();
    let mut out = vec![0.0f32; WIDTH * count];
    let blocks = out.as_chunks_mut::<WIDTH>().0.par_chunks_mut(ROWS).zip(rows.par_chunks(ROWS)).enumerate();
    blocks.for_each(|(block, (out, rows))| {
        for (row, (out, attributes)) in out.iter_mut().zip(rows).enumerate() {
            let row = block * ROWS + row;
            let life = Life::of(attributes);
            for (moment, &time_norm) in grad.chunks_exact(OUTPUTS * count).zip(&rules.times_norm) {
                add_gradient(out, &life, time_norm, rules, [0, 1, 2].map(|k| moment[3 * row + k]), moment[3 * count + row]);
            }
        }
    });
    out
}

fn add_gradient(out: &mut [f32; WIDTH], life: &Life, time_norm: f32, rules: &LifeRules, shift: [f32; 3], log_factor: f32) {
    let at = life.at(time_norm);
    let moving = life.moving(rules);
    let along: f32 = (0..3).map(|k| shift[k] * life.velocity[k]).sum();
    let mut since = along * moving;
    let mut gate = if rules.gated_velocity { -along * at.since } else { 0.0 };
    for (k, shift) in shift.into_iter().enumerate() {
        out[4 + k] += shift * at.since * moving;
    }
    if at.factor >= rules.hidden_below {
        let factor = log_factor / at.factor;
        gate += factor * (1.0 - at.life);
        if at.in_falloffs > 0.0 && at.in_falloffs * at.in_falloffs < -HIDDEN {
            let in_falloffs = -2.0 * at.in_falloffs * at.life * factor * life.temporary;
            let outside = in_falloffs / life.falloff;
            since += outside * at.since.signum();
            out[1] -= outside * life.half_width;
            if life.falloff > LEAST_FALLOFF {
                out[2] -= in_falloffs * at.in_falloffs;
            }
        }
    }
    out[0] -= since;
    out[3] += gate * life.gate * life.temporary * LIFE_GATE_STEEPNESS;
}
