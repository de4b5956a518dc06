//! Lives on the device: a thread per Gaussian, for all times.

use super::tensor::{THREADS, constant, floats, is_number, workgroups_for};
use crate::ops::life::{HIDDEN, LASTING, LEAST_FALLOFF, LifeBackward, LifeOps, LifeRules, MOST_LOG, OUTPUTS, WIDTH};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use cc4dgs_core::LIFE_GATE_STEEPNESS;
use cubecl::prelude::*;
use std::sync::Arc;

/// The smaller of the gate and 1 - gate.
#[cube]
fn smaller_share(logit: f32) -> f32 {
    let small = (-logit.abs()).exp();
    small / (1.0 + small)
}

/// e^x of a logarithm that is bounded.
#[cube]
fn width(log: f32) -> f32 {
    select(log < MOST_LOG, log, MOST_LOG).exp()
}

/// The square of `in_falloffs`, bounded.
#[cube]
fn faded(in_falloffs: f32) -> f32 {
    let squared = in_falloffs * in_falloffs;
    select(squared < -HIDDEN, squared, -HIDDEN)
}

/// The opacity factor, from e^[`HIDDEN`] to 1; NaN stays.
#[cube]
fn bounded(factor: f32) -> f32 {
    let least = 9.357_623e-14f32;
    let above = select(factor > least, factor, least);
    let between = select(above < 1.0, above, 1.0f32);
    select(is_number(factor), between, factor)
}

/// What a Gaussian's life is at all times.
#[derive(CubeType, Copy, Clone)]
struct Life {
    /// Share of the opacity that does not depend on time, and the rest.
    gate: f32,
    rest: f32,
    /// 1 - gate, but 0 where it is at most [`LASTING`].
    temporary: f32,
    half_width: f32,
    falloff: f32,
    /// Whether the falloff is above its least value, so that it has a gradient.
    falloff_is_free: bool,
    /// What multiplies the velocity.
    moving: f32,
}

#[cube]
impl Life {
    /// The life whose attributes begin at index `at`.
    fn of(attributes: &[f32], at: usize, #[comptime] gated: bool) -> Life {
        let logit = LIFE_GATE_STEEPNESS * attributes[at + 3];
        let smaller = smaller_share(logit);
        // A gate that is NaN stays NaN: the exponential of NaN is any number on some devices.
        let known = is_number(logit);
        let rest = select(known, select(logit < 0.0, 1.0 - smaller, smaller), logit);
        // So does what depends on time, where the width or the falloff is NaN: their bounds would hide it.
        let (log_width, log_falloff) = (attributes[at + 1], attributes[at + 2]);
        let has_width = is_number(log_width);
        let has_falloff = is_number(log_falloff);
        let with_width = select(has_width, rest, log_width);
        let with_both = select(has_falloff, with_width, log_falloff);
        let temporary = select(rest <= LASTING, 0.0f32, with_both);
        let wanted = width(log_falloff);
        Life {
            gate: select(known, select(logit < 0.0, smaller, 1.0 - smaller), logit),
            rest,
            temporary,
            half_width: width(log_width),
            falloff: select(wanted > LEAST_FALLOFF, wanted, LEAST_FALLOFF),
            falloff_is_free: wanted > LEAST_FALLOFF,
            moving: if comptime!(gated) { temporary } else { (1.0f32).runtime() },
        }
    }
    /// How far the time `since` after the centre is outside the life, in falloffs.
    fn in_falloffs(&self, since: f32) -> f32 {
        let beyond = since.abs() - self.half_width;
        select(beyond > 0.0, beyond, 0.0f32) / self.falloff
    }
}

/// Shifts `[M,3]` and logarithms of factors `[M]`, time after time.
#[cube(launch)]
fn forward(attributes: &[f32], times: &[f32], out: &mut [f32], rows: u32, hidden_below: f32, #[comptime] gated: bool) {
    let row = ABSOLUTE_POS;
    if row < rows as usize {
        let at = row * WIDTH;
        let life = Life::of(attributes, at, gated);
        for k in 0..times.len() {
            let since = times[k] - attributes[at];
            let factor = bounded(life.gate + life.temporary * (-faded(life.in_falloffs(since))).exp());
            let base = k * rows as usize * OUTPUTS;
            for axis in 0..3usize {
                out[base + 3 * row + axis] = attributes[at + 4 + axis] * since * life.moving;
            }
            let log = select(factor < hidden_below, HIDDEN, factor.ln());
            out[base + 3 * rows as usize + row] = select(is_number(factor), log, factor);
        }
    }
}

