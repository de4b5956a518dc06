//! Initial weights. Layers in front of a ReLU preserve the variance of their input (He et al. 2015). With PyTorch's default for `nn.Linear`, the nine
//! ReLU layers between time and motion shrink the signal a hundredfold, the biases dominate, and Adam then turns off the trunk's ReLUs before anything moves.
//! Decoders normalise their hidden layers and use that default.

use burn::tensor::Tensor;
use cc4dgs_backends::ops::field::{MishShape, ReluShape};
use cc4dgs_core::Seed;
use rand::Rng;

/// W `[input, output]`, then b `[output]`, uniform in ±1/sqrt(inputs).
fn decoder_layer(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    let bound = 1.0 / (input.max(1) as f32).sqrt();
    let mut random = seed.rng();
    (0..(input + 1) * output).map(|_| random.random_range(-bound..=bound)).collect()
}

/// A layer whose output has the mean square of its input times `gain`: W `[input, output]` uniform, b = 0 `[output]`.
fn preserving(seed: Seed, input: usize, output: usize, gain: f32) -> Vec<f32> {
    let bound = (3.0 * gain / input.max(1) as f32).sqrt();
    let mut random = seed.rng();
    (0..input * output).map(|_| random.random_range(-bound..=bound)).chain(std::iter::repeat_n(0.0, output)).collect()
}

/// A layer that no activation follows.
pub fn linear(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    preserving(seed, input, output, 1.0)
}

/// A layer in front of a ReLU, which lets half of the signal through.
fn rectified(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    preserving(seed, input, output, 2.0)
}

/// A decoder; LayerNorm starts with scale 1 and shift 0.
pub fn decoder(seed: Seed, shape: &MishShape) -> Vec<f32> {
    let mut out = Vec::with_capacity(shape.parameter_count());
    for (i, layer) in shape.layers().iter().enumerate() {
        out.extend(decoder_layer(seed.index(i as u64), layer.input, layer.output));
        if layer.gain.is_some() {
            out.extend(std::iter::repeat_n(1.0, layer.output).chain(std::iter::repeat_n(0.0, layer.output)));
        }
    }
    out
}

/// Layers of the given `widths`, each followed by a ReLU.
pub fn chain(seed: Seed, widths: &[usize]) -> Vec<f32> {
    widths.windows(2).enumerate().flat_map(|(i, pair)| rectified(seed.index(i as u64), pair[0], pair[1])).collect()
}

/// The widths of a network with one head, input first.
pub fn widths(shape: &ReluShape) -> Vec<usize> {
    std::iter::once(shape.input).chain(shape.trunk.iter().copied()).chain(shape.heads.iter().flatten().copied()).collect()
}

/// The FiLM generator: its last layer has zero weights and bias (1…, 0…), so that modulation starts as the identity.
pub fn film(seed: Seed, shape: &ReluShape, width: usize) -> Vec<f32> {
    let mut out = chain(seed, &widths(shape));
    let at = out.len() - 2 * width;
    out[at - 2 * width * width..].fill(0.0);
    out[at..at + width].fill(1.0);
    out
}

/// A last layer that gives nothing at first: W `[input, output]` and b `[output]` are zero.
pub fn zeros(input: usize, output: usize) -> Vec<f32> {
    vec![0.0; (input + 1) * output]
}

/// A head with some hidden layers: its last layer is zero, so that nothing moves at first. Features are of order 1, so random heads would displace everything.
pub fn head(seed: Seed, width: usize, hidden: usize, output: usize) -> Vec<f32> {
    let seed_of = |layer: usize| if layer == 0 { seed } else { seed.index(layer as u64) };
    let mut out: Vec<f32> = (0..hidden).flat_map(|layer| rectified(seed_of(layer), width, width)).collect();
    out.extend(zeros(width, output));
    out
}

/// A linear layer as PyTorch's `nn.Linear` starts: W `[input, output]` and b `[output]` uniform in ±1/sqrt(inputs).
pub fn torch(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    decoder_layer(seed, input, output)
}

/// W `[input, output]` uniform in ±sqrt(6 / (input + output)) (Glorot), without a bias.
pub fn glorot(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    uniform(seed, input * output, (6.0 / (input + output) as f32).sqrt())
}

/// `count` values, uniform in ±`bound`.
pub fn uniform(seed: Seed, count: usize, bound: f32) -> Vec<f32> {
    let mut random = seed.rng();
    (0..count).map(|_| random.random_range(-bound..=bound)).collect()
}

/// A linear layer with Glorot weights and PyTorch's bias, as in 4DGS. The code of E-D3DGS defines this start, too, but never calls it: its layers start as
/// [`torch`].
pub fn glorot_with_bias(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    let bias = uniform(seed.child("bias"), output, 1.0 / (input.max(1) as f32).sqrt());
    glorot(seed.child("matrix"), input, output).into_iter().chain(bias).collect()
}

/// The flat weights of layers without biases: `matrices` one after another, with zero biases inserted.
pub fn without_biases(matrices: Tensor<1>, layers: &[(usize, usize)]) -> Tensor<1> {
    let mut at = 0;
    let mut parts = Vec::with_capacity(2 * layers.len());
    for &(input, output) in layers {
        parts.push(matrices.clone().narrow(0, at, input * output));
        parts.push(Tensor::zeros([output], &matrices.device()));
        at += input * output;
    }
    Tensor::cat(parts, 0)
}
