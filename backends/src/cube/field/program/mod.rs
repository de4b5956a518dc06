//! Small networks in one launch, forwards and backwards. A workgroup keeps tiles of rows in shared memory and takes them through a list of steps, so that
//! activations are written to global memory only where the gradient of weights needs them. The steps are data, so that one kernel serves decoders (behind their
//! hash signatures) and deformation networks alike. Widths that do not fit the shared memory go layer by layer instead ([`super::layers`]).

mod fields;
mod steps;

pub use steps::is_vertex;

use crate::cube::tensor::{binding_bytes, shared_bytes, spread};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cc4dgs_fields::hash::LevelHash;
use cubecl::prelude::*;
use fields::{FIELDS, Fields, LOAD, MASK, MULTIPLY, NONE, NORM, NORM_BACK, OUTSIDE, RELOAD, SAVE};
use std::ops::Range;
use steps::{BLOCK, PARTS};

/// Rows per workgroup, the more the better: weights are read once per tile.
const TILES: [usize; 3] = [64, 32, 16];
/// Threads per workgroup that every adapter allows.
const MAX_THREADS: usize = 256;
/// Workgroups that keep a GPU busy; for fewer rows, smaller tiles are taken.
const ENOUGH_WORKGROUPS: usize = 64;

/// Where a layer writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A tile.
    Tile(usize),
    /// The result, row by row from this element on.
    Out(usize),
}

/// One thing done to a tile. `at` and its like are indices into the output buffer, where rows of the given width follow each other.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// The tile becomes these columns of rows of `width` values of the buffer `given`, from element `at` on.
    Load { tile: usize, columns: Range<usize>, width: usize, at: usize },
    /// x W (+ b): `weights` and `bias` are the indices of W `[input, output]` and b `[output]`. With `add`, on top of what the target tile holds.
    Multiply { source: usize, target: Target, input: usize, output: usize, weights: usize, bias: Option<usize>, relu: bool, add: bool },
    /// The tile is written to the output buffer: a saved activation.
    Save { tile: usize, width: usize, at: usize },
    /// The tile becomes what was saved in the same way.
    Reload { tile: usize, width: usize, at: usize },
    /// The ReLU mask: zero where the saved output of a ReLU is.
    Mask { tile: usize, width: usize, at: usize },
    /// LayerNorm and Mish; gain and shift follow each other among the weights. `save` says where normalised values and scales go, if they are needed.
    Norm { tile: usize, width: usize, gain: usize, save: Option<SavedNorm> },
    /// The derivative of `Norm`: takes the gradient of the output to that of the input, and saves it (`after`) and that of the value before Mish (`before`).
    NormBack { tile: usize, width: usize, gain: usize, saved: SavedNorm, before: usize, after: usize },
}

/// Where a [`Step::Norm`] saves what its derivative needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SavedNorm {
    /// Normalised values.
    pub normal: usize,
    /// Scales, see [`scales`].
    pub scale: usize,
}

impl Step {
    fn tiles_and_width(&self) -> (usize, usize) {
        match *self {
            Self::Multiply { source, target: Target::Tile(t), input, output, .. } => (source.max(t), input.max(output)),
            Self::Multiply { source, input, .. } => (source, input),
            Self::Load { tile, ref columns, .. } => (tile, columns.len()),
            Self::Save { tile, width, .. }
            | Self::Reload { tile, width, .. }
            | Self::Mask { tile, width, .. }
            | Self::Norm { tile, width, .. }
            | Self::NormBack { tile, width, .. } => (tile, width),
        }
    }
    fn encode(&self) -> [u32; FIELDS] {
        let fields = match *self {
            Self::Load { tile, ref columns, width, at } => {
                Fields { kind: LOAD, tile, width: columns.len(), at, column: columns.start, stride: width, ..Fields::default() }
            }
            Self::Multiply { source, target, input, output, weights, bias, relu, add } => {
                let (target, at) = match target {
                    Target::Tile(t) => (t, 0),
                    Target::Out(at) => (OUTSIDE, at),
                };
                Fields {
                    kind: MULTIPLY,
                    tile: source,
                    width: input,
                    at,
                    weights,
                    target,
                    output,
                    bias: bias.unwrap_or(NONE as usize),
                    relu,
                    add,
                    ..Fields::default()
                }
            }
            Self::Save { tile, width, at } => Fields { kind: SAVE, tile, width, at, ..Fields::default() },
            Self::Reload { tile, width, at } => Fields { kind: RELOAD, tile, width, at, stride: width, ..Fields::default() },
            Self::Mask { tile, width, at } => Fields { kind: MASK, tile, width, at, ..Fields::default() },
            Self::Norm { tile, width, gain, save } => {
                let SavedNorm { normal, scale } = save.unwrap_or(SavedNorm { normal: NONE as usize, scale: 0 });
                Fields { kind: NORM, tile, width, weights: gain, normal, scale, ..Fields::default() }
            }
            Self::NormBack { tile, width, gain, saved: SavedNorm { normal, scale }, before, after } => {
                Fields { kind: NORM_BACK, tile, width, at: after, weights: gain, normal, scale, before, ..Fields::default() }
            }
        };
        fields.encode()
    }
}

