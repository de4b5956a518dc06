//! Layers of networks. Weights are flat: per layer W `[input, output]`, then b `[output]`.

use cc4dgs_backends::ops::field::MishShape;
use cc4dgs_deformers::parts::heads::Head;

/// Added to variances in the layer norm of decoders.
const NORM_EPSILON: f64 = 1e-5;

/// The default heads of deformers that have all.
pub const HEADS: [Head; 5] = [Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh];

pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A linear layer: W `[input, output]`, then b `[output]`, at the start of `weights`.
fn linear(x: &[f64], weights: &[f64], output: usize) -> Vec<f64> {
    let mut out = weights[x.len() * output..][..output].to_vec();
    for (x, row) in x.iter().zip(weights.chunks_exact(output)) {
        out.iter_mut().zip(row).for_each(|(out, w)| *out += x * w);
    }
    out
}

/// Number of weights of layers of `widths`, input first.
pub fn count(widths: &[usize]) -> usize {
    widths.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum()
}

/// Layers of `widths`, input first, with ReLUs between them and, with `last_relu`, after the last one.
pub fn chain(mut x: Vec<f64>, mut weights: &[f64], widths: &[usize], last_relu: bool) -> Vec<f64> {
    for (i, pair) in widths.windows(2).enumerate() {
        x = linear(&x, weights, pair[1]);
        weights = &weights[(pair[0] + 1) * pair[1]..];
        if last_relu || i + 2 < widths.len() {
            x.iter_mut().for_each(|v| *v = v.max(0.0));
        }
    }
    x
}

/// The network of 4DGS and of E-D3DGS: a layer with a ReLU, then for each of [`HEADS`] two layers with a ReLU between them. All outputs side by side.
pub fn trunk_and_heads(x: Vec<f64>, weights: &[f64], width: usize, sh_degree: usize) -> Vec<f64> {
    let trunk = [x.len(), width];
    let mut own = &weights[count(&trunk)..];
    let hidden = chain(x, weights, &trunk, true);
    let mut out = Vec::new();
    for head in HEADS {
        let widths = [width, width, head.width(sh_degree)];
        out.extend(chain(hidden.clone(), own, &widths, false));
        own = &own[count(&widths)..];
    }
    out
}

/// Layers of linear map, layer norm and Mish, and a linear one.
pub fn decoder(mut x: Vec<f64>, mut weights: &[f64], shape: &MishShape) -> Vec<f64> {
    for &width in &shape.hidden {
        let input = x.len();
        x = linear(&x, weights, width);
        weights = &weights[(input + 1) * width..];
        let n = width as f64;
        let mean = x.iter().sum::<f64>() / n;
        let deviation = (x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n + NORM_EPSILON).sqrt();
        for (k, v) in x.iter_mut().enumerate() {
            let z = (*v - mean) / deviation * weights[k] + weights[width + k];
            *v = z * z.exp().ln_1p().tanh();
        }
        weights = &weights[2 * width..];
    }
    linear(&x, weights, shape.output)
}
