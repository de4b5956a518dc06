//! A trunk of Linear + ReLU layers that feeds any number of heads, each Linear (ReLU, Linear)* with no activation at its end
//! (CC-4DGS, Section IV-B: the deformation network). A plain network is a trunk without heads or one head without a trunk.
//!
//! Weights are one flat array: per layer W `[in, out]` row-major (y = x W + b), then b `[out]`; the trunk first, then head by head.
//! The outputs are one flat array too, head after head, each `[rows, width]`; without heads, the trunk's output.

use super::matmul::{add_column_sums, add_transposed_matmul, fill_rows, matmul, transposed};
use super::{blocks_per_run, sum_in_order};
use crate::cpu::heads::row_blocks;
use crate::cpu::scratch::{Scratch, scratch};
use crate::cpu::simd::vectorized;
use cc4dgs_fields::networks::{Layer, ReluShape};
use rayon::prelude::*;

/// Rows per block.
pub const BLOCK: usize = 128;

/// What is not over 0 becomes 0, but NaN stays: it has to reach the loss, where the watchdog of a training finds it.
#[inline(always)]
fn relu(values: &mut [f32]) {
    for v in values {
        *v = if *v <= 0.0 { 0.0 } else { *v };
    }
}

#[inline(always)]
fn relu_backward(grad: &mut [f32], output: &[f32]) {
    for (g, o) in grad.iter_mut().zip(output) {
        *g = if *o <= 0.0 { 0.0 } else { *g };
    }
}

/// `values` with zeros behind, where they are fewer than `len`. Blocks are padded so that the result of a row does not depend on how many rows there are.
fn padded(values: &[f32], len: usize) -> Option<Scratch> {
    (values.len() < len).then(|| {
        let mut whole = scratch(len);
        whole[..values.len()].copy_from_slice(values);
        whole[values.len()..].fill(0.0);
        whole
    })
}

/// The outputs of the layers for one block `x` `[BLOCK, input]`: of all of them, or with `hidden` of those that end in a ReLU. No layer reads the others.
fn block_forward(layers: &[Layer], weights: &[f32], x: &[f32], outputs: &mut [Scratch], hidden: bool) {
    for (i, layer) in layers.iter().enumerate().filter(|(_, layer)| layer.relu || !hidden) {
        let (before, rest) = outputs.split_at_mut(i);
        let out: &mut [f32] = &mut rest[0];
        let input: &[f32] = layer.parent.map_or(x, |p| &before[p]);
        fill_rows(out, &weights[layer.bias.clone()]);
        matmul(out, input, &weights[layer.weight.clone()], (BLOCK, layer.input, layer.output), true);
        if layer.relu {
            vectorized(
                #[inline(always)]
                || relu(out),
            );
        }
    }
}

/// The flat outputs for `x` `[rows, input]`.
pub fn forward(shape: &ReluShape, weights: &[f32], x: &[f32]) -> Vec<f32> {
    let layers = shape.layers();
    let count = x.len() / shape.input.max(1);
    let widths = shape.output_widths();
    let mut out = vec![0.0f32; count * widths.iter().sum::<usize>()];
    if out.is_empty() {
        return out;
    }
    row_blocks(&mut out, &widths, count, BLOCK).into_par_iter().zip(x.par_chunks(BLOCK * shape.input)).for_each(|(mut outs, x)| {
        let count = x.len() / shape.input;
        let mut outputs: Vec<Scratch> = layers.iter().map(|l| scratch(BLOCK * l.output)).collect();
        block_forward(&layers, weights, padded(x, BLOCK * shape.input).as_deref().unwrap_or(x), &mut outputs, false);
        for (layer, output) in layers.iter().zip(&outputs) {
            if let Some(slot) = layer.slot {
                outs[slot].copy_from_slice(&output[..count * layer.output]);
            }
        }
    });
    out
}

