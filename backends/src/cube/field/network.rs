//! Trunk and heads of Linear + ReLU layers.

use super::gradients::{self, Rows, Sums};
use super::layers::{self, Dense};
use super::program::{Input, Program, Step, Target, parts};
use crate::cube::tensor::{floats, upload};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_fields::networks::{Layer, ReluShape};

fn dense(layer: &Layer) -> Dense {
    Dense { input: layer.input, output: layer.output, at: layer.weight.start }
}

/// The outputs of all layers; those of the network are parts of the flat result instead.
fn run(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape, rows: usize) -> (Vec<CubeTensor>, CubeTensor) {
    let widths = shape.output_widths();
    let flat = floats(x, [rows * widths.iter().sum::<usize>()]);
    let mut outputs: Vec<CubeTensor> = Vec::new();
    for layer in shape.layers() {
        let input = layer.parent.map_or(x, |p| &outputs[p]).clone();
        let (y, at) = match layer.slot {
            Some(slot) => (flat.clone(), rows * widths[..slot].iter().sum::<usize>()),
            None => (floats(x, [rows, layer.output]), 0),
        };
        layers::forward(&input, weights, &y, rows, dense(&layer), at, layer.relu);
        outputs.push(y);
    }
    (outputs, flat)
}

/// Trunk and heads as steps: the trunk works in one tile, heads in another, because every head reads the output of the trunk.
struct Tree {
    layers: Vec<Layer>,
    /// Where each layer's output starts among the flat outputs, if it is one.
    slots: Vec<Option<usize>>,
    trunk: usize,
    weights: usize,
}

const TRUNK: usize = 0;
const HEAD: usize = 1;
/// Number of rows of a plan that is made for its widths alone.
const ANY_ROWS: usize = 16;

impl Tree {
    fn new(shape: &ReluShape, rows: usize) -> Self {
        let (layers, widths) = (shape.layers(), shape.output_widths());
        let slots = layers.iter().map(|l| l.slot.map(|slot| rows * widths[..slot].iter().sum::<usize>())).collect();
        Self { layers, slots, trunk: shape.trunk.len(), weights: shape.parameter_count() }
    }
    fn tile(&self, layer: usize) -> usize {
        if layer < self.trunk { TRUNK } else { HEAD }
    }
    fn forward(&self, i: usize, target: Target) -> Step {
        let l = &self.layers[i];
        let source = l.parent.map_or(TRUNK, |p| self.tile(p));
        Step::Multiply { source, target, input: l.input, output: l.output, weights: l.weight.start, bias: Some(l.bias.start), relu: l.relu, add: false }
    }
    /// All layers.
    fn forwards(&self) -> Program {
        let step = |i: usize| self.forward(i, self.slots[i].map_or(Target::Tile(self.tile(i)), Target::Out));
        Program((0..self.layers.len()).map(step).collect())
    }
    /// From the gradient of layer `i`'s output, of which the source tile holds some columns, to that of its input.
    fn backward(&self, i: usize, source: usize, columns: std::ops::Range<usize>, target: Target, add: bool) -> Step {
        let l = &self.layers[i];
        let weights = self.weights + l.weight.start + columns.start * l.input;
        Step::Multiply { source, target, input: columns.len(), output: l.input, weights, bias: None, relu: false, add }
    }
    /// The widest row in shared memory: outputs are written to global memory, and their gradients are loaded in pieces.
    fn widest_inside(&self) -> usize {
        self.layers.iter().map(|l| l.input).max().unwrap_or(1)
    }
}

/// Floats per row of the largest array that the kernels bind, forwards or backwards, on a device with so much shared memory.
pub fn widest_row(shape: &ReluShape, shared_bytes: usize) -> usize {
    let tree = Tree::new(shape, ANY_ROWS);
    let ends = shape.output_widths().iter().sum::<usize>().max(shape.input);
    let fits = |program: Program| program.layout(shape.input, ANY_ROWS, shared_bytes).is_some();
    if fits(tree.forwards()) && fits(plan(&tree, ANY_ROWS, true).program) {
        return ends;
    }
    // Layer by layer, each of them has an array.
    tree.layers.iter().map(|l| l.output).fold(ends, usize::max)
}

