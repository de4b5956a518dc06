//! Features at the vertices of grids, and multilinear interpolation between them.
//!
//! A position on the face between two cells may be put into either, because the interpolation is continuous.

/// Multipliers of the spatial hash, one per axis (Müller et al. 2022; the fourth is that of tiny-cuda-nn).
const PRIMES: [u32; 4] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];
/// Tables of tiny-cuda-nn have a multiple of this many rows.
const ROW_MULTIPLE: usize = 8;

/// Lower vertex of the cell of `position` (at least 0) on an axis whose last cell begins at `last`, and how far the position is past it.
pub fn cell(position: f64, last: u32) -> (u32, f64) {
    let low = position.floor().min(f64::from(last));
    (low as u32, position - low)
}

/// The features of the 2^D vertices of a cell, summed with multilinear weights. Per axis, `cell` has the lower vertex and the weight of the upper one.
pub fn interpolate<const D: usize, V: AsRef<[f64]>>(cell: [(u32, f64); D], features_of: impl Fn([u32; D]) -> V) -> Vec<f64> {
    let mut sum: Vec<f64> = Vec::new();
    for corner in 0..1u32 << D {
        let upper = |d: usize| corner >> d & 1;
        let weight: f64 = (0..D).map(|d| if upper(d) == 1 { cell[d].1 } else { 1.0 - cell[d].1 }).product();
        let features = features_of(std::array::from_fn(|d| cell[d].0 + upper(d)));
        sum.resize(features.as_ref().len(), 0.0);
        sum.iter_mut().zip(features.as_ref()).for_each(|(s, v)| *s += weight * v);
    }
    sum
}

/// The layout of a table of features at the vertices of a grid of several levels. Where a level has more vertices than its share of the table may have rows,
/// vertices share rows by their hash (Müller et al. 2022). Points outside of 0..1 on any axis have zeros.
pub struct HashGrid<const D: usize> {
    levels: Vec<Level<D>>,
    /// Features per level.
    features: usize,
    /// Added to positions.
    stagger: f64,
    /// Whether weights go through smoothstep.
    smooth: bool,
}

struct Level<const D: usize> {
    /// Vertices per axis.
    size: [usize; D],
    /// Cells per unit of each axis.
    scale: [f64; D],
    /// Rows of the table before this level.
    first: usize,
    /// Rows of this level.
    rows: usize,
    /// Whether vertices share rows by their hash.
    hashed: bool,
}

impl<const D: usize> HashGrid<D> {
    /// A grid whose levels have `scales` cells on each axis (the last may be a part of one), and at most `most_rows` rows, a multiple of eight.
    pub fn new(scales: impl Iterator<Item = [f64; D]>, most_rows: usize, features: usize, stagger: f64, smooth: bool) -> Self {
        let mut levels: Vec<Level<D>> = Vec::new();
        for scale in scales {
            let size = scale.map(|s| s.ceil() as usize + 1);
            let first = levels.last().map_or(0, |before| before.first + before.rows);
            let vertices = size.iter().fold(1usize, |product, s| product.saturating_mul(*s));
            let rows = vertices.min(most_rows).next_multiple_of(ROW_MULTIPLE);
            levels.push(Level { size, scale, first, rows, hashed: vertices > rows });
        }
        Self { levels, features, stagger, smooth }
    }
    /// The features of all levels at `x`, level by level.
    pub fn features(&self, table: &[f64], x: [f64; D]) -> Vec<f64> {
        if x.iter().any(|x| !(0.0..=1.0).contains(x)) {
            return vec![0.0; self.levels.len() * self.features];
        }
        let mut out = Vec::new();
        for level in &self.levels {
            let cell_at: [(u32, f64); D] = std::array::from_fn(|d| {
                let (low, part) = cell(x[d] * level.scale[d] + self.stagger, u32::MAX);
                (low, if self.smooth { part * part * (3.0 - 2.0 * part) } else { part })
            });
            out.extend(interpolate(cell_at, |vertex| &table[(level.first + level.row(vertex)) * self.features..][..self.features]));
        }
        out
    }
}

impl<const D: usize> Level<D> {
    /// The row of a vertex within the level. Indices past the last row (staggered positions end half a cell after the last vertex) begin again at the first.
    fn row(&self, vertex: [u32; D]) -> usize {
        let raw = if self.hashed {
            vertex.iter().zip(PRIMES).fold(0u32, |hash, (v, prime)| hash ^ v.wrapping_mul(prime)) as usize
        } else {
            // The first axis varies fastest.
            vertex.iter().zip(&self.size).rev().fold(0usize, |index, (v, size)| index * size + *v as usize)
        };
        raw % self.rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_table_is_read_as_a_linear_function() {
        // 4 x 3 x 6 vertices, x first; the value of a vertex is x + 10 y + 100 z.
        let grid = HashGrid::<3>::new([[3.0, 2.0, 4.5]].into_iter(), 1000, 1, 0.0, false);
        let table: Vec<f64> = (0..72).map(|row| f64::from(row % 4 + 10 * (row / 4 % 3) + 100 * (row / 12))).collect();
        for x in [[0.0, 0.0, 0.0], [0.2, 0.9, 0.37], [0.5, 0.5, 1.0]] {
            let found = grid.features(&table, x);
            let wanted = 3.0 * x[0] + 10.0 * 2.0 * x[1] + 100.0 * 4.5 * x[2];
            assert!(found.len() == 1 && (found[0] - wanted).abs() < 1e-9, "{x:?}: {found:?} instead of {wanted}");
        }
        assert_eq!(grid.features(&table, [0.5, 1.1, 0.5]), [0.0]);
    }

    #[test]
    fn vertices_share_rows_where_there_are_few() {
        let grid = HashGrid::<2>::new([[3.0; 2], [63.0; 2]].into_iter(), 32, 1, 0.5, false);
        let rows: Vec<(usize, usize)> = grid.levels.iter().map(|level| (level.first, level.rows)).collect();
        assert_eq!(rows, [(0, 16), (16, 32)]);
        // 2 xor 3 times 2,654,435,761, modulo 2^32 and then 32: 2 xor (3 * 17 modulo 32).
        assert_eq!((grid.levels[0].row([1, 2]), grid.levels[0].row([4, 3]), grid.levels[1].row([2, 3])), (9, 0, 17));
    }
}