/// The gradients `(x [rows, input], weights)` given that of the flat outputs; the first is empty unless `wants_input`.
/// Activations are recomputed instead of saved; the flat outputs are not needed.
pub fn backward(shape: &ReluShape, weights: &[f32], x: &[f32], grad: &[f32], wants_input: bool) -> (Vec<f32>, Vec<f32>) {
    let layers = shape.layers();
    let count = x.len() / shape.input.max(1);
    let mut grad_x = vec![0.0f32; if wants_input { x.len() } else { 0 }];
    if count == 0 {
        return (grad_x, vec![0.0; shape.parameter_count()]);
    }
    let back: Vec<Vec<f32>> = layers.iter().map(|l| transposed(&weights[l.weight.clone()], (l.input, l.output))).collect();
    let run = blocks_per_run(count.div_ceil(BLOCK)) * BLOCK;
    let mut unused = vec![0.0; if wants_input { 0 } else { count.div_ceil(run) }];
    let (sink, sink_run) = if wants_input { (grad_x.as_mut_slice(), run * shape.input) } else { (unused.as_mut_slice(), 1) };
    let job = |(i, (x, sink)): (usize, (&[f32], &mut [f32]))| {
        let mut total = vec![0.0f32; shape.parameter_count()];
        let mut outputs: Vec<Scratch> = layers.iter().map(|l| scratch(BLOCK * l.output)).collect();
        let mut grads: Vec<Scratch> = layers.iter().map(|l| scratch(BLOCK * l.output)).collect();
        for (b, x) in x.chunks(BLOCK * shape.input).enumerate() {
            let (rows, whole) = (x.len() / shape.input, padded(x, BLOCK * shape.input));
            let inputs = whole.as_deref().unwrap_or(x);
            block_forward(&layers, weights, inputs, &mut outputs, true);
            let first = i * run + b * BLOCK;
            load_output_grads(&layers, &mut grads, grad, count, first, rows);
            let sink = if wants_input { &mut sink[b * BLOCK * shape.input..][..x.len()] } else { &mut sink[..0] };
            match padded(sink, if wants_input { BLOCK * shape.input } else { 0 }) {
                Some(mut of_inputs) => {
                    block_backward(&layers, &back, inputs, &outputs, &mut grads, &mut total, &mut of_inputs);
                    sink.copy_from_slice(&of_inputs[..sink.len()]);
                }
                None => block_backward(&layers, &back, inputs, &outputs, &mut grads, &mut total, sink),
            }
        }
        total
    };
    let parts = x.par_chunks(run * shape.input).zip(sink.par_chunks_mut(sink_run)).enumerate().map(job).collect();
    (grad_x, sum_in_order(parts))
}

/// Sets the gradient of every layer's output: the given one where the layer is an output, zero elsewhere and behind the last of the `rows`.
fn load_output_grads(layers: &[Layer], grads: &mut [Scratch], grad: &[f32], count: usize, first: usize, rows: usize) {
    let mut at = 0;
    for (layer, own) in layers.iter().zip(grads) {
        let (given, behind) = own.split_at_mut(rows * layer.output);
        if layer.slot.is_some() {
            given.copy_from_slice(&grad[at + first * layer.output..][..given.len()]);
            at += count * layer.output;
        } else {
            given.fill(0.0);
        }
        behind.fill(0.0);
    }
}

