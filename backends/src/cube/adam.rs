//! The fused Adam step on the device: one sweep. Before it, another sweep marks which wide rows are updated.

use super::tensor::{THREADS, constant, owned, workgroups_for};
use crate::ops::adam::{AdamOps, AdamScalars, GRADIENT_LIMIT};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Upper bound on the width of narrow rows, of which every value checks the whole row; wider rows are checked once, by an earlier launch.
const NARROW: usize = 4;
/// The bits of [`GRADIENT_LIMIT`].
const LIMIT_BITS: u32 = GRADIENT_LIMIT.to_bits();

/// Whether a gradient is a number of less than [`GRADIENT_LIMIT`], by its bits: shader compilers may assume that arithmetic never meets infinities and NaN.
#[cube]
fn is_sound(gradient: f32) -> bool {
    (u32::reinterpret(gradient) & 0x7fff_ffffu32) < LIMIT_BITS
}

/// Whether the row is wanted and its gradient is sound.
#[cube]
fn row_is_updated(grad: &[f32], visible: &[i32], row: usize, width: u32, #[comptime] masked: bool) -> bool {
    let mut wanted = true;
    if comptime!(masked) {
        wanted = visible[row] != 0;
    }
    let mut sound = true;
    for k in 0..width as usize {
        sound = sound && is_sound(grad[row * width as usize + k]);
    }
    wanted && sound
}

/// updated`[row]` is 1 where the row is updated, else 0.
#[cube(launch)]
fn mark_rows(grad: &[f32], visible: &[i32], updated: &mut [u32], width: u32, #[comptime] masked: bool) {
    let row = ABSOLUTE_POS;
    if row < updated.len() {
        let own = row_is_updated(grad, visible, row, width, masked);
        updated[row] = select(own, 1u32, 0u32);
    }
}

/// Updates the rows that `row_is_updated` selects. For wide rows `updated` holds its result; every value of a narrow row calls it.
#[cube(launch)]
fn update_rows(
    param: &mut [f32],
    m: &mut [f32],
    v: &mut [f32],
    grad: &[f32],
    updated: &[u32],
    visible: &[i32],
    width: u32,
    beta1: f32,
    beta2: f32,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    step_size: f32,
    inverse_sqrt_correction: f32,
    epsilon: f32,
    #[comptime] narrow: bool,
    #[comptime] masked: bool,
) {
    let at = ABSOLUTE_POS;
    if at < param.len() {
        let row = at / width as usize;
        let own = if comptime!(narrow) { row_is_updated(grad, visible, row, width, masked) } else { updated[row] != 0 };
        if own {
            let g = grad[at];
            let first = beta1 * m[at] + one_minus_beta1 * g;
            let second = beta2 * v[at] + one_minus_beta2 * g * g;
            m[at] = first;
            v[at] = second;
            param[at] -= step_size * first / (second.sqrt() * inverse_sqrt_correction + epsilon);
        }
    }
}

fn step(param: CubeTensor, m: CubeTensor, v: CubeTensor, grad: CubeTensor, visible: Option<CubeTensor>, s: &AdamScalars) -> [CubeTensor; 3] {
    let shape = param.meta.shape().clone();
    let (n, rows) = (shape.num_elements(), shape[0]);
    if n == 0 {
        return [param, m, v];
    }
    let width = (n / rows) as u32;
    let [param, m, v] = [param, m, v].map(owned);
    let grad = into_contiguous(grad);
    let client = grad.client.clone();
    let (narrow, masked) = (width as usize <= NARROW, visible.is_some());
    // Arrays that are not read need a buffer of their type.
    let nothing = || constant(&grad, &[0i32], DType::I32);
    let visible = visible.map_or_else(nothing, into_contiguous);
    let updated = if narrow { constant(&grad, &[0u32], DType::U32) } else { super::tensor::empty(&grad, [rows], DType::U32) };
    let dim = CubeDim::new_1d(THREADS);
    if !narrow {
        let (g, seen) = (grad.clone().into_buffer_arg(), visible.clone().into_buffer_arg());
        mark_rows::launch(&client, workgroups_for(rows), dim, g, seen, updated.clone().into_buffer_arg(), width, masked);
    }
    update_rows::launch(
        &client,
        workgroups_for(n),
        dim,
        param.clone().into_buffer_arg(),
        m.clone().into_buffer_arg(),
        v.clone().into_buffer_arg(),
        grad.into_buffer_arg(),
        updated.into_buffer_arg(),
        visible.into_buffer_arg(),
        width,
        s.beta1,
        s.beta2,
        s.one_minus_beta1,
        s.one_minus_beta2,
        s.step_size,
        s.inverse_sqrt_correction,
        s.epsilon,
        narrow,
        masked,
    );
    [param, m, v]
}

impl AdamOps for CubeBackend {
    fn adam(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        step(param, m, v, grad, None, &scalars).into()
    }
    fn adam_visible(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        visible: IntTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        step(param, m, v, grad, Some(visible), &scalars).into()
    }
}
