//! Initial weights. Layers in front of a ReLU keep the size of their signal (He et al. 2015): with PyTorch's default for `nn.Linear` the nine
//! ReLU layers between time and motion shrink it a hundredfold, the biases take over, and Adam then kills the trunk before anything moves.
//! Decoders normalise their layers themselves and use that default.

use cc4dgs_backends::ops::field::{MishShape, ReluShape};
use cc4dgs_core::Seed;
use rand::Rng;

/// W [input, output], then b [output], uniform in ±1/sqrt(inputs).
fn decoder_layer(seed: Seed, input: usize, output: usize) -> Vec<f32> {
    let bound = 1.0 / (input.max(1) as f32).sqrt();
    let mut random = seed.rng();
    (0..(input + 1) * output).map(|_| random.random_range(-bound..=bound)).collect()
}

/// A layer whose output has the mean square of its input times `gain`: W [input, output] uniform, b = 0 [output].
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

/// A decoder: LayerNorm starts as the identity.
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

/// The layers of a chain of `widths`, a ReLU after each.
pub fn chain(seed: Seed, widths: &[usize]) -> Vec<f32> {
    widths.windows(2).enumerate().flat_map(|(i, pair)| rectified(seed.index(i as u64), pair[0], pair[1])).collect()
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
    let mut out = rectified(seed, width, width);
    out.extend(std::iter::repeat_n(0.0, (width + 1) * output));
    out
}
