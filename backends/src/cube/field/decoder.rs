//! Hash signatures and the decoders behind them (Linear, LayerNorm, Mish per hidden layer), one row per vertex.

use super::layers::{self, Dense};
use super::program::{Input, Place, Program, Step};
use crate::cpu::vertex::hash::LevelHash;
use crate::cube::tensor::{UNITS, cubes_for, floats, upload};
use crate::ops::field::{Decoder, MishShape};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// 2^31 - 1.
const P: u32 = 0x7fff_ffff;
/// Added to variances.
pub const EPSILON: f32 = 1e-5;

/// Congruent to `v` modulo P: 2^31 = 1 there.
#[cube]
fn fold(v: u32) -> u32 {
    (v & P) + (v >> 31)
}

/// a x modulo P (or P itself) for a < 2^31 and x < 2^11: in halves of 16 bits, so that nothing leaves 32 bits.
#[cube]
fn product(a: u32, x: u32) -> u32 {
    let high = (a >> 16) * x;
    let low = (a & 0xffffu32) * x;
    // high 2^16 = (high / 2^15) 2^31 + (high mod 2^15) 2^16.
    fold(fold(((high & 0x7fffu32) << 16) + (high >> 15)) + low)
}

/// Number `k` of the signature of a vertex of `vertices` [U,3]: ((A v + b) mod P) mod m, scaled to [-1, 1]; constants hold A's three rows [k] each, then b [k].
#[cube]
pub fn signature(vertices: &[i32], constants: &[u32], vertex: usize, k: usize, hashes: usize, modulus: u32, scale: f32) -> f32 {
    let mut sum = constants[3 * hashes + k];
    #[unroll]
    for d in 0..3usize {
        sum = fold(sum + product(constants[d * hashes + k], vertices[3 * vertex + d] as u32));
    }
    let residue = select(sum >= P, sum - P, sum);
    (residue % modulus) as f32 * scale - 1.0
}

/// Signatures [U,k] of vertices [U,3].
#[cube(launch)]
fn signatures(vertices: &[i32], constants: &[u32], out: &mut [f32], hashes: u32, modulus: u32, scale: f32) {
    if ABSOLUTE_POS < out.len() {
        let h = hashes as usize;
        out[ABSOLUTE_POS] = signature(vertices, constants, ABSOLUTE_POS / h, ABSOLUTE_POS % h, h, modulus, scale);
    }
}

/// e^x - 1 cannot cancel here: with w = e^x, tanh(ln(1 + w)) = (w^2 + 2 w) / (w^2 + 2 w + 2).
#[cube]
pub fn mish(x: f32) -> f32 {
    // Beyond 20 the factor is 1 to float32.
    let w = select(x < 20.0, x, 20.0f32).exp();
    let n = w * (w + 2.0);
    x * (n / (n + 2.0))
}

#[cube]
fn mish_derivative(x: f32) -> f32 {
    let w = select(x < 20.0, x, 20.0f32).exp();
    let n = w * (w + 2.0);
    let t = n / (n + 2.0);
    // d tanh(softplus) = (1 - t^2) sigmoid; 1 - t^2 = 4 (n + 1) / (n + 2)^2.
    let slope = 4.0 * (n + 1.0) / ((n + 2.0) * (n + 2.0)) * (w / (1.0 + w));
    t + x * select(x < 20.0, slope, 0.0f32)
}

/// Mean and inverse deviation of a row of y [_, n].
#[cube]
fn statistics(y: &[f32], row: usize, n: usize) -> (f32, f32) {
    let width = n as f32;
    let mut mean = 0.0f32;
    for i in 0..n {
        mean += y[row * n + i];
    }
    mean /= width;
    let mut variance = 0.0f32;
    for i in 0..n {
        let d = y[row * n + i] - mean;
        variance += d * d;
    }
    (mean, 1.0 / (variance / width + EPSILON).sqrt())
}

/// Rows of y become mish(gain (y - mean) / deviation + shift), in `out`.
#[cube(launch)]
fn norm_mish(y: &[f32], weights: &[f32], out: &mut [f32], rows: u32, width: u32, gain: u32) {
    let row = ABSOLUTE_POS;
    if row < rows as usize {
        let n = width as usize;
        let (mean, inverse) = statistics(y, row, n);
        for i in 0..n {
            let z = (y[row * n + i] - mean) * inverse * weights[gain as usize + i] + weights[gain as usize + n + i];
            out[row * n + i] = mish(z);
        }
    }
}

