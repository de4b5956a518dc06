//! Shapes of the small networks: layer widths, and the ranges of each layer's weights in one flat array.

use std::ops::Range;

/// Added to the variance in LayerNorm.
pub const LAYER_NORM_EPSILON: f32 = 1e-5;

/// Layer widths of trunk and heads.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReluShape {
    /// Input width.
    pub input: usize,
    /// Output widths of the trunk's layers; each ends in a ReLU.
    pub trunk: Vec<usize>,
    /// Per head, the output widths of its layers; all but the last end in a ReLU.
    pub heads: Vec<Vec<usize>>,
}

/// One layer: its position in the tree and in the flat weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// The layer whose output it reads; `None` is the network's input.
    pub parent: Option<usize>,
    /// Input width.
    pub input: usize,
    /// Output width.
    pub output: usize,
    /// W `[input, output]`.
    pub weight: Range<usize>,
    /// b `[output]`.
    pub bias: Range<usize>,
    /// Whether it ends in a ReLU.
    pub relu: bool,
    /// Which output it writes, if any.
    pub slot: Option<usize>,
}

/// The number of weights of layers of these `widths`, one after another, whose input has `input` values.
pub fn weights_of_chain(mut input: usize, widths: &[usize]) -> usize {
    let layer = |&output: &usize| (std::mem::replace(&mut input, output) + 1) * output;
    widths.iter().map(layer).sum()
}

impl ReluShape {
    /// A chain of Linear + ReLU layers ending in a Linear layer, if `widths` is input, hidden…, output.
    pub fn chain(widths: &[usize]) -> Self {
        match widths {
            [input, rest @ ..] => Self { input: *input, trunk: Vec::new(), heads: vec![rest.to_vec()] },
            [] => Self::default(),
        }
    }
    /// The layers: the trunk's, then head after head. A layer comes after its parent.
    pub fn layers(&self) -> Vec<Layer> {
        let mut layers: Vec<Layer> = Vec::new();
        let mut at = 0;
        let mut push = |parent: Option<usize>, input: usize, output: usize, relu: bool, slot: Option<usize>| {
            let weight = at..at + input * output;
            let bias = weight.end..weight.end + output;
            at = bias.end;
            layers.push(Layer { parent, input, output, weight, bias, relu, slot });
            layers.len() - 1
        };
        let (mut parent, mut width) = (None, self.input);
        for (i, &output) in self.trunk.iter().enumerate() {
            let last = self.heads.is_empty() && i + 1 == self.trunk.len();
            parent = Some(push(parent, width, output, true, last.then_some(0)));
            width = output;
        }
        for (slot, head) in self.heads.iter().enumerate() {
            let (mut parent, mut width) = (parent, width);
            for (i, &output) in head.iter().enumerate() {
                let last = i + 1 == head.len();
                parent = Some(push(parent, width, output, !last, last.then_some(slot)));
                width = output;
            }
        }
        layers
    }
    /// The number of weights.
    pub fn parameter_count(&self) -> usize {
        self.layers().last().map_or(0, |l| l.bias.end)
    }
    /// The widths of the outputs, in order.
    pub fn output_widths(&self) -> Vec<usize> {
        if self.heads.is_empty() { self.trunk.last().copied().into_iter().collect() } else { self.heads.iter().filter_map(|h| h.last().copied()).collect() }
    }
    /// Whether every layer has a width and every head a layer.
    pub fn is_sound(&self) -> bool {
        let widths = self.trunk.iter().chain(self.heads.iter().flatten());
        self.input > 0 && widths.clone().count() > 0 && widths.clone().all(|&w| w > 0) && self.heads.iter().all(|h| !h.is_empty())
    }
}

/// Layer widths: input, hidden layers, output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MishShape {
    /// Input width.
    pub input: usize,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Output width.
    pub output: usize,
}

/// The ranges of one layer's arrays in the flat weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MishLayer {
    /// Input width.
    pub input: usize,
    /// Output width.
    pub output: usize,
    /// W `[input, output]`.
    pub weight: Range<usize>,
    /// b `[output]`.
    pub bias: Range<usize>,
    /// LayerNorm gain `[output]`; `None` for the output layer, which has no norm and no activation.
    pub gain: Option<Range<usize>>,
    /// LayerNorm shift `[output]`.
    pub shift: Option<Range<usize>>,
}

impl MishShape {
    /// The layers in order.
    pub fn layers(&self) -> Vec<MishLayer> {
        let mut at = 0;
        let mut take = |n: usize| {
            at += n;
            at - n..at
        };
        let widths: Vec<usize> = self.hidden.iter().copied().chain([self.output]).collect();
        let mut input = self.input;
        let mut layers = Vec::with_capacity(widths.len());
        for (i, &output) in widths.iter().enumerate() {
            let hidden = i < self.hidden.len();
            let (weight, bias) = (take(input * output), take(output));
            let gain = hidden.then(|| take(output));
            let shift = hidden.then(|| take(output));
            layers.push(MishLayer { input, output, weight, bias, gain, shift });
            input = output;
        }
        layers
    }
    /// The number of weights.
    pub fn parameter_count(&self) -> usize {
        self.layers().last().map_or(0, |l| l.bias.end)
    }
    /// The widest array of a row.
    pub fn widest(&self) -> usize {
        self.hidden.iter().copied().chain([self.input, self.output]).max().unwrap_or(0)
    }
}
