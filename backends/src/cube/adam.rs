//! The fused Adam step on the device: one sweep decides which rows move, a second one moves them.

use super::tensor::{THREADS, constant, is_finite, owned, signed, workgroups_for, zeros};
use crate::ops::adam::{AdamOps, AdamScalars};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// moves`[row]` is 1 where the row is wanted and its gradient is finite; `skipped` counts rows that were wanted and are not finite.
#[cube(launch)]
fn rows_that_move(grad: &[f32], visible: &[i32], moves: &mut [u32], skipped: &mut [Atomic<i32>], width: u32, #[comptime] masked: bool) {
    let row = ABSOLUTE_POS;
    if row < moves.len() {
        let mut wanted = true;
        if comptime!(masked) {
            wanted = visible[row] != 0;
        }
        let mut finite = true;
        for k in 0..width as usize {
            finite = finite && is_finite(grad[row * width as usize + k]);
        }
        if wanted && !finite {
            skipped[0].fetch_add(1i32);
        }
        moves[row] = select(wanted && finite, 1u32, 0u32);
    }
}

#[cube(launch)]
fn move_rows(
    param: &mut [f32],
    m: &mut [f32],
    v: &mut [f32],
    grad: &[f32],
    moves: &[u32],
    width: u32,
    beta1: f32,
    beta2: f32,
    one_minus_beta1: f32,
    one_minus_beta2: f32,
    step_size: f32,
    inverse_sqrt_correction: f32,
    epsilon: f32,
) {
    let at = ABSOLUTE_POS;
    if at < param.len() && moves[at / width as usize] != 0 {
        let g = grad[at];
        let first = beta1 * m[at] + one_minus_beta1 * g;
        let second = beta2 * v[at] + one_minus_beta2 * g * g;
        m[at] = first;
        v[at] = second;
        param[at] -= step_size * first / (second.sqrt() * inverse_sqrt_correction + epsilon);
    }
}

fn step(param: CubeTensor, m: CubeTensor, v: CubeTensor, grad: CubeTensor, visible: Option<CubeTensor>, s: &AdamScalars) -> [CubeTensor; 4] {
    let skipped = signed(zeros(&grad, 1));
    let shape = param.meta.shape().clone();
    let (n, rows) = (shape.num_elements(), shape[0]);
    if n == 0 {
        return [param, m, v, skipped];
    }
    let width = (n / rows) as u32;
    let [param, m, v] = [param, m, v].map(owned);
    let grad = into_contiguous(grad);
    let client = grad.client.clone();
    let moves = super::tensor::empty(&grad, [rows], DType::U32);
    let masked = visible.is_some();
    // Not read without a mask, but a binding needs a buffer.
    let visible = visible.map_or_else(|| skipped.clone(), into_contiguous);
    let dim = CubeDim::new_1d(THREADS);
    rows_that_move::launch(
        &client,
        workgroups_for(rows),
        dim,
        grad.clone().into_buffer_arg(),
        if masked { visible.into_buffer_arg() } else { constant(&grad, &[0i32], DType::I32).into_buffer_arg() },
        moves.clone().into_buffer_arg(),
        skipped.clone().into_buffer_arg(),
        width,
        masked,
    );
    move_rows::launch(
        &client,
        workgroups_for(n),
        dim,
        param.clone().into_buffer_arg(),
        m.clone().into_buffer_arg(),
        v.clone().into_buffer_arg(),
        grad.into_buffer_arg(),
        moves.into_buffer_arg(),
        width,
        s.beta1,
        s.beta2,
        s.one_minus_beta1,
        s.one_minus_beta2,
        s.step_size,
        s.inverse_sqrt_correction,
        s.epsilon,
    );
    [param, m, v, skipped]
}

impl AdamOps for CubeBackend {
    fn adam(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, IntTensor<Self>) {
        step(param, m, v, grad, None, &scalars).into()
    }
    fn adam_visible(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        visible: IntTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>, IntTensor<Self>) {
        step(param, m, v, grad, Some(visible), &scalars).into()
    }
}
