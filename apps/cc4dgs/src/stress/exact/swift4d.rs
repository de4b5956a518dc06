//! `swift4d-hash` (Swift4D, Wu et al. 2025, and its published code): one hash grid over position and time, an encoder, five heads, no biases.

use super::grids::HashGrid;
use super::network::{HEADS, chain};
use super::{Formula, Inputs, Rows, Weights, in_box};
use cc4dgs_core::Result;

/// Levels, and vertices per axis of the first; each level doubles them.
const LEVELS: u32 = 16;
const BASE: u32 = 16;
/// Features per level, and the largest number of rows of a level.
const FEATURES: usize = 4;
const MOST_ROWS: usize = 1 << 15;
/// Positions are moved by half a cell, as in tiny-cuda-nn.
const STAGGER: f64 = 0.5;
const WIDTH: usize = 128;
/// The matrices of heads have a multiple of this many columns; those past the head's own are not used.
const PADDED: usize = 16;

struct Swift4d {
    weights: Weights,
    grid: HashGrid<4>,
    /// Two layers.
    encoder: Vec<f64>,
    /// Of each head, three layers and the number of its values.
    heads: Vec<(Vec<f64>, usize)>,
    /// Centres, with the box as 0..1.
    points: Vec<[f64; 3]>,
}

/// Widths of the encoder's layers, input first.
const ENCODER: [usize; 3] = [LEVELS as usize * FEATURES, WIDTH, WIDTH];

/// Widths of the layers of a head with `values` values, input first.
fn head_widths(values: usize) -> [usize; 4] {
    [WIDTH, WIDTH, WIDTH, values.next_multiple_of(PADDED)]
}

/// `swift4d-hash`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let Inputs { weights, context, points, .. } = inputs;
    let scales = (0..LEVELS).map(|level| [f64::from(BASE << level) - 1.0; 4]);
    let encoder = with_zero_biases(weights.of("grid.encoder")?, &ENCODER);
    let mut heads = Vec::new();
    for head in HEADS {
        let values = head.width(context.sh_degree);
        heads.push((with_zero_biases(weights.of(&format!("net.head.{}", head.name()))?, &head_widths(values)), values));
    }
    let points = points.iter().map(|point| in_box(point, &context)).collect();
    Ok(Box::new(Swift4d { weights, grid: HashGrid::new(scales, MOST_ROWS, FEATURES, STAGGER, false), encoder, heads, points }))
}

impl Formula for Swift4d {
    /// Outside the box and at times outside 0..1 the grid has zeros; without biases the offsets are zeros then too.
    fn offsets(&self, t: f64) -> Result<Rows> {
        let table = self.weights.of("grid.table")?;
        let row = |[x, y, z]: &[f64; 3]| {
            let hidden = chain(self.grid.features(table, [*x, *y, *z, t]), &self.encoder, &ENCODER, true);
            let mut out = Vec::new();
            for (weights, values) in &self.heads {
                out.extend(chain(hidden.clone(), weights, &head_widths(*values), false).into_iter().take(*values));
            }
            out
        };
        Ok(self.points.iter().map(row).collect())
    }
}

/// Layers of `widths`, input first, from their matrices `[input, output]`, one after the other.
fn with_zero_biases(mut matrices: &[f64], widths: &[usize]) -> Vec<f64> {
    let mut out = Vec::new();
    for pair in widths.windows(2) {
        let (own, later) = matrices.split_at(pair[0] * pair[1]);
        out.extend(own.iter().copied().chain(std::iter::repeat_n(0.0, pair[1])));
        matrices = later;
    }
    out
}
