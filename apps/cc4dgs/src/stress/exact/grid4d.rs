//! `grid4d` (Grid4D, Xu et al. 2024): features of a spatial hash grid, turned into attention, weigh those of three grids over two axes and time. The motion
//! is rigid.

use super::grids::HashGrid;
use super::network::{chain, count};
use super::{Formula, Inputs, Rows, Weights, in_box, within_far};
use cc4dgs_core::Result;

/// Levels, and vertices per axis of the first and last level, of the spatial grid.
const SPACE_LEVELS: usize = 16;
const SPACE: [[f64; 3]; 2] = [[16.0; 3], [2048.0; 3]];
/// The same of each grid with time, the last of its axes.
const TIME_LEVELS: usize = 32;
const TIME: [[f64; 3]; 2] = [[8.0; 3], [32.0, 32.0, 16.0]];
/// The weights of the grids with time, and their axes; axis 3 is time.
const GRIDS: [(&str, [usize; 3]); 3] = [("grid.xyt", [0, 1, 3]), ("grid.yzt", [1, 2, 3]), ("grid.xzt", [0, 2, 3])];
/// Features per level, and the largest number of rows of a level.
const FEATURES: usize = 2;
const MOST_ROWS: usize = 1 << 19;
/// Times 0..1 are in the middle of their axis, on this share of it.
const TIME_SHARE: f64 = 0.9;
const WIDTH: usize = 256;

struct Grid4d {
    weights: Weights,
    /// The layout of each grid with time.
    grid: HashGrid<3>,
    gaussians: Vec<Gaussian>,
}

struct Gaussian {
    /// Centre, world units.
    centre: [f64; 3],
    /// The same, with the box as 0..1.
    in_box_at: [f64; 3],
    /// -1..1 per feature of the hidden layer.
    attention: Vec<f64>,
}

/// `grid4d`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let Inputs { weights, context, points, .. } = inputs;
    let space = grid(SPACE_LEVELS, SPACE);
    let [table, layer] = [weights.of("grid.xyz")?, weights.of("net.attention")?];
    let gaussian = |point: &[f64; 3]| {
        let in_box_at = in_box(point, &context);
        let features = space.features(table, in_box_at);
        let widths = [features.len(), WIDTH];
        let attention = chain(features, layer, &widths, false).into_iter().map(|v| 2.0 / (1.0 + (-v).exp()) - 1.0).collect();
        Gaussian { centre: within_far(point), in_box_at, attention }
    };
    let gaussians = points.iter().map(gaussian).collect();
    Ok(Box::new(Grid4d { weights, grid: grid(TIME_LEVELS, TIME), gaussians }))
}

/// A grid whose vertices per axis grow geometrically from those of the first to those of the last level; positions at 1 are at the last vertex of such a level.
fn grid(levels: usize, [first, last]: [[f64; 3]; 2]) -> HashGrid<3> {
    let scale = |level: usize| -> [f64; 3] {
        let share = level as f64 / (levels - 1) as f64;
        std::array::from_fn(|d| first[d] * (last[d] / first[d]).powf(share) - 1.0)
    };
    HashGrid::new((0..levels).map(scale), MOST_ROWS, FEATURES, 0.0, true)
}

impl Formula for Grid4d {
    /// R(q) x + v - x, changes of scales and of normalised quaternions.
    fn offsets(&self, t: f64) -> Result<Rows> {
        let (temporal, net) = (self.weights.of("net.temporal")?, self.weights.of("net.heads")?);
        let mut tables = Vec::new();
        for (name, axes) in GRIDS {
            tables.push((self.weights.of(name)?, axes));
        }
        let row = |gaussian: &Gaussian| -> Vec<f64> {
            let [x, y, z] = gaussian.in_box_at;
            let point = [x, y, z, 0.5 + TIME_SHARE * (t - 0.5)];
            let features: Vec<f64> = tables.iter().flat_map(|(table, axes)| self.grid.features(table, axes.map(|axis| point[axis]))).collect();
            let widths = [features.len(), WIDTH];
            let mut hidden = chain(features, temporal, &widths, true);
            hidden.iter_mut().zip(&gaussian.attention).for_each(|(h, a)| *h *= a);
            let mut at = 0;
            let mut head = |width: usize| {
                let widths = [WIDTH, width];
                let out = chain(hidden.clone(), &net[at..], &widths, false);
                at += count(&widths);
                out
            };
            // In the order of the weights; offsets have scales before quaternions.
            let (motion, quaternions, scales) = (head(7), head(4), head(3));
            let rotation = rotation([1.0 + motion[0], motion[1], motion[2], motion[3]]);
            let x = gaussian.centre;
            let means = (0..3).map(|d| (0..3).map(|k| rotation[d][k] * x[k]).sum::<f64>() + motion[4 + d] - x[d]);
            means.chain(scales).chain(quaternions).collect()
        };
        Ok(self.gaussians.iter().map(row).collect())
    }
}

/// The rotation matrix of a quaternion (w, x, y, z) of any length but 0.
fn rotation([w, x, y, z]: [f64; 4]) -> [[f64; 3]; 3] {
    let s = 2.0 / (w * w + x * x + y * y + z * z);
    [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
}
