//! Sums over views on a GPU: one thread per Gaussian.

use super::tensor::{THREADS, floats, is_finite, owned, workgroups_for};
use crate::ops::view_sums::{MOST_LOGIT, ViewSumOps};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use cubecl::prelude::*;

#[cube(launch)]
fn sum_gradients(sums: &mut [f32], radii: &[i32], gradient: &[f32], scale_x: f32, scale_y: f32) {
    let row = ABSOLUTE_POS;
    if row < radii.len() && radii[row] > 0 {
        let x = gradient[2 * row] * scale_x;
        let y = gradient[2 * row + 1] * scale_y;
        let norm = (x * x + y * y).sqrt();
        if is_finite(norm) {
            sums[2 * row] += norm;
            sums[2 * row + 1] += 1.0f32;
        }
    }
}

#[cube(launch)]
fn sum_weights(sums: &mut [f32], radii: &[i32], weights: &[f32]) {
    let row = ABSOLUTE_POS;
    if row < radii.len() {
        let weight = weights[row];
        sums[3 * row] += weight;
        sums[3 * row + 1] += weight * weight;
        sums[3 * row + 2] += select(radii[row] > 0, 1.0f32, 0.0f32);
    }
}

#[cube(launch)]
fn fade_shown(logits: &[f32], radii: &[i32], out: &mut [f32], share: f32) {
    let row = ABSOLUTE_POS;
    if row < radii.len() {
        let logit = logits[row];
        // NaN stays NaN, and density control removes the Gaussian.
        let below = select(logit > MOST_LOGIT, MOST_LOGIT, logit);
        let bounded = select(below < -MOST_LOGIT, -MOST_LOGIT, below);
        let faded = ((1.0 - share) / ((-bounded).exp() + share)).ln();
        out[row] = select(radii[row] > 0, faded, logit);
    }
}

impl ViewSumOps for CubeBackend {
    fn add_gradients(sums: FloatTensor<Self>, radii: IntTensor<Self>, gradient: FloatTensor<Self>, scale: [f32; 2]) -> FloatTensor<Self> {
        let sums = owned(sums);
        let [radii, gradient] = [radii, gradient].map(into_contiguous);
        let (client, rows) = (sums.client.clone(), sums.meta.shape()[0]);
        sum_gradients::launch(
            &client,
            workgroups_for(rows),
            CubeDim::new_1d(THREADS),
            sums.clone().into_buffer_arg(),
            radii.into_buffer_arg(),
            gradient.into_buffer_arg(),
            scale[0],
            scale[1],
        );
        sums
    }
    fn add_weights(sums: FloatTensor<Self>, radii: IntTensor<Self>, weights: FloatTensor<Self>) -> FloatTensor<Self> {
        let sums = owned(sums);
        let [radii, weights] = [radii, weights].map(into_contiguous);
        let (client, rows) = (sums.client.clone(), sums.meta.shape()[0]);
        let dim = CubeDim::new_1d(THREADS);
        sum_weights::launch(&client, workgroups_for(rows), dim, sums.clone().into_buffer_arg(), radii.into_buffer_arg(), weights.into_buffer_arg());
        sums
    }
    fn fade(logits: FloatTensor<Self>, radii: IntTensor<Self>, share: f32) -> FloatTensor<Self> {
        let [logits, radii] = [logits, radii].map(into_contiguous);
        let out = floats(&logits, logits.meta.shape().clone());
        let (client, rows) = (logits.client.clone(), logits.meta.shape()[0]);
        fade_shown::launch(
            &client,
            workgroups_for(rows),
            CubeDim::new_1d(THREADS),
            logits.into_buffer_arg(),
            radii.into_buffer_arg(),
            out.clone().into_buffer_arg(),
            share,
        );
        out
    }
}
