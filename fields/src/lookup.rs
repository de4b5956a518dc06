//! Interpolated lookups in grids of stored features: dense, or hashed where a level has more vertices than rows (Müller et al. 2022). Shapes, and the
//! evaluation without burn that kernels and players share.

use rayon::prelude::*;

/// Points per task.
const ROWS: usize = 128;

/// Most axes of a grid.
pub const MAX_DIMS: usize = 4;
/// Multipliers of the spatial hash (Müller et al. 2022).
pub const PRIMES: [u32; MAX_DIMS] = [1, 2_654_435_761, 805_459_861, 3_674_653_429];

/// The features of points outside 0..1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outside {
    /// Zeros, and no gradient.
    Zero,
    /// The features at the nearest face.
    Clamp,
}

/// One level.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GridLevel {
    /// Vertices per axis.
    pub size: [u32; MAX_DIMS],
    /// Position = x * scale + stagger, per axis.
    pub scale: [f32; MAX_DIMS],
    /// Rows of the table before this level.
    pub first_row: usize,
    /// Rows of this level.
    pub rows: usize,
    /// Whether vertices share rows by their hash.
    pub hashed: bool,
}

/// A whole grid.
#[derive(Clone, Debug, PartialEq)]
pub struct GridShape {
    /// Axes, 1 to [`MAX_DIMS`].
    pub dims: usize,
    /// Features per level.
    pub features: usize,
    /// Levels, in the order of the table.
    pub levels: Vec<GridLevel>,
    /// Added to positions (tiny-cuda-nn: 0.5).
    pub stagger: f32,
    /// Whether interpolation weights go through smoothstep.
    pub smooth: bool,
    /// Whether the last cell ends with the last vertex, so that x = 1 lies at it (align_corners).
    pub clamps: bool,
    /// The features of points outside 0..1.
    pub outside: Outside,
}

impl GridShape {
    /// Rows of the table.
    pub fn rows(&self) -> usize {
        self.levels.iter().map(|l| l.rows).sum()
    }
    /// Weights of the table.
    pub fn parameter_count(&self) -> usize {
        self.rows().saturating_mul(self.features)
    }
    /// Features per point.
    pub fn width(&self) -> usize {
        self.levels.len() * self.features
    }
    /// Appends a level of `size` vertices per axis in at most `most_rows` rows; dense where they suffice.
    pub fn push(&mut self, size: &[u32], scale: &[f32], most_rows: usize) {
        let vertices = size.iter().fold(1u64, |n, &s| n.saturating_mul(u64::from(s)));
        // Tables are padded to eight rows, as tiny-cuda-nn does.
        let padded = vertices.saturating_add(7) / 8 * 8;
        let rows = if self.clamps { vertices } else { padded }.min(most_rows as u64) as usize;
        let fill = |values: &[u32]| std::array::from_fn(|d| values.get(d).copied().unwrap_or(1));
        let level = GridLevel {
            size: fill(size),
            scale: std::array::from_fn(|d| scale.get(d).copied().unwrap_or(0.0)),
            first_row: self.rows(),
            rows,
            hashed: vertices > rows as u64,
        };
        self.levels.push(level);
    }
}

/// The cell of a point on a level of `D` axes: per axis, the contributions of its lower and upper vertex in weight, hash and index.
pub struct Cell<const D: usize> {
    weight: [[f32; 2]; D],
    hash: [[u32; 2]; D],
    index: [[u32; 2]; D],
}