/// The initial contents of the first tile.
#[derive(Clone, Copy)]
pub enum Input<'a> {
    /// Rows `[_, in]`.
    Rows(&'a CubeTensor, usize),
    /// Signatures of vertices `[_, 3]`.
    Signatures(&'a CubeTensor, &'a LevelHash),
}

impl Input<'_> {
    fn width(&self) -> usize {
        match self {
            Self::Rows(_, width) => *width,
            Self::Signatures(_, hash) => hash.len(),
        }
    }
}

/// How a program is laid out in the shared memory of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Layout {
    tile: usize,
    stride: usize,
    tiles: usize,
    /// Threads per row of the tile.
    per_row: usize,
}

impl Layout {
    /// Threads of a workgroup.
    fn threads(&self) -> usize {
        self.tile * self.per_row
    }
    /// Columns that all threads together compute at once.
    fn columns(&self) -> usize {
        self.per_row * BLOCK * BLOCK
    }
    /// Inputs of a multiplication that are staged at a time.
    fn chunk(&self) -> usize {
        if self.per_row > 4 { 4 } else { 8 }
    }
    /// Bytes of shared memory.
    fn bytes(&self) -> usize {
        4 * (self.tile * (self.stride * self.tiles + PARTS) + self.chunk() * (self.tile + self.columns()))
    }
}

/// The floats that the scales of [`Step::Norm`] take for so many rows, whatever the layout: each thread saves its own.
pub fn scales(rows: usize) -> usize {
    // Threads per row times rows, of whole tiles of the largest kind.
    rows.next_multiple_of(TILES[0]) * PARTS
}

/// 0..`rows` in parts for which `floats_per_row` fit a buffer of moderate size. Parts start at multiples of 64 rows.
pub fn parts(like: &CubeTensor, rows: usize, floats_per_row: usize) -> Vec<Range<usize>> {
    const MODERATE: u64 = 512 << 20;
    let fit = binding_bytes(&like.client).min(MODERATE) / (4 * floats_per_row.max(1)) as u64;
    let step = (fit as usize / 64 * 64).max(64);
    (0..rows).step_by(step).map(|first| first..(first + step).min(rows)).collect()
}

/// Steps in order.
#[derive(Clone, Debug, Default)]
pub struct Program(pub Vec<Step>);

