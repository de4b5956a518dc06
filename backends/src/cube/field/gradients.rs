//! Gradients of weights: sums over all rows, taken per segment of rows and then over the segments, in order.

use super::layers::Dense;
use super::program::is_vertex;
use crate::cube::tensor::{THREADS, binding_bytes, constant, floats, signed, spread, workgroups_for};
use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Threads of a workgroup along either side of a matrix.
const SIDE: usize = 16;
/// Rows in shared memory at a time.
const CHUNK: usize = 8;
/// Lower bound on the rows of a segment, and upper bound on the segments.
const LEAST_ROWS: usize = 64;
const MOST_SEGMENTS: usize = 256;

/// A matrix `[rows, width]` inside a buffer: where it starts.
#[derive(Clone, Copy)]
pub struct Rows<'a> {
    pub buffer: &'a CubeTensor,
    pub at: usize,
}

impl<'a> Rows<'a> {
    /// All of a buffer.
    pub fn whole(buffer: &'a CubeTensor) -> Self {
        Self { buffer, at: 0 }
    }
}

/// The end of start..end, or the first row in it that holds no vertex (they come last): rows behind it were not computed.
#[cube]
fn end_of_vertices(vertices: &[i32], first: usize, start: usize, end: usize) -> usize {
    let mut low = start;
    let mut high = end;
    while low < high {
        let middle = (low + high) / 2;
        if is_vertex(vertices, first + middle) {
            low = middle + 1;
        } else {
            high = middle;
        }
    }
    low
}

/// Loads the next rows of a matrix `[_, width]` into shared memory, `per` times 16 of its columns; zeros where it ends.
#[cube]
fn load_rows(from: &[f32], at: usize, to: &mut Shared<[f32]>, row: usize, end: usize, first: usize, width: usize, #[comptime] per: usize) {
    let side = comptime!(SIDE * per);
    let mut index = UNIT_POS as usize;
    while index < comptime!(CHUNK * SIDE * per) {
        let (r, i) = (row + index / side, first + index % side);
        let mut value = 0.0f32;
        if r < end && i < width {
            value = from[at + r * width + i];
        }
        to[index] = value;
        index += THREADS as usize;
    }
}

/// Per segment of rows: x^T dy, and below it the sums of dy: partial `[segments, (in + 1) out]`. A thread computes `down` rows and `over` columns, 16 apart.
#[cube(launch_unchecked)]
fn outer_parts(
    x: &[f32],
    dy: &[f32],
    vertices: &[i32],
    partial: &mut [f32],
    x_at: u32,
    dy_at: u32,
    first: u32,
    rows: u32,
    input: u32,
    output: u32,
    segment: u32,
    segments: u32,
    #[comptime] down: usize,
    #[comptime] over: usize,
    #[comptime] listed: bool,
) {
    let mut xs = Shared::<[f32]>::new_slice(comptime!(CHUNK * SIDE * down));
    let mut ds = Shared::<[f32]>::new_slice(comptime!(CHUNK * SIDE * over));
    let (tile_down, tile_over) = (comptime!(SIDE * down), comptime!(SIDE * over));
    let (input, output) = (input as usize, output as usize);
    let (cubes_down, cubes_over) = (input.div_ceil(tile_down), output.div_ceil(tile_over));
    let part = CUBE_POS / (cubes_down * cubes_over);
    let first_i = CUBE_POS / cubes_over % cubes_down * tile_down;
    let first_o = CUBE_POS % cubes_over * tile_over;
    let thread = UNIT_POS as usize;
    let (ui, uo) = (thread / SIDE, thread % SIDE);
    let start = part * segment as usize;
    let mut end = select(start + (segment as usize) < rows as usize, start + segment as usize, rows as usize);
    if comptime!(listed) {
        end = end_of_vertices(vertices, first as usize, start, end);
    }
    let mut sums = Array::<f32>::new(comptime!(down * over));
    let mut totals = Array::<f32>::new(over);
    #[unroll]
    for k in 0..comptime!(down * over) {
        sums[k] = 0.0f32;
    }
    #[unroll]
    for b in 0..over {
        totals[b] = 0.0f32;
    }
    let mut row = start;
    while row < end {
        load_rows(x, x_at as usize, &mut xs, row, end, first_i, input, down);
        load_rows(dy, dy_at as usize, &mut ds, row, end, first_o, output, over);
        sync_cube();
        for r in 0..CHUNK {
            let mut ours = Array::<f32>::new(over);
            #[unroll]
            for b in 0..over {
                ours[b] = ds[r * tile_over + uo + SIDE * b];
                totals[b] += ours[b];
            }
            #[unroll]
            for a in 0..down {
                let value = xs[r * tile_down + ui + SIDE * a];
                #[unroll]
                for b in 0..over {
                    sums[a * over + b] = fma(value, ours[b], sums[a * over + b]);
                }
            }
        }
        sync_cube();
        row += CHUNK;
    }
    if part < segments as usize {
        let to = part * ((input + 1) * output);
        #[unroll]
        for b in 0..over {
            let o = first_o + uo + SIDE * b;
            if o < output {
                #[unroll]
                for a in 0..down {
                    let i = first_i + ui + SIDE * a;
                    if i < input {
                        partial[to + i * output + o] = sums[a * over + b];
                    }
                }
                if ui == 0 && first_i == 0 {
                    partial[to + input * output + o] = totals[b];
                }
            }
        }
    }
}

