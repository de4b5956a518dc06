//! Small networks in one launch. A cube keeps a tile of rows in shared memory and takes it through all layers, so that activations never leave the chip; the
//! layers are a list of numbers, so that one kernel serves decoders (behind their hash signatures) and deformation networks alike.
//!
//! A unit computes four columns of four rows from eight loads per input. Widths that do not fit the shared memory go layer by layer instead.

use super::decoder::{EPSILON, mish, signature};
use crate::cpu::vertex::hash::LevelHash;
use crate::cube::tensor::{UNITS, spread, upload};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Rows and columns a unit computes.
const BLOCK: usize = 4;
/// Rows a cube may keep, the more the better: weights are read once per tile.
const TILES: [usize; 2] = [32, 16];
/// Numbers per layer in a plan.
const FIELDS: usize = 8;
/// Stands for "none".
const NONE: u32 = u32::MAX;

/// Where a layer reads or writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// The tile the inputs are in.
    First,
    /// The other tile.
    Second,
    /// The result, from this element on.
    Output(usize),
}

/// One layer.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    pub input: usize,
    pub output: usize,
    /// Where W [in, out] starts among the weights; b [out] follows.
    pub weights: usize,
    /// Where the norm's gain starts, if LayerNorm and Mish follow; its shift comes behind.
    pub norm: Option<usize>,
    pub relu: bool,
    pub source: Place,
    pub target: Place,
}

/// Layers in order.
#[derive(Clone, Debug, Default)]
pub struct Program(pub Vec<Step>);

/// What the first layer reads.
pub enum Input<'a> {
    /// Rows [rows, in].
    Rows(&'a CubeTensor),
    /// Signatures of vertices [rows, 3].
    Signatures(&'a CubeTensor, &'a LevelHash),
}

impl Program {
    /// The widest row a tile must hold.
    fn stride(&self) -> usize {
        self.0.iter().flat_map(|s| [s.input, if matches!(s.target, Place::Output(_)) { 0 } else { s.output }]).max().unwrap_or(1)
    }
    fn tiles(&self) -> usize {
        1 + usize::from(self.0.iter().any(|s| s.target == Place::Second))
    }
    /// Rows per cube on a device with so many bytes of shared memory; `None` if not even the smallest tile fits.
    fn rows_per_cube(&self, shared_bytes: usize) -> Option<usize> {
        TILES.into_iter().find(|&rows| {
            let floats = rows * self.stride() * self.tiles() + UNITS as usize;
            let blocks = self.0.iter().map(|s| rows / BLOCK * s.output.div_ceil(BLOCK)).max().unwrap_or(0);
            4 * floats <= shared_bytes && blocks <= UNITS as usize
        })
    }
    fn plan(&self) -> Vec<u32> {
        let place = |p: Place| match p {
            Place::First => 0,
            Place::Second => 1,
            Place::Output(_) => 2,
        };
        self.0
            .iter()
            .flat_map(|s| {
                let at = if let Place::Output(at) = s.target { at as u32 } else { 0 };
                let norm = s.norm.map_or(NONE, |n| n as u32);
                [s.input as u32, s.output as u32, s.weights as u32, norm, u32::from(s.relu), place(s.source), place(s.target), at]
            })
            .collect()
    }
    /// Runs all layers on `rows` rows into `out`. False, and nothing done, where the device has too little shared memory.
    pub fn run(&self, input: &Input, weights: &CubeTensor, out: &CubeTensor, rows: usize) -> bool {
        let client = weights.client.clone();
        let Some(tile) = self.rows_per_cube(client.properties().hardware.max_shared_memory_size) else { return false };
        if rows == 0 {
            return true;
        }
        let (x, constants, hashes, modulus) = match input {
            Input::Rows(x) => ((*x).clone(), upload(weights, &[0u32], DType::U32), 0, 2),
            Input::Signatures(vertices, hash) => ((*vertices).clone(), upload(weights, &hash.constants(), DType::U32), hash.len() as u32, hash.modulus()),
        };
        let hashed = matches!(input, Input::Signatures(..));
        // The input that is not read still needs a binding of its kind.
        let unread = if hashed { upload(weights, &[0.0f32], DType::F32) } else { upload(weights, &[0i32], DType::I32) };
        let (x, vertices) = if hashed { (unread, x) } else { (x, unread) };
        run_layers::launch(
            &client,
            spread(rows.div_ceil(tile)),
            CubeDim::new_1d(UNITS),
            x.into_buffer_arg(),
            vertices.into_buffer_arg(),
            constants.into_buffer_arg(),
            weights.clone().into_buffer_arg(),
            upload(weights, &self.plan(), DType::U32).into_buffer_arg(),
            out.clone().into_buffer_arg(),
            rows as u32,
            self.0.len() as u32,
            self.0.first().map_or(0, |s| s.input) as u32,
            hashes,
            modulus,
            2.0 / (modulus - 1) as f32,
            hashed,
            tile,
            self.stride(),
            self.tiles(),
        );
        true
    }
}