/// The gradient of the attributes `[M,7]`.
#[cube(launch)]
fn backward(attributes: &[f32], times: &[f32], grad: &[f32], out: &mut [f32], rows: u32, hidden_below: f32, #[comptime] gated: bool) {
    let row = ABSOLUTE_POS;
    if row < rows as usize {
        let at = row * WIDTH;
        let life = Life::of(attributes, at, gated);
        let mut of_center = 0.0f32;
        let mut of_width = 0.0f32;
        let mut of_falloff = 0.0f32;
        let mut of_gate = 0.0f32;
        let mut of_x = 0.0f32;
        let mut of_y = 0.0f32;
        let mut of_z = 0.0f32;
        for k in 0..times.len() {
            let since = times[k] - attributes[at];
            let in_falloffs = life.in_falloffs(since);
            let left = (-faded(in_falloffs)).exp();
            let factor = bounded(life.gate + life.temporary * left);
            let base = k * rows as usize * OUTPUTS;
            let (x, y, z) = (grad[base + 3 * row], grad[base + 3 * row + 1], grad[base + 3 * row + 2]);
            let along = x * attributes[at + 4] + y * attributes[at + 5] + z * attributes[at + 6];
            of_x += x * since * life.moving;
            of_y += y * since * life.moving;
            of_z += z * since * life.moving;
            of_center -= along * life.moving;
            if comptime!(gated) {
                of_gate -= along * since;
            }
            if factor >= hidden_below {
                let of_factor = grad[base + 3 * rows as usize + row] / factor;
                of_gate += of_factor * (1.0 - left);
                if in_falloffs > 0.0 && in_falloffs * in_falloffs < -HIDDEN {
                    let of_falloffs = in_falloffs * (-2.0f32) * left * of_factor * life.temporary;
                    let outside = of_falloffs / life.falloff;
                    of_center -= select(since > 0.0, outside, -outside);
                    of_width -= outside * life.half_width;
                    of_falloff -= select(life.falloff_is_free, of_falloffs * in_falloffs, 0.0f32);
                }
            }
        }
        out[at] = of_center;
        out[at + 1] = of_width;
        out[at + 2] = of_falloff;
        out[at + 3] = of_gate * life.gate * life.rest * LIFE_GATE_STEEPNESS;
        out[at + 4] = of_x;
        out[at + 5] = of_y;
        out[at + 6] = of_z;
    }
}

impl LifeOps for CubeBackend {
    fn lives(attributes: FloatTensor<Self>, rules: Arc<LifeRules>) -> FloatTensor<Self> {
        let attributes = into_contiguous(attributes);
        let rows = attributes.meta.shape()[0];
        let out = floats(&attributes, [rows * OUTPUTS * rules.times_norm.len()]);
        let client = attributes.client.clone();
        let times = constant(&attributes, &rules.times_norm, DType::F32);
        let (count, dim) = (workgroups_for(rows), CubeDim::new_1d(THREADS));
        let (a, t, o) = (attributes.into_buffer_arg(), times.into_buffer_arg(), out.clone().into_buffer_arg());
        forward::launch(&client, count, dim, a, t, o, rows as u32, rules.hidden_below, rules.gated_velocity);
        out
    }
}

impl LifeBackward for CubeBackend {
    fn lives_backward(attributes: FloatTensor<Self>, rules: Arc<LifeRules>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let (attributes, grad) = (into_contiguous(attributes), into_contiguous(grad));
        let rows = attributes.meta.shape()[0];
        let out = floats(&attributes, [rows, WIDTH]);
        let client = attributes.client.clone();
        let times = constant(&attributes, &rules.times_norm, DType::F32);
        let (count, dim) = (workgroups_for(rows), CubeDim::new_1d(THREADS));
        let (a, t, g, o) = (attributes.into_buffer_arg(), times.into_buffer_arg(), grad.into_buffer_arg(), out.clone().into_buffer_arg());
        backward::launch(&client, count, dim, a, t, g, o, rows as u32, rules.hidden_below, rules.gated_velocity);
        out
    }
}
