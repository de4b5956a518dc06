//! Binary cross-entropy of logits, with its gradient, on the device.

use super::tensor::{THREADS, compensated_sum, floats, sum_of_threads, upload, workgroups_for};
use burn::backend::TensorMetadata;
use burn::tensor::DType;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Cross-entropy of logits against a mask: sums per workgroup, and the gradient of the mean.
#[cube(launch)]
fn bce_terms(logits: &[f32], mask: &[f32], grad: &mut [f32], partial: &mut [f32], scale: f32, #[comptime] gradient: bool) {
    let mut terms = Shared::<[f32]>::new_slice(THREADS as usize);
    let at = ABSOLUTE_POS;
    let mut term = 0.0f32;
    if at < mask.len() {
        let (z, t) = (logits[at], mask[at]);
        let e = (-z.abs()).exp();
        // max(z, 0) - z t + ln(1 + e^-|z|), which neither overflows nor cancels.
        term = select(z > 0.0, z, 0.0f32) - z * t + (1.0 + e).ln();
        if comptime!(gradient) {
            let sigmoid = select(z >= 0.0, 1.0 / (1.0 + e), e / (1.0 + e));
            grad[at] = (sigmoid - t) * scale;
        }
    } else if comptime!(gradient) {
        if at < grad.len() {
            grad[at] = 0.0;
        }
    }
    terms[UNIT_POS as usize] = term;
    sync_cube();
    if UNIT_POS == 0 {
        let mut sum = 0.0f32;
        for k in 0..THREADS as usize {
            sum += terms[k];
        }
        if CUBE_POS < partial.len() {
            partial[CUBE_POS] = sum;
        }
    }
}

/// Adds up the sums of all workgroups, by one workgroup, with compensation for rounding (Kahan).
#[cube(launch)]
fn finish_mean(partial: &[f32], mean: &mut [f32], workgroups: u32, scale: f32) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let mut sum = 0.0f32;
    let mut lost = 0.0f32;
    let mut k = UNIT_POS as usize;
    while k < workgroups as usize {
        let (next, rest) = compensated_sum(sum, lost, partial[k]);
        sum = next;
        lost = rest;
        k += THREADS as usize;
    }
    let total = sum_of_threads(&mut sums, sum);
    if UNIT_POS == 0 {
        mean[0] = total * scale;
    }
}

/// `(loss [1], gradient)` as in [`crate::ops::photometric::PhotometricKernels::bce_pass`].
pub fn bce(planes: CubeTensor, mask: CubeTensor, gradient: bool) -> (CubeTensor, CubeTensor) {
    let (planes, mask) = (into_contiguous(planes), into_contiguous(mask));
    let shape = planes.shape();
    let pixels = shape[1] * shape[2];
    let client = planes.client.clone();
    if pixels == 0 {
        return (upload(&planes, &[0.0f32], DType::F32), floats(&planes, shape));
    }
    let items = if gradient { shape.num_elements() } else { pixels };
    let workgroups = items.div_ceil(THREADS as usize);
    let grad = floats(&planes, if gradient { shape } else { [1].into() });
    let (partial, loss) = (floats(&planes, [workgroups]), floats(&planes, [1]));
    let scale = 1.0 / pixels as f32;
    let count = workgroups_for(items);
    bce_terms::launch(
        &client,
        count,
        CubeDim::new_1d(THREADS),
        planes.into_buffer_arg(),
        mask.into_buffer_arg(),
        grad.clone().into_buffer_arg(),
        partial.clone().into_buffer_arg(),
        scale,
        gradient,
    );
    let one = CubeCount::Static(1, 1, 1);
    finish_mean::launch(&client, one, CubeDim::new_1d(THREADS), partial.into_buffer_arg(), loss.clone().into_buffer_arg(), workgroups as u32, scale);
    (loss, grad)
}