/// The way back: d (of the output) becomes d of y; y becomes the normalised values; dz receives d of the value before Mish.
#[cube(launch)]
fn norm_mish_backward(y: &mut [f32], weights: &[f32], d: &mut [f32], dz: &mut [f32], rows: u32, width: u32, gain: u32) {
    let row = ABSOLUTE_POS;
    if row < rows as usize {
        let n = width as usize;
        let (mean, inverse) = statistics(&*y, row, n);
        let mut sum = 0.0f32;
        let mut along = 0.0f32;
        for i in 0..n {
            let normal = (y[row * n + i] - mean) * inverse;
            let g = weights[gain as usize + i];
            let before = d[row * n + i] * mish_derivative(normal * g + weights[gain as usize + n + i]);
            y[row * n + i] = normal;
            dz[row * n + i] = before;
            sum += before * g;
            along += before * g * normal;
        }
        sum /= width as f32;
        along /= width as f32;
        for i in 0..n {
            d[row * n + i] = inverse * (dz[row * n + i] * weights[gain as usize + i] - sum - y[row * n + i] * along);
        }
    }
}

fn signature_rows(vertices: &CubeTensor, hash: &LevelHash, rows: usize) -> CubeTensor {
    let hashes = hash.len();
    let out = floats(vertices, [rows * hashes]);
    let constants = upload(vertices, &hash.constants(), DType::U32);
    let client = vertices.client.clone();
    let (v, c, o) = (vertices.clone().into_buffer_arg(), constants.into_buffer_arg(), out.clone().into_buffer_arg());
    let scale = 2.0 / (hash.modulus() - 1) as f32;
    signatures::launch(&client, cubes_for(rows * hashes), CubeDim::new_1d(UNITS), v, c, o, hashes as u32, hash.modulus(), scale);
    out
}

/// Inputs of every layer, and the values before the norm of every hidden one.
struct Pass {
    inputs: Vec<CubeTensor>,
    before_norm: Vec<CubeTensor>,
    output: CubeTensor,
}

fn run(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder, rows: usize) -> Pass {
    let client = weights.client.clone();
    let mut inputs = vec![signature_rows(vertices, &decoder.hash, rows)];
    let mut before_norm = Vec::new();
    let mut output = inputs[0].clone();
    for layer in decoder.shape.layers() {
        let l = Dense { input: layer.input, output: layer.output, at: layer.weight.start };
        let y = floats(weights, [rows, layer.output]);
        layers::forward(&inputs[inputs.len() - 1], weights, &y, rows, l, 0, false);
        match layer.gain {
            Some(gain) => {
                let out = floats(weights, [rows, layer.output]);
                let (a, w, o) = (y.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), out.clone().into_buffer_arg());
                norm_mish::launch(&client, cubes_for(rows), CubeDim::new_1d(UNITS), a, w, o, rows as u32, layer.output as u32, gain.start as u32);
                before_norm.push(y);
                inputs.push(out);
            }
            None => output = y,
        }
    }
    Pass { inputs, before_norm, output }
}

/// Features [U, F] of `vertices` [U,3].
pub fn forward(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder) -> CubeTensor {
    let rows = vertices.meta.shape()[0];
    let out = floats(weights, [rows, decoder.shape.output]);
    let layers = decoder.shape.layers().into_iter().map(|layer| Step {
        input: layer.input,
        output: layer.output,
        weights: layer.weight.start,
        norm: layer.gain.as_ref().map(|gain| gain.start),
        relu: false,
        source: Place::First,
        target: if layer.gain.is_some() { Place::First } else { Place::Output(0) },
    });
    let done = Program(layers.collect()).run(&Input::Signatures(vertices, &decoder.hash), weights, &out, rows);
    if done { out } else { run(weights, vertices, decoder, rows).output }
}

/// The gradient of the flat weights from that of the features. Activations are computed again rather than kept.
pub fn backward(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder, grad: CubeTensor) -> CubeTensor {
    let rows = vertices.meta.shape()[0];
    let count = MishShape::parameter_count(&decoder.shape);
    if rows == 0 {
        return upload(weights, &vec![0.0f32; count], DType::F32);
    }
    let gradient = floats(weights, [count]);
    let pass = run(weights, vertices, decoder, rows);
    let client = weights.client.clone();
    let mut d = grad;
    for (i, layer) in decoder.shape.layers().iter().enumerate().rev() {
        if let Some(gain) = &layer.gain {
            let dz = floats(weights, [rows, layer.output]);
            d = crate::cube::tensor::owned(d);
            norm_mish_backward::launch(
                &client,
                cubes_for(rows),
                CubeDim::new_1d(UNITS),
                pass.before_norm[i].clone().into_buffer_arg(),
                weights.clone().into_buffer_arg(),
                d.clone().into_buffer_arg(),
                dz.clone().into_buffer_arg(),
                rows as u32,
                layer.output as u32,
                gain.start as u32,
            );
            layers::backward_norm(&dz, &pass.before_norm[i], &gradient, rows, layer.output, gain.start);
        }
        let l = Dense { input: layer.input, output: layer.output, at: layer.weight.start };
        layers::backward_weights(&pass.inputs[i], &d, &gradient, rows, l);
        if i > 0 {
            let dx = floats(weights, [rows, layer.input]);
            layers::backward_input(&d, weights, &dx, rows, l, false);
            d = dx;
        }
    }
    gradient
}
