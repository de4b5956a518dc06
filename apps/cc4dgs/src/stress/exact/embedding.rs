//! `embedding` (E-D3DGS, Bae et al. 2024): a vector per Gaussian and one per time feed a coarse and a fine network, whose outputs are added.
//!
//! For progress 1, the default of a deformer: no head is faded, and the fine network sees all rows of the table of times.

use super::grids::{cell, interpolate};
use super::network::trunk_and_heads;
use super::{Formula, Inputs, Rows, Weights};
use cc4dgs_core::Result;

/// Rows of the table of times, and floats of each.
const TIME_ROWS: u32 = 150;
const TIME_FEATURES: usize = 256;
/// The weights of each network, and the rows that the table has when it is resized for it.
const NETWORKS: [(&str, u32); 2] = [("net.coarse", 30), ("net.fine", TIME_ROWS)];
const WIDTH: usize = 128;

struct Embedding {
    weights: Weights,
    sh_degree: usize,
    /// The learned vectors of Gaussians.
    vectors: Rows,
}

/// `embedding`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    Ok(Box::new(Embedding { weights: inputs.weights, sh_degree: inputs.context.sh_degree, vectors: inputs.attributes }))
}

impl Formula for Embedding {
    fn offsets(&self, t: f64) -> Result<Rows> {
        let table = self.weights.of("grid.times")?;
        let mut networks = Vec::new();
        for (name, rows) in NETWORKS {
            let resized = |row: u32| between(f64::from(row) / f64::from(rows - 1), TIME_ROWS, |row| &table[row as usize * TIME_FEATURES..][..TIME_FEATURES]);
            networks.push((self.weights.of(name)?, between(t.clamp(0.0, 1.0), rows, resized)));
        }
        let row = |vector: &Vec<f64>| {
            let outputs = networks.iter().map(|(weights, time)| trunk_and_heads([vector.as_slice(), time].concat(), weights, WIDTH, self.sh_degree));
            outputs.reduce(|coarse, fine| coarse.iter().zip(&fine).map(|(a, b)| a + b).collect()).unwrap_or_default()
        };
        Ok(self.vectors.iter().map(row).collect())
    }
}

/// A table of `rows` rows at `share`, linearly interpolated between two of them; the first row is at 0, the last at 1.
fn between<V: AsRef<[f64]>>(share: f64, rows: u32, row: impl Fn(u32) -> V) -> Vec<f64> {
    interpolate([cell(share * f64::from(rows - 1), rows - 2)], |[index]| row(index))
}
