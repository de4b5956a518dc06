//! Mish and LayerNorm over rows, forward and backward, in loops that vectorise.

use cc4dgs_fields::networks::LAYER_NORM_EPSILON;

/// e^x for |x| <= 87, branch-free; relative error below 2e-7.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer in the low mantissa bits, on every instruction set alike.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    // ln 2 in two parts, so that the remainder is exact.
    let r = (x - n * 0.693_359_4) + n * 2.121_944_4e-4;
    let mut p = 1.987_569_1e-4;
    p = p * r + 1.398_199_9e-3;
    p = p * r + 8.333_452e-3;
    p = p * r + 4.166_579_6e-2;
    p = p * r + 1.666_666_5e-1;
    p = p * r + 0.5;
    let p = p * r * r + r + 1.0;
    let exponent = shifted.to_bits().wrapping_sub(ROUND.to_bits()) << 23;
    f32::from_bits(p.to_bits().wrapping_add(exponent))
}

/// Above 20 Mish is the identity in float32; below -87 e^x leaves the normal range.
#[inline(always)]
fn clamped_exp(x: f32) -> f32 {
    let x = if x < 20.0 { x } else { 20.0 };
    exp(if x > -87.0 { x } else { -87.0 })
}

/// x * tanh(softplus(x)) = x n / (n + 2) with n = e^x (e^x + 2): no cancellation on either side.
#[inline(always)]
pub fn mish(x: f32) -> f32 {
    let e = clamped_exp(x);
    let n = e * (e + 2.0);
    x * (n / (n + 2.0))
}

/// Derivative of [`mish`].
#[inline(always)]
pub fn mish_derivative(x: f32) -> f32 {
    let e = clamped_exp(x);
    let n = e * (e + 2.0);
    let inverse = 1.0 / (n + 2.0);
    // sech^2(softplus) * sigmoid = 4 e (e + 1) / (n + 2)^2.
    n * inverse + x * (4.0 * e * (e + 1.0) * inverse) * inverse
}

/// Sum of one row in a fixed order that vectorises.
#[inline(always)]
fn row_sum(row: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut lanes = [0.0f32; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for i in 0..LANES {
            lanes[i] += chunk[i];
        }
    }
    let mut half = LANES / 2;
    while half > 0 {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
        half /= 2;
    }
    lanes[0] + rest
}

/// Normalises each row of `z` `[rows, n]` to zero mean and unit (biased) variance in place; `inverse_std` `[rows]` receives the scales.
#[inline(always)]
pub fn normalize_rows(z: &mut [f32], n: usize, inverse_std: &mut [f32], work: &mut [f32]) {
    let work = &mut work[..n];
    for (row, inverse) in z.chunks_exact_mut(n).zip(inverse_std) {
        let mean = row_sum(row) / n as f32;
        for (v, w) in row.iter_mut().zip(work.iter_mut()) {
            *v -= mean;
            *w = *v * *v;
        }
        let scale = 1.0 / (row_sum(work) / n as f32 + LAYER_NORM_EPSILON).sqrt();
        for v in row.iter_mut() {
            *v *= scale;
        }
        *inverse = scale;
    }
}

/// `out` = mish(normalized * gain + shift), row by row.
#[inline(always)]
pub fn affine_mish_rows(out: &mut [f32], normalized: &[f32], gain: &[f32], shift: &[f32]) {
    let n = gain.len();
    let shift = &shift[..n];
    for (out, x) in out.chunks_exact_mut(n).zip(normalized.chunks_exact(n)) {
        for (((out, x), gain), shift) in out.iter_mut().zip(x).zip(gain).zip(shift) {
            *out = mish(x * gain + shift);
        }
    }
}

/// Backward of [`normalize_rows`] and [`affine_mish_rows`] together. `grad` `[rows, n]` holds d loss / d out and becomes
/// d loss / d (input of the normalisation); `grad_gain` and `grad_shift` `[n]` are added to.
#[inline(always)]
pub fn affine_mish_backward(
    grad: &mut [f32],
    normalized: &[f32],
    inverse_std: &[f32],
    (gain, shift): (&[f32], &[f32]),
    (grad_gain, grad_shift): (&mut [f32], &mut [f32]),
    work: &mut [f32],
) {
    let n = gain.len();
    for (g, x) in grad.chunks_exact_mut(n).zip(normalized.chunks_exact(n)) {
        for (((g, x), gain), shift) in g.iter_mut().zip(x).zip(gain).zip(shift) {
            *g *= mish_derivative(x * gain + shift);
        }
    }
    layer_norm_backward(grad, normalized, inverse_std, gain, (grad_gain, grad_shift), work);
}

/// Backward of LayerNorm: `grad` `[rows, n]` holds d loss / d (normalized * gain + shift) and becomes d loss / d input.
#[inline(always)]
pub fn layer_norm_backward(
    grad: &mut [f32],
    normalized: &[f32],
    inverse_std: &[f32],
    gain: &[f32],
    (grad_gain, grad_shift): (&mut [f32], &mut [f32]),
    work: &mut [f32],
) {
    let n = gain.len();
    let (grad_gain, grad_shift) = (&mut grad_gain[..n], &mut grad_shift[..n]);
    let work = &mut work[..n];
    // Scales are copied and arrays walked together: what might be written through another name, or be out of bounds, is not vectorised.
    for ((g, x), &inverse) in grad.chunks_exact_mut(n).zip(normalized.chunks_exact(n)).zip(inverse_std) {
        for (((g, x), grad_gain), grad_shift) in g.iter().zip(x).zip(grad_gain.iter_mut()).zip(grad_shift.iter_mut()) {
            *grad_gain += g * x;
            *grad_shift += g;
        }
        for (((g, x), gain), work) in g.iter_mut().zip(x).zip(gain).zip(work.iter_mut()) {
            *g *= gain;
            *work = *g * x;
        }
        let mean = row_sum(g) / n as f32;
        let projection = row_sum(work) / n as f32;
        for (g, x) in g.iter_mut().zip(x) {
            *g = inverse * (*g - mean - x * projection);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_exact_to_float32() {
        let worst = (-8700..=8700).map(|i| i as f32 / 100.0).map(|x| (f64::from(exp(x)) / f64::from(x).exp() - 1.0).abs()).fold(0.0, f64::max);
        assert!(worst < 3e-7, "relative error {worst:e}");
    }

    #[test]
    fn mish_stays_finite_and_right_far_out() {
        for x in [-1e30f32, -1000.0, -88.0, -20.0, 0.0, 19.9, 20.1, 88.0, 1e30] {
            assert!(mish(x).is_finite() && mish_derivative(x).is_finite(), "{x}");
        }
        assert_eq!(mish(1e30), 1e30);
        assert!((mish_derivative(50.0) - 1.0).abs() < 1e-6);
        assert!(mish(-30.0).abs() < 1e-11);
    }
}