fn block_backward(layers: &[Layer], back: &[Vec<f32>], x: &[f32], outputs: &[Scratch], grads: &mut [Scratch], total: &mut [f32], grad_x: &mut [f32]) {
    for (i, layer) in layers.iter().enumerate().rev() {
        let (before, rest) = grads.split_at_mut(i);
        let own: &mut [f32] = &mut rest[0];
        if layer.relu {
            vectorized(
                #[inline(always)]
                || relu_backward(own, &outputs[i]),
            );
        }
        let input: &[f32] = layer.parent.map_or(x, |p| &outputs[p]);
        add_transposed_matmul(&mut total[layer.weight.clone()], input, own, (BLOCK, layer.input, layer.output));
        vectorized(
            #[inline(always)]
            || add_column_sums(&mut total[layer.bias.clone()], own),
        );
        let target: &mut [f32] = match layer.parent {
            Some(p) => &mut before[p],
            None if grad_x.is_empty() => continue,
            None => &mut *grad_x,
        };
        // Layers are visited in one order, so sums over heads are fixed too.
        matmul(target, own, &back[i], (BLOCK, layer.output, layer.input), true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relu_hides_no_nan() {
        let mut values = [-1.0, -0.0, 0.0, 2.0, f32::NEG_INFINITY, f32::INFINITY, f32::NAN];
        relu(&mut values);
        assert_eq!(values[..6].iter().map(|v| v.to_bits()).collect::<Vec<u32>>(), [0.0, 0.0, 0.0, 2.0, 0.0, f32::INFINITY].map(f32::to_bits));
        assert!(values[6].is_nan());
        let mut grad = [3.0; 7];
        relu_backward(&mut grad, &values);
        assert_eq!(grad, [0.0, 0.0, 0.0, 3.0, 0.0, 3.0, 3.0]);
    }

    #[test]
    fn rows_do_not_depend_on_how_many_there_are() {
        let shape = ReluShape { input: 9, trunk: vec![33, 20], heads: vec![vec![24, 3], vec![11]] };
        let numbers = |count: usize, step: f32| (0..count).map(|k| (k as f32 * step).sin() * 0.4).collect::<Vec<f32>>();
        let most = 2 * BLOCK + 5;
        let (weights, x) = (numbers(shape.parameter_count(), 0.91), numbers(most * 9, 0.37));
        let (of_first, of_second) = (numbers(most * 3, 0.53), numbers(most * 11, 0.71));
        // Outputs of both heads, and the gradient of the input.
        let run = |rows: usize| {
            let (x, grad) = (&x[..rows * 9], [&of_first[..rows * 3], &of_second[..rows * 11]].concat());
            let outputs = forward(&shape, &weights, x);
            let (of_input, _) = backward(&shape, &weights, x, &grad, true);
            (outputs[..rows * 3].to_vec(), outputs[rows * 3..].to_vec(), of_input)
        };
        let whole = run(most);
        for rows in [1, 2, 7, 100, BLOCK, BLOCK + 1] {
            let (first, second, of_input) = run(rows);
            assert!(first == whole.0[..rows * 3] && second == whole.1[..rows * 11], "outputs of {rows} rows");
            assert!(of_input == whole.2[..rows * 9], "gradient of {rows} rows");
        }
    }

    #[test]
    fn what_no_layer_reads_is_left_out_where_it_is_not_wanted() {
        let heads = ReluShape { input: 9, trunk: vec![33, 20], heads: vec![vec![24, 3], vec![11]] };
        let trunk = ReluShape { input: 9, trunk: vec![33, 20], heads: Vec::new() };
        let numbers = |count: usize, step: f32| (0..count).map(|k| (k as f32 * step).sin() * 0.4).collect::<Vec<f32>>();
        for shape in [heads, trunk] {
            let layers = shape.layers();
            let (weights, x) = (numbers(shape.parameter_count(), 0.91), numbers(BLOCK * 9, 0.37));
            let run = |hidden: bool| {
                let mut outputs: Vec<Scratch> = layers.iter().map(|l| scratch(BLOCK * l.output)).collect();
                outputs.iter_mut().for_each(|output| output.fill(f32::MAX));
                block_forward(&layers, &weights, &x, &mut outputs, hidden);
                outputs.iter().map(|output| output.to_vec()).collect::<Vec<Vec<f32>>>()
            };
            for (layer, (all, hidden)) in layers.iter().zip(run(false).into_iter().zip(run(true))) {
                assert!(all.iter().all(|v| *v < f32::MAX), "{layer:?}");
                assert!(if layer.relu { hidden == all } else { hidden.iter().all(|v| *v == f32::MAX) }, "{layer:?}");
            }
        }
    }
}
