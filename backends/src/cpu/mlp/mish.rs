//! The hash-feature decoder's network: (Linear, LayerNorm, Mish) for each hidden layer, then Linear (CC-4DGS, Section IV-B).
//!
//! Weights are one flat array. Per hidden layer: W `[in, out]` row-major (y = x W + b), b `[out]`, LayerNorm gain `[out]`, shift `[out]`; then W and b
//! of the output layer. Rows are processed in blocks of a fixed, padded size, so that the result of a row does not depend on which rows
//! it is computed with.

use super::activation::{affine_mish_backward, affine_mish_rows, normalize_rows};
use super::matmul::{add_column_sums, add_transposed_matmul, fill_rows, matmul, transposed};
use super::{blocks_per_run, sum_in_order};
use crate::cpu::scratch::{Scratch, scratch};
use crate::cpu::simd::vectorized;
use cc4dgs_fields::networks::{MishLayer, MishShape};
use rayon::prelude::*;

/// Rows per block.
pub const BLOCK: usize = 128;

/// Writes the input rows of a block: the first row's index and the rows to fill.
pub type RowSource<'a> = dyn Fn(usize, &mut [f32]) + Sync + 'a;

/// The activations of one block.
struct Block {
    input: Scratch,
    /// Per hidden layer: normalised values, inverse deviations, activations.
    hidden: Vec<(Scratch, Scratch, Scratch)>,
    output: Scratch,
    work: Scratch,
}

impl Block {
    fn new(shape: &MishShape) -> Self {
        let hidden = shape.hidden.iter().map(|&h| (scratch(BLOCK * h), scratch(BLOCK), scratch(BLOCK * h))).collect();
        Self { input: scratch(BLOCK * shape.input), hidden, output: scratch(BLOCK * shape.output), work: scratch(shape.widest()) }
    }
    /// Fills the input with `count` rows and zeros, and computes `layers`: all of them, or those before the last.
    fn forward(&mut self, layers: &[MishLayer], weights: &[f32], rows: &RowSource, first: usize, count: usize) {
        let width = self.input.len() / BLOCK;
        rows(first, &mut self.input[..count * width]);
        self.input[count * width..].fill(0.0);
        let mut input: &[f32] = &self.input;
        let mut hidden = self.hidden.iter_mut();
        for layer in layers {
            let (w, b) = (&weights[layer.weight.clone()], &weights[layer.bias.clone()]);
            let size = (BLOCK, layer.input, layer.output);
            match (&layer.gain, &layer.shift, hidden.next()) {
                (Some(gain), Some(shift), Some((normalized, inverse_std, activated))) => {
                    fill_rows(normalized, b);
                    matmul(normalized, input, w, size, true);
                    vectorized(
                        #[inline(always)]
                        || {
                            normalize_rows(normalized, layer.output, inverse_std, &mut self.work);
                            affine_mish_rows(activated, normalized, &weights[gain.clone()], &weights[shift.clone()]);
                        },
                    );
                    input = activated;
                }
                _ => {
                    fill_rows(&mut self.output, b);
                    matmul(&mut self.output, input, w, size, true);
                }
            }
        }
    }
}

/// The outputs `[rows, output]` of the network for `count` rows.
pub fn forward(shape: &MishShape, weights: &[f32], count: usize, rows: &RowSource) -> Vec<f32> {
    let layers = shape.layers();
    let mut out = vec![0.0f32; count * shape.output];
    if out.is_empty() {
        return out;
    }
    out.par_chunks_mut(BLOCK * shape.output).enumerate().for_each(|(i, out)| {
        let mut block = Block::new(shape);
        block.forward(&layers, weights, rows, i * BLOCK, out.len() / shape.output);
        out.copy_from_slice(&block.output[..out.len()]);
    });
    out
}

