//! Hash signatures and the decoders behind them (Linear, LayerNorm, Mish per hidden layer), one row per vertex.

use super::activation::{mish, mish_derivative};
use super::gradients::{self, Rows, Sums};
use super::layers::{self, Dense};
use super::program::{Input, Program, SavedNorm, Step, Target, parts, scales};
use crate::cube::tensor::{THREADS, constant, floats, upload, workgroups_for};
use crate::ops::field::Decoder;
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_fields::hash::LevelHash;
use cc4dgs_fields::networks::{LAYER_NORM_EPSILON as EPSILON, MishLayer, MishShape};
use cubecl::prelude::*;

/// 2^31 - 1.
const P: u32 = 0x7fff_ffff;

/// Congruent to `v` modulo P: 2^31 = 1 there.
#[cube]
fn fold(v: u32) -> u32 {
    (v & P) + (v >> 31)
}

/// a x modulo P (or P itself) for a < 2^31 and x < 2^11: in halves of 16 bits, so that everything fits 32 bits.
#[cube]
fn product(a: u32, x: u32) -> u32 {
    let high = (a >> 16) * x;
    let low = (a & 0xffffu32) * x;
    // high 2^16 = (high / 2^15) 2^31 + (high mod 2^15) 2^16.
    fold(fold(((high & 0x7fffu32) << 16) + (high >> 15)) + low)
}

/// Entry `k` of the signature of a vertex of `vertices` `[U,3]`: ((A v + b) mod P) mod m, scaled to [-1, 1]; constants hold from `at` on A's three rows `[k]`
/// each, then b `[k]`.
#[cube]
pub fn signature(vertices: &[i32], constants: &[u32], at: usize, vertex: usize, k: usize, hashes: usize, modulus: u32, scale: f32) -> f32 {
    let mut sum = constants[at + 3 * hashes + k];
    #[unroll]
    for d in 0..3usize {
        sum = fold(sum + product(constants[at + d * hashes + k], vertices[3 * vertex + d] as u32));
    }
    let residue = select(sum >= P, sum - P, sum);
    (residue % modulus) as f32 * scale - 1.0
}

/// Signatures `[U,k]` of vertices `[U,3]`.
#[cube(launch)]
fn signatures(vertices: &[i32], constants: &[u32], out: &mut [f32], hashes: u32, modulus: u32, scale: f32) {
    if ABSOLUTE_POS < out.len() {
        let h = hashes as usize;
        out[ABSOLUTE_POS] = signature(vertices, constants, 0usize, ABSOLUTE_POS / h, ABSOLUTE_POS % h, h, modulus, scale);
    }
}

/// Mean and inverse deviation of a row of y `[_, n]`.
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

/// The derivative: d (of the output) becomes d of y; y becomes the normalised values; dz receives d of the value before Mish.
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
    let constants = constant(vertices, &hash.constants(), DType::U32);
    let client = vertices.client.clone();
    let (v, c, o) = (vertices.clone().into_buffer_arg(), constants.into_buffer_arg(), out.clone().into_buffer_arg());
    let scale = 2.0 / (hash.modulus() - 1) as f32;
    signatures::launch(&client, workgroups_for(rows * hashes), CubeDim::new_1d(THREADS), v, c, o, hashes as u32, hash.modulus(), scale);
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
        let l = dense(&layer);
        let y = floats(weights, [rows, layer.output]);
        layers::forward(&inputs[inputs.len() - 1], weights, &y, rows, l, 0, false);
        match layer.gain {
            Some(gain) => {
                let out = floats(weights, [rows, layer.output]);
                let (a, w, o) = (y.clone().into_buffer_arg(), weights.clone().into_buffer_arg(), out.clone().into_buffer_arg());
                norm_mish::launch(&client, workgroups_for(rows), CubeDim::new_1d(THREADS), a, w, o, rows as u32, layer.output as u32, gain.start as u32);
                before_norm.push(y);
                inputs.push(out);
            }
            None => output = y,
        }
    }
    Pass { inputs, before_norm, output }
}

fn dense(layer: &MishLayer) -> Dense {
    Dense { input: layer.input, output: layer.output, at: layer.weight.start }
}