/// The cell of `x` (in 0..1 per axis), `None` outside the grid.
#[inline(always)]
pub fn cell<const D: usize>(x: &[f32; D], level: &GridLevel, shape: &GridShape) -> Option<Cell<D>> {
    let mut cell = Cell { weight: [[0.0; 2]; D], hash: [[0; 2]; D], index: [[0; 2]; D] };
    let mut stride = 1u32;
    for d in 0..D {
        let raw = x[d];
        // Comparisons with NaN are false: it is outside, or at the lower face.
        if shape.outside == Outside::Zero && !(0.0..=1.0).contains(&raw) {
            return None;
        }
        let clamped = if raw > 0.0 { raw.min(1.0) } else { 0.0 };
        let position = clamped * level.scale[d] + shape.stagger;
        // A dense level ends with its last vertex; a hashed one has a row for every index.
        let low = if shape.clamps { position.floor().min((level.size[d] - 2) as f32) } else { position.floor() };
        let part = position - low;
        let part = if shape.smooth { part * part * (3.0 - 2.0 * part) } else { part };
        let vertex = low as u32;
        cell.weight[d] = [1.0 - part, part];
        // Products and sums wrap; the index does so on hashed levels only, which do not use it.
        cell.hash[d] = [vertex.wrapping_mul(PRIMES[d]), (vertex + 1).wrapping_mul(PRIMES[d])];
        cell.index[d] = [vertex.wrapping_mul(stride), (vertex + 1).wrapping_mul(stride)];
        stride = stride.wrapping_mul(level.size[d]);
    }
    Some(cell)
}

/// Row (within the level) and weight of a corner (bit d set: the upper one along axis d).
#[inline(always)]
pub fn corner<const D: usize>(cell: &Cell<D>, corner: usize, level: &GridLevel) -> (usize, f32) {
    let (mut weight, mut hash, mut index) = (1.0f32, 0u32, 0u32);
    for d in 0..D {
        let upper = corner >> d & 1;
        weight *= cell.weight[d][upper];
        hash ^= cell.hash[d][upper];
        index = index.wrapping_add(cell.index[d][upper]);
    }
    let (raw, rows) = (if level.hashed { hash } else { index }, level.rows as u32);
    // A division per corner would cost more than the lookup.
    let row = if raw < rows {
        raw
    } else if rows.is_power_of_two() {
        raw & (rows - 1)
    } else {
        raw % rows
    };
    (row as usize, weight)
}

/// Runs `$body` with `$d` the number of axes as a constant.
#[doc(hidden)]
#[macro_export]
macro_rules! with_dims {
    ($dims:expr, $d:ident => $body:expr) => {
        match $dims {
            1 => {
                const $d: usize = 1;
                $body
            }
            2 => {
                const $d: usize = 2;
                $body
            }
            3 => {
                const $d: usize = 3;
                $body
            }
            _ => {
                const $d: usize = 4;
                $body
            }
        }
    };
}

/// Features `[M, levels * features]` of `points` `[M, dims]` (in 0..1 inside the grid) from a `table` of [`GridShape::parameter_count`] weights.
pub fn features(shape: &GridShape, table: &[f32], points: &[f32]) -> Vec<f32> {
    let mut out = vec![0.0f32; points.len() / shape.dims * shape.width()];
    if !out.is_empty() {
        let tasks = out.par_chunks_mut(ROWS * shape.width()).zip(points.par_chunks(ROWS * shape.dims));
        tasks.for_each(|(out, points)| gather(shape, table, points, out));
    }
    out
}

/// Adds the features of `points` `[M, dims]` to `out` `[M, levels * features]`, on one thread.
#[inline(always)]
pub fn gather(shape: &GridShape, table: &[f32], points: &[f32], out: &mut [f32]) {
    with_dims!(shape.dims, D => gather_axes::<D>(shape, table, points, out));
}

#[inline(always)]
fn gather_axes<const D: usize>(shape: &GridShape, table: &[f32], points: &[f32], out: &mut [f32]) {
    let (f, width) = (shape.features, shape.width());
    // Level by level, so that a task's rows of one table stay near.
    for (l, level) in shape.levels.iter().enumerate() {
        let own = &table[level.first_row * f..(level.first_row + level.rows) * f];
        for (row, x) in out.chunks_exact_mut(width).zip(points.as_chunks::<D>().0) {
            let Some(cell) = cell(x, level, shape) else { continue };
            let sum = &mut row[l * f..(l + 1) * f];
            for c in 0..1 << D {
                let (at, weight) = corner(&cell, c, level);
                add_scaled(sum, &own[at * f..(at + 1) * f], weight);
            }
        }
    }
}

/// Adds `scale` times `values` to `row`.
#[inline(always)]
pub fn add_scaled(row: &mut [f32], values: &[f32], scale: f32) {
    for (r, v) in row.iter_mut().zip(values) {
        *r += scale * v;
    }
}
