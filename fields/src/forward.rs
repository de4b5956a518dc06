//! Small networks, evaluated row by row: slower than the kernels of the devices, but without burn.

use crate::networks::{LAYER_NORM_EPSILON, MishShape, ReluShape};

/// The outputs `[rows, output]` of a decoder for `x` `[rows, input]`: hidden layers are linear, LayerNorm, and Mish. `weights` has
/// [`MishShape::parameter_count`] values.
pub fn decode(shape: &MishShape, weights: &[f32], mut x: Vec<f32>) -> Vec<f32> {
    for layer in shape.layers() {
        x = linear(&x, &weights[layer.weight.clone()], &weights[layer.bias.clone()]);
        if let (Some(gain), Some(shift)) = (&layer.gain, &layer.shift) {
            let (gain, shift) = (&weights[gain.clone()], &weights[shift.clone()]);
            x.chunks_exact_mut(layer.output).for_each(|row| norm_and_mish(row, gain, shift));
        }
    }
    x
}

/// The outputs of a network for `x` `[rows, input]`, one array `[rows, width]` per output. `weights` has [`ReluShape::parameter_count`] values.
pub fn network(shape: &ReluShape, weights: &[f32], x: &[f32]) -> Vec<Vec<f32>> {
    let mut results: Vec<Vec<f32>> = Vec::new();
    let mut outputs = vec![Vec::new(); shape.output_widths().len()];
    for layer in shape.layers() {
        let input = layer.parent.map_or(x, |parent| &results[parent]);
        let mut y = linear(input, &weights[layer.weight], &weights[layer.bias]);
        if layer.relu {
            // `max` would turn NaN into 0, and hide it.
            y.iter_mut().for_each(|v| *v = if *v <= 0.0 { 0.0 } else { *v });
        }
        match layer.slot {
            Some(slot) => {
                outputs[slot] = y;
                results.push(Vec::new());
            }
            None => results.push(y),
        }
    }
    outputs
}

/// x W + b: x `[rows, in]`, W `[in, out]`, b `[out]`.
fn linear(x: &[f32], weights: &[f32], bias: &[f32]) -> Vec<f32> {
    let (output, input) = (bias.len(), weights.len() / bias.len().max(1));
    let mut out = Vec::with_capacity(x.len() / input.max(1) * output);
    for row in x.chunks_exact(input.max(1)) {
        let start = out.len();
        out.extend_from_slice(bias);
        let sums = &mut out[start..];
        for (v, weights) in row.iter().zip(weights.chunks_exact(output)) {
            sums.iter_mut().zip(weights).for_each(|(sum, w)| *sum += v * w);
        }
    }
    out
}

fn norm_and_mish(row: &mut [f32], gain: &[f32], shift: &[f32]) {
    let n = row.len() as f32;
    let mean = row.iter().sum::<f32>() / n;
    let variance = row.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n;
    let scale = 1.0 / (variance + LAYER_NORM_EPSILON).sqrt();
    for ((v, gain), shift) in row.iter_mut().zip(gain).zip(shift) {
        *v = mish((*v - mean) * scale * gain + shift);
    }
}

/// x tanh(ln(1 + e^x)) = x n / (n + 2) with n = e^x (e^x + 2); the identity above 20.
fn mish(x: f32) -> f32 {
    let e = libm::expf(x.min(20.0));
    let n = e * (e + 2.0);
    x * (n / (n + 2.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_decoder_is_its_formula() {
        let shape = MishShape { input: 2, hidden: vec![2], output: 1 };
        // W, b, gain, shift; then W, b.
        let weights = [1.0, 0.0, 0.0, 1.0, 0.5, -0.5, 2.0, 1.0, 0.1, 0.2, 3.0, -1.0, 0.25];
        assert_eq!(weights.len(), shape.parameter_count());
        let got = decode(&shape, &weights, vec![1.0, 0.0]);
        let exact = |x: f64| x * x.exp().ln_1p().tanh();
        // 1.5 and -0.5 are one deviation, 1, from their mean.
        let scale = 1.0 / (1.0f64 + 1e-5).sqrt();
        let want = 3.0 * exact(scale * 2.0 + 0.1) - exact(-scale + 0.2) + 0.25;
        assert!((f64::from(got[0]) - want).abs() < 1e-6, "{got:?} instead of {want}");
    }

    #[test]
    fn heads_share_their_trunk() {
        let shape = ReluShape { input: 1, trunk: vec![2], heads: vec![vec![1], vec![1, 1]] };
        // Trunk: (x, -x) rectified. Heads: a + 2 b; then rectified a - 1, times 3 plus 1.
        let weights = [1.0, -1.0, 0.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0, -1.0, 3.0, 1.0];
        assert_eq!(weights.len(), shape.parameter_count());
        assert_eq!(network(&shape, &weights, &[4.0, -3.0]), [[4.0, 6.0], [10.0, 1.0]]);
        let of_nan = network(&shape, &weights, &[f32::NAN, -3.0]);
        assert!(of_nan.iter().all(|head| head[0].is_nan() && !head[1].is_nan()), "{of_nan:?}");
    }
}