/// Sums over rows per segment of dz times the normalised values, then of dz alone: partial `[segments, 2 out]`.
#[cube(launch_unchecked)]
fn norm_parts(
    dz: &[f32],
    normalized: &[f32],
    vertices: &[i32],
    partial: &mut [f32],
    dz_at: u32,
    normalized_at: u32,
    first: u32,
    rows: u32,
    output: u32,
    segment: u32,
    #[comptime] listed: bool,
) {
    let output = output as usize;
    if ABSOLUTE_POS < partial.len() {
        let part = ABSOLUTE_POS / (2 * output);
        let which = ABSOLUTE_POS % (2 * output) / output;
        let o = ABSOLUTE_POS % output;
        let start = part * segment as usize;
        let mut end = select(start + (segment as usize) < rows as usize, start + segment as usize, rows as usize);
        if comptime!(listed) {
            end = end_of_vertices(vertices, first as usize, start, end);
        }
        let mut sum = 0.0f32;
        for row in start..end {
            let mut factor = 1.0f32;
            if which == 0 {
                factor = normalized[normalized_at as usize + row * output + o];
            }
            sum += factor * dz[dz_at as usize + row * output + o];
        }
        partial[ABSOLUTE_POS] = sum;
    }
}

/// Columns and slices of a workgroup of [`add_segments`].
const COLUMNS: usize = 32;
const SLICES: usize = THREADS as usize / COLUMNS;

/// Adds the segments up, into `gradient` at `at`, on top of what is there if `add`. A workgroup has few columns: slices of the segments, then the slices.
#[cube(launch)]
fn add_segments_kernel(partial: &[f32], gradient: &mut [f32], width: u32, segments: u32, at: u32, #[comptime] add: bool) {
    let mut slices = Shared::<[f32]>::new_slice(comptime!(COLUMNS * SLICES));
    let thread = UNIT_POS as usize;
    let (slice, width) = (thread / COLUMNS, width as usize);
    let column = CUBE_POS * COLUMNS + thread % COLUMNS;
    let mut sum = 0.0f32;
    if column < width {
        let mut segment = slice;
        while segment < segments as usize {
            sum += partial[segment * width + column];
            segment += SLICES;
        }
    }
    slices[thread] = sum;
    sync_cube();
    if slice == 0 && column < width {
        let mut total = 0.0f32;
        #[unroll]
        for k in 0..SLICES {
            total += slices[k * COLUMNS + thread];
        }
        if comptime!(add) {
            total += gradient[at as usize + column];
        }
        gradient[at as usize + column] = total;
    }
}

/// Adds up `segments` rows of `width` floats of `partial`, into `gradient` from `at` on, on top of what is there if `add`.
pub fn add_segments(partial: CubeTensor, gradient: &CubeTensor, width: usize, segments: usize, at: usize, add: bool) {
    let (p, to) = (partial.into_buffer_arg(), gradient.clone().into_buffer_arg());
    let (client, count) = (gradient.client.clone(), spread(width.div_ceil(COLUMNS)));
    add_segments_kernel::launch(&client, count, dim(), p, to, width as u32, segments as u32, at as u32, add);
}

/// The weights, then each matrix transposed at its own index: plan `[layers, 3]` holds index, inputs and outputs.
#[cube(launch)]
fn append_transposed(weights: &[f32], plan: &[u32], both: &mut [f32], layers: u32) {
    let count = both.len() / 2;
    if ABSOLUTE_POS < both.len() {
        if ABSOLUTE_POS < count {
            both[ABSOLUTE_POS] = weights[ABSOLUTE_POS];
        } else {
            let index = ABSOLUTE_POS - count;
            let mut value = 0.0f32;
            for layer in 0..layers as usize {
                let (at, input, output) = (plan[3 * layer] as usize, plan[3 * layer + 1] as usize, plan[3 * layer + 2] as usize);
                if index >= at && index < at + input * output {
                    let (o, i) = ((index - at) / input, (index - at) % input);
                    value = weights[at + i * output + o];
                }
            }
            both[ABSOLUTE_POS] = value;
        }
    }
}

fn dim() -> CubeDim {
    CubeDim::new_1d(THREADS)
}

