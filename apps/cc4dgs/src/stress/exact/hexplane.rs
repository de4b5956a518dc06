//! `hexplane` (4DGS, Wu et al. 2024): six planes of features over the pairs of x, y, z and t at two resolutions, multiplied, then a network.

use super::grids::{cell, interpolate};
use super::network::trunk_and_heads;
use super::{Formula, Inputs, Rows, Weights, in_box};
use cc4dgs_core::Result;

/// The weights of each plane, and its axes; axis 3 is time.
const PLANES: [(&str, [usize; 2]); 6] =
    [("grid.xy", [0, 1]), ("grid.xz", [0, 2]), ("grid.xt", [0, 3]), ("grid.yz", [1, 2]), ("grid.yt", [1, 3]), ("grid.zt", [2, 3])];
/// Vertices per axis (x, y, z, t) of each resolution. The first and the last are at the ends of the axis.
const SIZES: [[u32; 4]; 2] = [[64, 64, 64, 150], [128, 128, 128, 150]];
/// Features per plane and resolution.
const FEATURES: usize = 16;
const WIDTH: usize = 128;

struct HexPlane {
    weights: Weights,
    sh_degree: usize,
    /// Centres, with the box as 0..1.
    points: Vec<[f64; 3]>,
}

/// `hexplane`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let points = inputs.points.iter().map(|point| in_box(point, &inputs.context)).collect();
    Ok(Box::new(HexPlane { weights: inputs.weights, sh_degree: inputs.context.sh_degree, points }))
}

impl Formula for HexPlane {
    fn offsets(&self, t: f64) -> Result<Rows> {
        let net = self.weights.of("net")?;
        let mut planes = Vec::new();
        for (name, axes) in PLANES {
            planes.push((self.weights.of(name)?, axes));
        }
        let row = |[x, y, z]: &[f64; 3]| {
            // Centres outside the box and times outside 0..1 have what the nearest point inside has.
            let point = [*x, *y, *z, t].map(|v| v.clamp(0.0, 1.0));
            let mut product = vec![1.0; SIZES.len() * FEATURES];
            for (table, axes) in &planes {
                product.iter_mut().zip(plane(table, *axes, &point)).for_each(|(product, feature)| *product *= feature);
            }
            trunk_and_heads(product, net, WIDTH, self.sh_degree)
        };
        Ok(self.points.iter().map(row).collect())
    }
}

/// The features of a plane over two axes at `point` (x, y, z, t in 0..1), resolution by resolution. The first of the two axes varies fastest in the table.
fn plane(mut table: &[f64], axes: [usize; 2], point: &[f64; 4]) -> Vec<f64> {
    let mut out = Vec::new();
    for size in SIZES {
        let cell_at = axes.map(|axis| cell(point[axis] * f64::from(size[axis] - 1), size[axis] - 2));
        let [across, along] = axes.map(|axis| size[axis] as usize);
        let (own, later) = table.split_at(across * along * FEATURES);
        out.extend(interpolate(cell_at, |[i, j]| &own[(j as usize * across + i as usize) * FEATURES..][..FEATURES]));
        table = later;
    }
    out
}
