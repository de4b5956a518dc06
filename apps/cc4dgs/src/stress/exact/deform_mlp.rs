//! `deform-mlp` (Deformable 3DGS, Yang et al. 2024): eight layers on encoded centre and time, the input again after five of them.

use super::network::{chain, count};
use super::{Formula, Inputs, Rows, Weights, within_far};
use cc4dgs_core::Result;

/// Bands, width and layers, and after how many layers the input comes again.
const BANDS: usize = 10;
const WIDTH: usize = 256;
const LAYERS: [usize; 2] = [5, 3];

struct DeformMlp {
    weights: Weights,
    /// Encoded centres.
    features: Rows,
}

/// `deform-mlp`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let features = inputs.points.iter().map(|point| positional(&within_far(point))).collect();
    Ok(Box::new(DeformMlp { weights: inputs.weights, features }))
}

impl Formula for DeformMlp {
    fn offsets(&self, t: f64) -> Result<Rows> {
        let time = positional(&[t]);
        let [before, after] = [self.weights.of("net.before")?, self.weights.of("net.after")?];
        let w = WIDTH;
        let row = |features: &Vec<f64>| {
            let input = [features.as_slice(), &time].concat();
            let hidden = chain(input.clone(), before, &[&[input.len()], vec![w; LAYERS[0]].as_slice()].concat(), true);
            let widths = [&[input.len() + w], vec![w; LAYERS[1]].as_slice()].concat();
            let hidden = chain([input, hidden].concat(), after, &widths, true);
            let mut at = count(&widths);
            let mut head = |width: usize| {
                let out = chain(hidden.clone(), &after[at..], &[w, width], false);
                at += (w + 1) * width;
                out
            };
            // In the order of the weights; offsets have scales before rotations.
            let (means, rotations, scales) = (head(3), head(4), head(3));
            [means, scales, rotations].concat()
        };
        Ok(self.features.iter().map(row).collect())
    }
}

/// x, then all sines and all cosines of x times each power of two.
fn positional(x: &[f64]) -> Vec<f64> {
    let mut out = x.to_vec();
    for band in 0..BANDS {
        let turned = x.iter().map(|x| x * (band as f64).exp2());
        out.extend(turned.clone().map(f64::sin));
        out.extend(turned.map(f64::cos));
    }
    out
}