/// The gradient of the weights given `grad` `[rows, output]`, and, if `input_grad` `[rows, input]` is given, the gradient of the inputs.
/// Activations are recomputed instead of saved: at these widths that is cheaper than writing and reading them. The outputs are not needed.
pub fn backward(shape: &MishShape, weights: &[f32], count: usize, rows: &RowSource, grad: &[f32], input_grad: Option<&mut [f32]>) -> Vec<f32> {
    let layers = shape.layers();
    if count == 0 {
        return vec![0.0; shape.parameter_count()];
    }
    let back: Vec<Vec<f32>> = layers.iter().map(|l| transposed(&weights[l.weight.clone()], (l.input, l.output))).collect();
    let run = blocks_per_run(count.div_ceil(BLOCK)) * BLOCK;
    let wants_input = input_grad.is_some();
    let mut unused = vec![0.0; if wants_input { 0 } else { count.div_ceil(run) }];
    let (sink, sink_run) = match input_grad {
        Some(sink) => (sink, run * shape.input),
        None => (unused.as_mut_slice(), 1),
    };
    let job = |(i, (grad, sink)): (usize, (&[f32], &mut [f32]))| {
        let mut total = vec![0.0f32; shape.parameter_count()];
        let mut block = Block::new(shape);
        let mut g = [scratch(BLOCK * shape.widest()), scratch(BLOCK * shape.widest())];
        for (b, grad) in grad.chunks(BLOCK * shape.output).enumerate() {
            let count = grad.len() / shape.output;
            block.forward(&layers[..shape.hidden.len()], weights, rows, i * run + b * BLOCK, count);
            g[0][..grad.len()].copy_from_slice(grad);
            g[0][grad.len()..BLOCK * shape.output].fill(0.0);
            block_backward(&layers, weights, &back, &mut block, &mut g, &mut total, wants_input);
            if wants_input {
                let from = b * BLOCK * shape.input;
                sink[from..from + count * shape.input].copy_from_slice(&g[0][..count * shape.input]);
            }
        }
        total
    };
    let parts = grad.par_chunks(run * shape.output).zip(sink.par_chunks_mut(sink_run)).enumerate().map(job).collect();
    sum_in_order(parts)
}

/// `g[0]` holds the gradient of the block's output and ends as that of its input (if requested); `total` is added to.
fn block_backward(layers: &[MishLayer], weights: &[f32], back: &[Vec<f32>], block: &mut Block, g: &mut [Scratch; 2], total: &mut [f32], wants_input: bool) {
    for (i, layer) in layers.iter().enumerate().rev() {
        let len = BLOCK * layer.output;
        if let (Some(gain), Some(shift)) = (&layer.gain, &layer.shift) {
            let (normalized, inverse_std, _) = &block.hidden[i];
            let affine = (&weights[gain.clone()], &weights[shift.clone()]);
            // Gain and shift are neighbours in the flat array.
            let (grad_gain, grad_shift) = total[gain.start..shift.end].split_at_mut(layer.output);
            vectorized(
                #[inline(always)]
                || affine_mish_backward(&mut g[0][..len], normalized, inverse_std, affine, (grad_gain, grad_shift), &mut block.work),
            );
        }
        let input: &[f32] = if i == 0 { &block.input } else { &block.hidden[i - 1].2 };
        add_transposed_matmul(&mut total[layer.weight.clone()], input, &g[0], (BLOCK, layer.input, layer.output));
        vectorized(
            #[inline(always)]
            || add_column_sums(&mut total[layer.bias.clone()], &g[0][..len]),
        );
        if i > 0 || wants_input {
            let [from, to] = g;
            matmul(to, from, &back[i], (BLOCK, layer.output, layer.input), false);
            g.swap(0, 1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_output_layer_is_left_out_where_it_is_not_wanted() {
        let shape = MishShape { input: 7, hidden: vec![12, 9], output: 5 };
        let (layers, count) = (shape.layers(), shape.parameter_count());
        let weights: Vec<f32> = (0..count).map(|k| (k as f32 * 0.7).sin()).collect();
        let rows = |first: usize, out: &mut [f32]| out.iter_mut().enumerate().for_each(|(k, v)| *v = ((7 * first + k) as f32 * 0.3).sin());
        let run = |layers: &[MishLayer]| {
            let mut block = Block::new(&shape);
            block.output.fill(f32::MAX);
            block.forward(layers, &weights, &rows, 0, BLOCK);
            (block.hidden[1].2.to_vec(), block.output.to_vec())
        };
        let (all, hidden) = (run(&layers), run(&layers[..2]));
        assert!(all.1.iter().all(|v| *v < f32::MAX) && hidden.1.iter().all(|v| *v == f32::MAX));
        assert!(all.0 == hidden.0 && all.0.iter().any(|v| *v != 0.0));
    }
}
