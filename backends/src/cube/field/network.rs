//! Trunk and heads of Linear + ReLU layers.

use super::layers::{self, Dense};
use super::program::{Input, Place, Program, Step};
use crate::cpu::mlp::relu::ReluShape;
use crate::cube::tensor::{floats, upload};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;

/// The outputs of all layers; those that leave the network lie in the flat result at the given place instead.
fn run(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape, rows: usize) -> (Vec<CubeTensor>, CubeTensor) {
    let widths = shape.output_widths();
    let flat = floats(x, [rows * widths.iter().sum::<usize>()]);
    let mut outputs: Vec<CubeTensor> = Vec::new();
    for layer in shape.layers() {
        let input = layer.parent.map_or(x, |p| &outputs[p]).clone();
        let l = Dense { input: layer.input, output: layer.output, at: layer.weight.start };
        let (y, at) = match layer.slot {
            Some(slot) => (flat.clone(), rows * widths[..slot].iter().sum::<usize>()),
            None => (floats(x, [rows, layer.output]), 0),
        };
        layers::forward(&input, weights, &y, rows, l, at, layer.relu);
        outputs.push(y);
    }
    (outputs, flat)
}

/// Flat outputs, head after head.
pub fn forward(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape) -> CubeTensor {
    let rows = x.meta.shape()[0];
    let widths = shape.output_widths();
    let flat = floats(x, [rows * widths.iter().sum::<usize>()]);
    let mut steps: Vec<Step> = Vec::new();
    for (i, layer) in shape.layers().into_iter().enumerate() {
        let target = match layer.slot {
            Some(slot) => Place::Output(rows * widths[..slot].iter().sum::<usize>()),
            // The trunk's last values are read by every head, so heads work in the other tile.
            None if i < shape.trunk.len() => Place::First,
            None => Place::Second,
        };
        let source = layer.parent.map_or(Place::First, |parent| steps[parent].target);
        steps.push(Step { input: layer.input, output: layer.output, weights: layer.weight.start, norm: None, relu: layer.relu, source, target });
    }
    if Program(steps).run(&Input::Rows(x), weights, &flat, rows) { flat } else { run(x, weights, shape, rows).1 }
}

/// Gradients of the input, if wanted, and of the flat weights from that of the flat outputs.
pub fn backward(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape, grad: &CubeTensor, wants_input: bool) -> (Option<CubeTensor>, CubeTensor) {
    let rows = x.meta.shape()[0];
    let count = shape.parameter_count();
    if rows == 0 {
        return (wants_input.then(|| floats(x, x.meta.shape().clone())), upload(weights, &vec![0.0f32; count], DType::F32));
    }
    let gradient = floats(weights, [count]);
    let (outputs, flat) = run(x, weights, shape, rows);
    let widths = shape.output_widths();
    let all = shape.layers();
    // d of each layer's output, once a child has added to it.
    let mut of_output: Vec<Option<CubeTensor>> = vec![None; all.len()];
    let mut of_input: Option<CubeTensor> = None;
    for (i, layer) in all.iter().enumerate().rev() {
        let mut d = of_output[i].take();
        if let Some(slot) = layer.slot {
            let (at, len) = (rows * widths[..slot].iter().sum::<usize>(), rows * layer.output);
            let own = layers::stretch(grad, at, len);
            if layer.relu {
                layers::backward_relu(&own, &layers::stretch(&flat, at, len), len);
            }
            d = Some(own);
        } else if let Some(d) = &d
            && layer.relu
        {
            layers::backward_relu(d, &outputs[i], rows * layer.output);
        }
        // A layer whose output nobody reads has no gradient, and no such layer exists: every chain ends in an output.
        let Some(d) = d else { continue };
        let input = layer.parent.map_or(x, |p| &outputs[p]);
        let l = Dense { input: layer.input, output: layer.output, at: layer.weight.start };
        layers::backward_weights(input, &d, &gradient, rows, l);
        let target = match layer.parent {
            Some(parent) => &mut of_output[parent],
            None if wants_input => &mut of_input,
            None => continue,
        };
        let fresh = target.is_none();
        let dx = target.get_or_insert_with(|| floats(x, [rows, layer.input]));
        layers::backward_input(&d, weights, dx, rows, l, !fresh);
    }
    (of_input, gradient)
}