impl Program {
    /// How to run it with inputs so wide on so many rows, given the bytes of shared memory; `None` where not even the smallest tile fits.
    pub fn layout(&self, input: usize, rows: usize, shared_bytes: usize) -> Option<Layout> {
        let sizes = || self.0.iter().map(Step::tiles_and_width);
        let tiles = 1 + sizes().map(|(tile, _)| tile).max().unwrap_or(0);
        // One more than the widest row: neighbouring blocks of rows then lie in different banks.
        let stride = 1 + sizes().map(|(_, width)| width).max().unwrap_or(0).max(input);
        let in_place = self.0.iter().map(|s| match s {
            Step::Multiply { source, target: Target::Tile(t), output, .. } if source == t => *output,
            _ => 0,
        });
        let widest = in_place.max().unwrap_or(0);
        // A layer that overwrites its own tile must be done in one pass: as many threads as blocks.
        let per_row = widest.div_ceil(BLOCK * BLOCK).max(2).next_power_of_two();
        let fits = |layout: &Layout| layout.bytes() <= shared_bytes && per_row <= PARTS && layout.threads() <= MAX_THREADS;
        let least = TILES[TILES.len() - 1];
        let layouts = TILES.map(|tile| Layout { tile, stride, tiles, per_row });
        layouts.into_iter().filter(fits).find(|layout| layout.tile == least || rows >= layout.tile * ENOUGH_WORKGROUPS)
    }
    /// The layout on the device of `like`.
    pub fn layout_on(&self, like: &CubeTensor, input: usize, rows: usize) -> Option<Layout> {
        self.layout(input, rows, shared_bytes(&like.client))
    }
    /// Runs all steps on these rows of the inputs; `given` is what [`Step::Load`] reads. Indices into `out` count from the first of these rows, those into
    /// `given` from row 0.
    pub fn run(&self, layout: Layout, input: Input, weights: &CubeTensor, given: &CubeTensor, out: &CubeTensor, rows: &Range<usize>) {
        if rows.is_empty() {
            return;
        }
        let client = weights.client.clone();
        let mut plan: Vec<u32> = self.0.iter().flat_map(|step| step.encode()).collect();
        let constants = plan.len();
        let (x, vertices, modulus) = match input {
            Input::Rows(x, _) => (x.clone(), None, 2),
            Input::Signatures(vertices, hash) => {
                plan.extend(hash.constants());
                // `x` is not read, but the kernel needs a binding of its type.
                (weights.clone(), Some(vertices.clone()), hash.modulus())
            }
        };
        let hashed = vertices.is_some();
        let plan = crate::cube::tensor::constant(weights, &plan, DType::U32);
        let vertices = vertices.unwrap_or_else(|| crate::cube::tensor::signed(plan.clone()));
        // SAFETY: rows beyond the last are neither read nor written; columns and indices are in bounds because weights, inputs and result have the sizes that
        // the steps were made for, which the operations check.
        unsafe {
            steps::run_steps::launch_unchecked(
                &client,
                spread(rows.len().div_ceil(layout.tile)),
                CubeDim::new_1d(layout.threads() as u32),
                x.into_buffer_arg(),
                vertices.into_buffer_arg(),
                plan.into_buffer_arg(),
                weights.clone().into_buffer_arg(),
                given.clone().into_buffer_arg(),
                out.clone().into_buffer_arg(),
                rows.start as u32,
                rows.len() as u32,
                self.0.len() as u32,
                input.width() as u32,
                constants as u32,
                modulus,
                2.0 / (modulus - 1) as f32,
                hashed,
                layout,
            )
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn multiply(source: usize, target: Target, input: usize, output: usize) -> Step {
        Step::Multiply { source, target, input, output, weights: 0, bias: None, relu: false, add: false }
    }

    #[test]
    fn tiles_shrink_with_shared_memory_and_rows() {
        let program = Program(vec![multiply(0, Target::Tile(0), 128, 128), multiply(0, Target::Out(0), 128, 32)]);
        let tile = |rows, bytes| program.layout(128, rows, bytes).map(|l| l.tile);
        assert_eq!(tile(1 << 20, 49_152), Some(64));
        assert_eq!(tile(1 << 20, 32_768), Some(32));
        assert_eq!(tile(1 << 20, 16_384), Some(16));
        assert_eq!(tile(1 << 20, 8_192), None);
        assert_eq!(tile(1, 49_152), Some(16));
    }

    #[test]
    fn a_layer_over_its_own_tile_is_done_in_one_pass() {
        let threads = |width| Program(vec![multiply(0, Target::Tile(0), width, width)]).layout(width, 16, 1 << 20).map(|l| l.threads());
        assert_eq!((threads(16), threads(128), threads(129), threads(1024), threads(1025)), (Some(32), Some(32), Some(64), Some(256), None));
        // A result that leaves the tiles may have any width.
        assert!(Program(vec![multiply(0, Target::Out(0), 16, 4000)]).layout(16, 16, 16_384).is_some());
    }
}
