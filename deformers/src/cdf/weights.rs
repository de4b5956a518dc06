//! Initial weights: uniform in ±1/sqrt(inputs) for matrices and biases, as PyTorch's `nn.Linear`; the exceptions are stated where they are made.

use cc4dgs_backends::ops::field::{MishShape, ReluShape};
use cc4dgs_core::Seed;
use rand::Rng;

/// W [input, output], then b [output].
pub fn linear(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    let bound = 1.0 / (input.max(1) as f32).sqrt();
    let mut random = seed.rng();
    (0..(input + 1) * output).map(|_| random.random_range(-bound..=bound)).collect()
}

/// A decoder: LayerNorm starts as the identity.
pub fn decoder(seed: Seed, shape: &MishShape) -> Vec<f32> {
    let mut out = Vec::with_capacity(shape.parameter_count());
    for (i, layer) in shape.layers().iter().enumerate() {
        out.extend(linear(seed.index(i as u64), layer.input, layer.output));
        if layer.gain.is_some() {
            out.extend(std::iter::repeat_n(1.0, layer.output).chain(std::iter::repeat_n(0.0, layer.output)));
        }
    }
    out
}

/// The layers of a chain of `widths`.
pub fn chain(seed: Seed, widths: &[usize]) -> Vec<f32> {
    widths.windows(2).enumerate().flat_map(|(i, pair)| linear(seed.index(i as u64), pair[0], pair[1])).collect()
}

/// The widths of a one-headed chain, input first.
pub fn widths(shape: &ReluShape) -> Vec<usize> {
    std::iter::once(shape.input).chain(shape.trunk.iter().copied()).chain(shape.heads.iter().flatten().copied()).collect()
}

/// FiLM's generator: its last layer has zero weights and bias (1…, 0…), so that modulation starts as the identity.
pub fn film(seed: Seed, shape: &ReluShape, width: usize) -> Vec<f32> {
    let mut out = chain(seed, &widths(shape));
    let at = out.len() - 2 * width;
    out[at - 2 * width * width..].fill(0.0);
    out[at..at + width].fill(1.0);
    out
}

/// A head: its last layer is zero, so that nothing moves at first. Signatures are of order 1, so random heads would displace everything.
pub fn head(seed: Seed, width: usize, output: usize) -> Vec<f32> {
    let mut out = linear(seed, width, width);
    out.extend(std::iter::repeat_n(0.0, (width + 1) * output));
    out
}