/// Flat outputs, head after head.
pub fn forward(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape) -> CubeTensor {
    let rows = x.meta.shape()[0];
    let program = Tree::new(shape, rows).forwards();
    let Some(layout) = program.layout_on(x, shape.input, rows) else { return run(x, weights, shape, rows).1 };
    let flat = floats(x, [rows * shape.output_widths().iter().sum::<usize>()]);
    program.run(layout, Input::Rows(x, shape.input), weights, weights, &flat, &(0..rows));
    flat
}

/// Where a layer's output and the gradient before its ReLU are saved.
#[derive(Clone, Copy, Default)]
struct Saved {
    output: usize,
    gradient: usize,
}

/// The steps forwards and backwards, and where in the output buffer each layer's values are saved.
struct Plan {
    program: Program,
    /// By layer.
    saved: Vec<Saved>,
    /// Where the gradient of the input starts.
    of_input: usize,
    /// Length of the output buffer.
    floats: usize,
}

/// The plan for `rows` rows.
fn plan(tree: &Tree, rows: usize, wants_input: bool) -> Plan {
    let mut end = 0;
    let mut take = |floats: usize| {
        end += floats;
        end - floats
    };
    let mut steps = Vec::new();
    let mut saved = vec![Saved::default(); tree.layers.len()];
    for (i, layer) in tree.layers.iter().enumerate() {
        // Outputs are not needed again, unless a ReLU made them.
        if layer.slot.is_none() || layer.relu {
            let (tile, width) = (tree.tile(i), layer.output);
            saved[i] = Saved { output: take(rows * width), gradient: take(rows * width) };
            steps.extend([tree.forward(i, Target::Tile(tile)), Step::Save { tile, width, at: saved[i].output }]);
        }
    }
    let of_input = take(if wants_input { rows * tree.layers.first().map_or(0, |l| l.input) } else { 0 });
    let widest = tree.widest_inside();
    // From the gradient of output `i`, in pieces that fit a tile, to that of its input.
    let from_output = |steps: &mut Vec<Step>, i: usize, at: usize, source: usize, target: Target, add: bool| {
        let width = tree.layers[i].output;
        for start in (0..width).step_by(widest) {
            let columns = start..(start + widest).min(width);
            steps.push(Step::Load { tile: source, columns: columns.clone(), width, at });
            steps.push(tree.backward(i, source, columns, target, add || start > 0));
        }
    };
    // Heads first, down to the gradients of their first layers. These are saved, so that until then the trunk's tile is free for pieces of outputs.
    for (i, layer) in tree.layers.iter().enumerate().skip(tree.trunk).rev() {
        let first = layer.parent.is_none_or(|p| p < tree.trunk);
        match tree.slots[i] {
            Some(at) if !first => from_output(&mut steps, i, at, TRUNK, Target::Tile(HEAD), false),
            Some(_) => {}
            None => {
                let width = layer.output;
                steps.extend([Step::Mask { tile: HEAD, width, at: saved[i].output }, Step::Save { tile: HEAD, width, at: saved[i].gradient }]);
                if !first {
                    steps.push(tree.backward(i, HEAD, 0..width, Target::Tile(HEAD), false));
                }
            }
        }
    }
    // Then the gradient of the trunk's output: a sum over the heads.
    let mut begun = false;
    for (i, layer) in tree.layers.iter().enumerate().skip(tree.trunk).rev() {
        if layer.parent.is_some_and(|p| p >= tree.trunk) || (layer.parent.is_none() && !wants_input) {
            continue;
        }
        match tree.slots[i] {
            Some(at) => from_output(&mut steps, i, at, HEAD, Target::Tile(TRUNK), begun),
            None => {
                steps.push(Step::Reload { tile: HEAD, width: layer.output, at: saved[i].gradient });
                steps.push(tree.backward(i, HEAD, 0..layer.output, Target::Tile(TRUNK), begun));
            }
        }
        begun = true;
    }
    for (i, layer) in tree.layers.iter().enumerate().take(tree.trunk).rev() {
        let width = layer.output;
        if let Some(at) = tree.slots[i] {
            steps.push(Step::Load { tile: TRUNK, columns: 0..width, width, at });
        }
        steps.extend([Step::Mask { tile: TRUNK, width, at: saved[i].output }, Step::Save { tile: TRUNK, width, at: saved[i].gradient }]);
        if layer.parent.is_some() || wants_input {
            let target = if layer.parent.is_none() { Target::Out(of_input) } else { Target::Tile(TRUNK) };
            steps.push(tree.backward(i, TRUNK, 0..width, target, false));
        }
    }
    if wants_input && tree.trunk == 0 {
        steps.push(Step::Save { tile: TRUNK, width: tree.layers.first().map_or(0, |l| l.input), at: of_input });
    }
    Plan { program: Program(steps), saved, of_input, floats: end }
}