/// See [`Program::run`].
#[cube(launch)]
fn run_layers(
    x: &[f32],
    vertices: &[i32],
    constants: &[u32],
    weights: &[f32],
    plan: &[u32],
    out: &mut [f32],
    rows: u32,
    steps: u32,
    first_input: u32,
    hashes: u32,
    modulus: u32,
    scale: f32,
    #[comptime] hashed: bool,
    #[comptime] tile: usize,
    #[comptime] stride: usize,
    #[comptime] tiles: usize,
) {
    let mut kept = Shared::<[f32]>::new_slice(comptime!(tile * stride * tiles));
    let mut partial = Shared::<[f32]>::new_slice(UNITS as usize);
    let unit = UNIT_POS as usize;
    let first = CUBE_POS * tile;
    let rows = rows as usize;
    let inputs = first_input as usize;
    let mut place = unit;
    while place < tile * inputs {
        let (r, i) = (place / inputs, place % inputs);
        // Rows beyond the last repeat it; they are not written.
        let row = select(first + r < rows, first + r, rows - 1);
        if comptime!(hashed) {
            kept[r * stride + i] = signature(vertices, constants, row, i, hashes as usize, modulus, scale);
        } else {
            kept[r * stride + i] = x[row * inputs + i];
        }
        place += UNITS as usize;
    }
    sync_cube();
    for step in 0..steps as usize {
        let at = FIELDS * step;
        let (input, output, base, norm) = (plan[at] as usize, plan[at + 1] as usize, plan[at + 2] as usize, plan[at + 3]);
        let (relu, source, target, start) = (plan[at + 4], plan[at + 5] as usize, plan[at + 6] as usize, plan[at + 7] as usize);
        let column_blocks = output.div_ceil(4usize);
        let row = unit / column_blocks * 4;
        let column = unit % column_blocks * 4;
        let active = row < tile;
        let mut sums = Array::<f32>::new(16usize);
        if active {
            // Columns beyond the last repeat it; they are not written.
            let c0 = column;
            let c1 = select(column + 1 < output, column + 1, output - 1);
            let c2 = select(column + 2 < output, column + 2, output - 1);
            let c3 = select(column + 3 < output, column + 3, output - 1);
            let bias = base + input * output;
            #[unroll]
            for r in 0..4usize {
                sums[4 * r] = weights[bias + c0];
                sums[4 * r + 1] = weights[bias + c1];
                sums[4 * r + 2] = weights[bias + c2];
                sums[4 * r + 3] = weights[bias + c3];
            }
            let from = source * (tile * stride) + row * stride;
            for i in 0..input {
                let line = base + i * output;
                let (w0, w1, w2, w3) = (weights[line + c0], weights[line + c1], weights[line + c2], weights[line + c3]);
                #[unroll]
                for r in 0..4usize {
                    let value = kept[from + r * stride + i];
                    sums[4 * r] += value * w0;
                    sums[4 * r + 1] += value * w1;
                    sums[4 * r + 2] += value * w2;
                    sums[4 * r + 3] += value * w3;
                }
            }
        }
        // Everybody has read before anybody writes to the same tile.
        sync_cube();
        if active {
            #[unroll]
            for r in 0..4usize {
                #[unroll]
                for c in 0..4usize {
                    if column + c < output {
                        let sum = sums[4 * r + c];
                        let value = select(relu == 1 && sum <= 0.0, 0.0f32, sum);
                        if target < 2usize {
                            kept[target * (tile * stride) + (row + r) * stride + column + c] = value;
                        } else if first + row + r < rows {
                            out[start + (first + row + r) * output + column + c] = value;
                        }
                    }
                }
            }
        }
        sync_cube();
        if norm != NONE {
            // Several units share a row; their sums are added in order.
            let per_row = comptime!(UNITS as usize / tile);
            let (r, part) = (unit / per_row, unit % per_row);
            let line = target * (tile * stride) + r * stride;
            let width = output as f32;
            let mut sum = 0.0f32;
            let mut i = part;
            while i < output {
                sum += kept[line + i];
                i += per_row;
            }
            partial[unit] = sum;
            sync_cube();
            let mut mean = 0.0f32;
            for k in 0..per_row {
                mean += partial[r * per_row + k];
            }
            mean /= width;
            sync_cube();
            let mut squares = 0.0f32;
            i = part;
            while i < output {
                let d = kept[line + i] - mean;
                squares += d * d;
                i += per_row;
            }
            partial[unit] = squares;
            sync_cube();
            let mut variance = 0.0f32;
            for k in 0..per_row {
                variance += partial[r * per_row + k];
            }
            let inverse = 1.0 / (variance / width + EPSILON).sqrt();
            let gain = norm as usize;
            i = part;
            while i < output {
                kept[line + i] = mish((kept[line + i] - mean) * inverse * weights[gain + i] + weights[gain + output + i]);
                i += per_row;
            }
            sync_cube();
        }
    }
}