/// How many segments, and of how many rows, for partial sums of `width` floats.
fn segments_of(like: &CubeTensor, rows: usize, width: usize) -> (usize, usize) {
    let most = (binding_bytes(&like.client) / (4 * width.max(1)) as u64).clamp(1, MOST_SEGMENTS as u64) as usize;
    let segment = rows.div_ceil(most).max(LEAST_ROWS).next_multiple_of(CHUNK);
    (rows.div_ceil(segment).max(1), segment)
}

/// 1, 2, 4 or 8 columns (or rows) per thread for so many.
fn per_thread(width: usize) -> usize {
    width.div_ceil(SIDE).next_power_of_two().min(8)
}

/// Sums over rows that go into one flat gradient.
#[derive(Clone, Copy)]
pub struct Sums<'a> {
    /// Receives the gradient of every weight at the index of that weight.
    pub gradient: &'a CubeTensor,
    /// The rows summed over.
    pub rows: usize,
    /// Whether they are added to what is there.
    pub add: bool,
    /// The vertices `[_,3]`, and the index of the one of row 0; `None` if every row counts. Rows without a vertex come last and are left out.
    pub listed: Option<(&'a CubeTensor, usize)>,
}

impl Sums<'_> {
    /// The vertices and the index of that of row 0; without vertices any integer tensor, which the kernels do not read.
    fn vertices(&self) -> (CubeTensor, u32) {
        self.listed.map_or_else(|| (signed(self.gradient.clone()), 0), |(vertices, first)| (vertices.clone(), first as u32))
    }
    fn finish(&self, partial: CubeTensor, width: usize, segments: usize, at: usize) {
        add_segments(partial, self.gradient, width, segments, at, self.add);
    }
    /// Gradient of W and b of layer `l` from its input and the gradient of its output.
    pub fn of_layer(&self, x: Rows, dy: Rows, l: Dense) {
        let width = (l.input + 1) * l.output;
        let (segments, segment) = segments_of(self.gradient, self.rows, width);
        let partial = floats(self.gradient, [segments * width]);
        let (down, over) = (per_thread(l.input), per_thread(l.output));
        let (vertices, first) = self.vertices();
        // SAFETY: every index is compared with the sizes of the two matrices and of the sums.
        unsafe {
            outer_parts::launch_unchecked(
                &self.gradient.client,
                spread(segments * l.input.div_ceil(SIDE * down) * l.output.div_ceil(SIDE * over)),
                dim(),
                x.buffer.clone().into_buffer_arg(),
                dy.buffer.clone().into_buffer_arg(),
                vertices.into_buffer_arg(),
                partial.clone().into_buffer_arg(),
                x.at as u32,
                dy.at as u32,
                first,
                self.rows as u32,
                l.input as u32,
                l.output as u32,
                segment as u32,
                segments as u32,
                down,
                over,
                self.listed.is_some(),
            )
        };
        self.finish(partial, width, segments, l.at);
    }
    /// Gradient of gain and shift `[width]` each, which follow each other from `at` on, from the gradient before Mish and the normalised values.
    pub fn of_norm(&self, dz: Rows, normalized: Rows, width: usize, at: usize) {
        let (segments, segment) = segments_of(self.gradient, self.rows, 2 * width);
        let partial = floats(self.gradient, [segments * 2 * width]);
        let (vertices, first) = self.vertices();
        // SAFETY: threads beyond the sums do nothing, rows end at `rows`.
        unsafe {
            norm_parts::launch_unchecked(
                &self.gradient.client,
                workgroups_for(segments * 2 * width),
                dim(),
                dz.buffer.clone().into_buffer_arg(),
                normalized.buffer.clone().into_buffer_arg(),
                vertices.into_buffer_arg(),
                partial.clone().into_buffer_arg(),
                dz.at as u32,
                normalized.at as u32,
                first,
                self.rows as u32,
                width as u32,
                segment as u32,
                self.listed.is_some(),
            )
        };
        self.finish(partial, 2 * width, segments, at);
    }
}

/// The weights, and behind them those of `layers` transposed.
pub fn with_transposed(weights: &CubeTensor, layers: &[Dense]) -> CubeTensor {
    let count = weights.meta.shape().num_elements();
    let both = floats(weights, [2 * count]);
    let plan: Vec<u32> = layers.iter().flat_map(|l| [l.at as u32, l.input as u32, l.output as u32]).collect();
    let plan = constant(weights, &plan, DType::U32);
    let client = weights.client.clone();
    let (w, p, b) = (weights.clone().into_buffer_arg(), plan.into_buffer_arg(), both.clone().into_buffer_arg());
    append_transposed::launch(&client, workgroups_for(2 * count), dim(), w, p, b, layers.len() as u32);
    both
}