fn multiply(layer: &MishLayer, target: Target) -> Step {
    let (input, output, weights) = (layer.input, layer.output, layer.weight.start);
    Step::Multiply { source: 0, target, input, output, weights, bias: Some(layer.bias.start), relu: false, add: false }
}

/// Number of rows of a plan that is made for its widths alone.
const ANY_ROWS: usize = 16;

/// The steps forwards.
fn forwards(decoder: &Decoder) -> Program {
    let mut steps = Vec::new();
    for layer in decoder.shape.layers() {
        match &layer.gain {
            Some(gain) => {
                let norm = Step::Norm { tile: 0, width: layer.output, gain: gain.start, save: None };
                steps.extend([multiply(&layer, Target::Tile(0)), norm]);
            }
            None => steps.push(multiply(&layer, Target::Out(0))),
        }
    }
    Program(steps)
}

/// Floats per vertex of the largest array that the kernels bind, forwards or backwards, on a device with so much shared memory.
pub fn widest_row(decoder: &Decoder, shared_bytes: usize) -> usize {
    let fits = |program: Program| program.layout(decoder.hash.len(), ANY_ROWS, shared_bytes).is_some();
    if fits(forwards(decoder)) && fits(plan(&decoder.shape.layers(), ANY_ROWS).program) {
        return decoder.shape.output;
    }
    // Layer by layer, signatures and each layer have an array.
    decoder.shape.widest()
}

/// Features `[U, F]` of `vertices` `[U,3]`.
pub fn forward(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder) -> CubeTensor {
    let rows = vertices.meta.shape()[0];
    let program = forwards(decoder);
    let Some(layout) = program.layout_on(weights, decoder.hash.len(), rows) else { return run(weights, vertices, decoder, rows).output };
    let out = floats(weights, [rows, decoder.shape.output]);
    program.run(layout, Input::Signatures(vertices, &decoder.hash), weights, weights, &out, &(0..rows));
    out
}

/// Where a layer's input, normalised values, and gradients before Mish and before the norm are saved.
#[derive(Clone, Copy, Default)]
struct Saved {
    input: usize,
    normal: usize,
    before_mish: usize,
    before_norm: usize,
}

/// The steps forwards and backwards, and where in the output buffer each layer's values are saved.
struct Plan {
    program: Program,
    /// By layer.
    saved: Vec<Saved>,
    /// Length of the output buffer.
    floats: usize,
}

/// The plan for `rows` rows.
fn plan(layers: &[MishLayer], rows: usize) -> Plan {
    let mut end = 0;
    let mut take = |floats: usize| {
        end += floats;
        end - floats
    };
    let transposed = layers.last().map_or(0, |l| l.bias.end);
    let (mut steps, mut back, mut saved_by_layer) = (Vec::new(), Vec::new(), Vec::new());
    for (i, layer) in layers.iter().enumerate() {
        let mut own = Saved { input: take(rows * layer.input), ..Saved::default() };
        steps.push(Step::Save { tile: 0, width: layer.input, at: own.input });
        let width = layer.output;
        if i > 0 {
            // `back` is reversed below: backwards, this step comes before those of the layer in front.
            let (weights, target) = (transposed + layer.weight.start, Target::Tile(0));
            back.push(Step::Multiply { source: 0, target, input: width, output: layer.input, weights, bias: None, relu: false, add: false });
        }
        match &layer.gain {
            Some(gain) => {
                let scale = take(scales(rows));
                own = Saved { normal: take(rows * width), before_mish: take(rows * width), before_norm: take(rows * width), ..own };
                let saved = SavedNorm { normal: own.normal, scale };
                steps.extend([multiply(layer, Target::Tile(0)), Step::Norm { tile: 0, width, gain: gain.start, save: Some(saved) }]);
                back.push(Step::NormBack { tile: 0, width, gain: gain.start, saved, before: own.before_mish, after: own.before_norm });
            }
            None => back.push(Step::Load { tile: 0, columns: 0..width, width, at: 0 }),
        }
        saved_by_layer.push(own);
    }
    steps.extend(back.into_iter().rev());
    Plan { program: Program(steps), saved: saved_by_layer, floats: end }
}

