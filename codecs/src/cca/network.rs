//! The networks of the autoencoder, and the inference code that encoder and decoder share.
//!
//! Encoder: coefficients and conditions, two hidden layers, latents. Decoder: latents and conditions, two hidden layers, coefficients; GELU
//! after each hidden layer (paper Section IV-D, which leaves the widths open).
//!
//! The decoder must give the same bits on every machine, because the residual codebook is computed from its output. So it is plain float32:
//! each sum runs over its inputs in order, nothing is contracted or reassociated, and the exponential is a polynomial of such operations.

use super::geometry::CONDITIONS;

/// Layers of the encoder, and of the decoder.
pub(super) const HALF: usize = 3;
/// Outputs computed per SIMD block. Each output has its own sum, so the result does not depend on the number of lanes.
const LANES: usize = 16;

/// One linear layer inside the flat parameters.
#[derive(Clone, Copy, Debug)]
pub(super) struct Layer {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Index of the first weight `[inputs, outputs]`; the biases `[outputs]` follow.
    pub(super) at: usize,
}

impl Layer {
    pub(super) fn bias_at(&self) -> usize {
        self.at + self.inputs * self.outputs
    }
    pub(super) fn end(&self) -> usize {
        self.bias_at() + self.outputs
    }
}

/// The number of latents for `width` coefficients: 24 for the 45 of degree 3, in proportion for other degrees.
pub(super) fn latents(width: usize) -> usize {
    (24 * width + 22) / 45
}

fn layers(widths: [usize; HALF + 1]) -> [Layer; HALF] {
    let mut at = 0;
    std::array::from_fn(|i| {
        let layer = Layer { inputs: widths[i], outputs: widths[i + 1], at };
        at = layer.end();
        layer
    })
}

/// The encoder's layers for `width` coefficients. The second hidden layer is wide enough for every latent and its negative (see `principal`).
pub(super) fn encoder(width: usize) -> [Layer; HALF] {
    layers([width + CONDITIONS, 128, 64.max(2 * latents(width)), latents(width)])
}

/// The decoder's layers for `width` coefficients.
pub(super) fn decoder(width: usize) -> [Layer; HALF] {
    layers([latents(width) + CONDITIONS, 128, 128, width])
}

/// The number of decoder parameters.
pub(super) fn decoder_len(width: usize) -> usize {
    decoder(width)[HALF - 1].end()
}

/// e^x in float32 from additions and multiplications alone (error below 2e-7), for x clamped to the finite range.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer, which is then in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    // ln 2 as a sum of two constants makes the remainder exact.
    let r = (x - k * 0.693_359_4) + k * 2.121_944_4e-4;
    let p = 1.0 + r * (1.0 + r * (0.5 + r * (0.166_666_66 + r * (0.041_666_66 + r * (8.333_452e-3 + r * 1.398_2e-3)))));
    p * f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000))
}

/// 2 sqrt(2/pi).
const SLOPE: f32 = 1.595_769;
const CUBIC: f32 = 0.044_715;

/// GELU (tanh form): x times the logistic function of 2 sqrt(2/pi) (x + 0.044715 x^3).
#[inline(always)]
pub(super) fn gelu(x: f32) -> f32 {
    x / (1.0 + exp(-SLOPE * (x + CUBIC * x * x * x)))
}

/// Applies [`gelu`] to `values` in place and writes its derivatives to `slopes`.
pub(super) fn gelu_with_slopes(values: &mut [f32], slopes: &mut [f32]) {
    for (v, slope) in values.iter_mut().zip(slopes) {
        let x = *v;
        let s = 1.0 / (1.0 + exp(-SLOPE * (x + CUBIC * x * x * x)));
        *slope = s + x * s * (1.0 - s) * SLOPE * (1.0 + 3.0 * CUBIC * x * x);
        *v = x * s;
    }
}

/// The decoder, with its weights in the layout of [`Decoder::run`].
pub(super) struct Decoder {
    layers: Vec<Packed>,
}

struct Packed {
    /// Blocks of LANES outputs: [block][input]`[lane]`.
    weights: Vec<[f32; LANES]>,
    bias: Vec<[f32; LANES]>,
    inputs: usize,
}

impl Decoder {
    /// Packs flat decoder parameters for `width` coefficients.
    pub(super) fn new(width: usize, parameters: &[f32]) -> Self {
        let pack = |layer: Layer| {
            let blocks = layer.outputs.div_ceil(LANES);
            let mut packed = Packed { weights: vec![[0.0; LANES]; blocks * layer.inputs], bias: vec![[0.0; LANES]; blocks], inputs: layer.inputs };
            for j in 0..layer.outputs {
                packed.bias[j / LANES][j % LANES] = parameters[layer.bias_at() + j];
                for i in 0..layer.inputs {
                    packed.weights[(j / LANES) * layer.inputs + i][j % LANES] = parameters[layer.at + i * layer.outputs + j];
                }
            }
            packed
        };
        Self { layers: decoder(width).map(pack).into() }
    }
    /// Coefficients of one Gaussian from `input` (latents, then conditions); `scratch` is reused between calls.
    pub(super) fn run(&self, input: &[f32], scratch: &mut Scratch, out: &mut [f32]) {
        scratch.from.clear();
        scratch.from.extend_from_slice(input);
        for (l, layer) in self.layers.iter().enumerate() {
            scratch.to.clear();
            for (block, bias) in layer.weights.chunks_exact(layer.inputs).zip(&layer.bias) {
                let mut sums = *bias;
                for (&x, weights) in scratch.from.iter().zip(block) {
                    for (sum, &w) in sums.iter_mut().zip(weights) {
                        *sum += x * w;
                    }
                }
                if l + 1 < HALF {
                    sums.iter_mut().for_each(|v| *v = gelu(*v));
                }
                scratch.to.extend_from_slice(&sums);
            }
            std::mem::swap(&mut scratch.from, &mut scratch.to);
        }
        out.copy_from_slice(&scratch.from[..out.len()]);
    }
}

/// Buffers of [`Decoder::run`].
#[derive(Default)]
pub(super) struct Scratch {
    from: Vec<f32>,
    to: Vec<f32>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_close_everywhere() {
        for i in -8700..=8800 {
            let x = i as f32 * 0.01;
            let exact = libm::exp(f64::from(x));
            assert!((f64::from(exp(x)) / exact - 1.0).abs() < 4e-7, "exp({x}) = {} against {exact}", exp(x));
        }
    }

    #[test]
    fn slopes_are_the_derivative() {
        for i in -60..=60 {
            let x = f64::from(i) * 0.1;
            let g = |x: f64| x * 0.5 * (1.0 + libm::tanh((2.0 / std::f64::consts::PI).sqrt() * (x + 0.044715 * x * x * x)));
            let mut value = [x as f32];
            let mut slope = [0.0];
            gelu_with_slopes(&mut value, &mut slope);
            assert!((f64::from(value[0]) - g(x)).abs() < 1e-6);
            assert!((value[0] - gelu(x as f32)).abs() < 1e-6, "training and inference agree at {x}");
            assert!((f64::from(slope[0]) - (g(x + 1e-5) - g(x - 1e-5)) / 2e-5).abs() < 1e-5, "slope at {x}");
        }
    }

    #[test]
    fn sizes_are_those_of_the_fact_sheet() {
        assert_eq!(latents(45), 24);
        assert_eq!(decoder_len(45), 27_053);
        assert_eq!([latents(9), latents(24), latents(72)], [5, 13, 38]);
    }
}