/// Gradients of the input, if wanted, and of the flat weights from that of the flat outputs. Activations are recomputed instead of saved.
pub fn backward(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape, grad: &CubeTensor, wants_input: bool) -> (Option<CubeTensor>, CubeTensor) {
    let rows = x.meta.shape()[0];
    let of_input = wants_input.then(|| floats(x, x.meta.shape().clone()));
    if rows == 0 {
        return (of_input, upload(weights, &vec![0.0f32; shape.parameter_count()], DType::F32));
    }
    let tree = Tree::new(shape, rows);
    let Some(layout) = plan(&tree, rows, wants_input).program.layout_on(x, shape.input, rows) else {
        return layer_by_layer(x, weights, shape, grad, wants_input);
    };
    let gradient = floats(weights, [tree.weights]);
    let all: Vec<Dense> = tree.layers.iter().map(dense).collect();
    let both = gradients::with_transposed(weights, &all);
    for part in parts(x, rows, plan(&tree, ANY_ROWS, wants_input).floats.div_ceil(ANY_ROWS)) {
        let Plan { program, saved, of_input: input_at, floats: length } = plan(&tree, part.len(), wants_input);
        let buffer = &floats(x, [length]);
        program.run(layout, Input::Rows(x, shape.input), &both, grad, buffer, &part);
        let sums = Sums { gradient: &gradient, rows: part.len(), add: part.start > 0, listed: None };
        for (i, (layer, &l)) in tree.layers.iter().zip(&all).enumerate() {
            let input = layer.parent.map_or(Rows { buffer: x, at: part.start * l.input }, |p| Rows { buffer, at: saved[p].output });
            let dy = match tree.slots[i] {
                Some(at) if !layer.relu => Rows { buffer: grad, at: at + part.start * l.output },
                _ => Rows { buffer, at: saved[i].gradient },
            };
            sums.of_layer(input, dy, l);
        }
        if let Some(of_input) = &of_input {
            layers::copy(buffer, of_input, input_at, part.start * shape.input, part.len() * shape.input);
        }
    }
    (of_input, gradient)
}

/// As [`backward`], for networks that are too wide for a program.
fn layer_by_layer(x: &CubeTensor, weights: &CubeTensor, shape: &ReluShape, grad: &CubeTensor, wants_input: bool) -> (Option<CubeTensor>, CubeTensor) {
    let rows = x.meta.shape()[0];
    let gradient = floats(weights, [shape.parameter_count()]);
    let (outputs, flat) = run(x, weights, shape, rows);
    let widths = shape.output_widths();
    let all = shape.layers();
    let sums = Sums { gradient: &gradient, rows, add: false, listed: None };
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
        // Every chain ends in an output, so every layer has a gradient.
        let Some(d) = d else { continue };
        let input = layer.parent.map_or(x, |p| &outputs[p]);
        let l = dense(layer);
        sums.of_layer(Rows::whole(input), Rows::whole(&d), l);
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