/// The gradient of the flat weights from that of the features. Activations are recomputed instead of saved.
pub fn backward(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder, grad: &CubeTensor) -> CubeTensor {
    let rows = vertices.meta.shape()[0];
    let count = MishShape::parameter_count(&decoder.shape);
    if rows == 0 {
        return upload(weights, &vec![0.0f32; count], DType::F32);
    }
    let layers = decoder.shape.layers();
    let Some(layout) = plan(&layers, rows).program.layout_on(weights, decoder.hash.len(), rows) else {
        return layer_by_layer(weights, vertices, decoder, grad.clone(), rows);
    };
    let gradient = floats(weights, [count]);
    let all: Vec<Dense> = layers.iter().map(dense).collect();
    let both = gradients::with_transposed(weights, &all);
    for part in parts(weights, rows, plan(&layers, ANY_ROWS).floats.div_ceil(ANY_ROWS)) {
        let Plan { program, saved, floats: length } = plan(&layers, part.len());
        let buffer = &floats(weights, [length]);
        program.run(layout, Input::Signatures(vertices, &decoder.hash), &both, grad, buffer, &part);
        let sums = Sums { gradient: &gradient, rows: part.len(), add: part.start > 0, listed: Some((vertices, part.start)) };
        let own = |at| Rows { buffer, at };
        for ((layer, &l), saved) in layers.iter().zip(&all).zip(saved) {
            let dy = match &layer.gain {
                Some(gain) => {
                    sums.of_norm(own(saved.before_mish), own(saved.normal), l.output, gain.start);
                    own(saved.before_norm)
                }
                None => Rows { buffer: grad, at: part.start * l.output },
            };
            sums.of_layer(own(saved.input), dy, l);
        }
    }
    gradient
}

/// As [`backward`], for networks that are too wide for a program.
fn layer_by_layer(weights: &CubeTensor, vertices: &CubeTensor, decoder: &Decoder, grad: CubeTensor, rows: usize) -> CubeTensor {
    let gradient = floats(weights, [MishShape::parameter_count(&decoder.shape)]);
    let pass = run(weights, vertices, decoder, rows);
    let client = weights.client.clone();
    // Every row is computed, whether it holds a vertex or not; no gradient comes to those that do not.
    let sums = Sums { gradient: &gradient, rows, add: false, listed: None };
    let mut d = grad;
    for (i, layer) in decoder.shape.layers().iter().enumerate().rev() {
        if let Some(gain) = &layer.gain {
            let dz = floats(weights, [rows, layer.output]);
            d = crate::cube::tensor::owned(d);
            norm_mish_backward::launch(
                &client,
                workgroups_for(rows),
                CubeDim::new_1d(THREADS),
                pass.before_norm[i].clone().into_buffer_arg(),
                weights.clone().into_buffer_arg(),
                d.clone().into_buffer_arg(),
                dz.clone().into_buffer_arg(),
                rows as u32,
                layer.output as u32,
                gain.start as u32,
            );
            sums.of_norm(Rows::whole(&dz), Rows::whole(&pass.before_norm[i]), layer.output, gain.start);
        }
        let l = dense(layer);
        sums.of_layer(Rows::whole(&pass.inputs[i]), Rows::whole(&d), l);
        if i > 0 {
            let dx = floats(weights, [rows, layer.input]);
            layers::backward_input(&d, weights, &dx, rows, l, false);
            d = dx;
        }
    }
    gradient
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;

    #[test]
    fn decoders_too_wide_for_the_shared_memory_have_an_array_per_layer() {
        let widest = |hidden: &[usize], shared_bytes: usize| {
            let shape = MishShape { input: 128, hidden: hidden.to_vec(), output: 32 };
            widest_row(&Decoder { hash: LevelHash::new(Seed::root(1), 128, 1000), shape }, shared_bytes)
        };
        assert_eq!((widest(&[128, 128], 48 << 10), widest(&[128, 128], 8 << 10), widest(&[4096, 16], 48 << 10)), (32, 128, 4096));
    }
}
