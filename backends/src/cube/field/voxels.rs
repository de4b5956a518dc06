//! Grid corners of points, which of them are the same, and interpolation between them.

use crate::cube::sort::{exclusive_sums, sort_pairs};
use crate::cube::tensor::{THREADS, constant, empty, floats, signed, upload, workgroups_for};
use crate::ops::corners::{CornersBegun, GridBox};
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

/// Keys of the vertices and trilinear weights of all (point, corner) slots `[8M]`; corner c lies at offsets (c & 1, c >> 1 & 1, c >> 2).
#[cube(launch)]
fn find_corners(points: &[f32], grid: &[f32], keys: &mut [u32], slots: &mut [u32], weights: &mut [f32], resolution: u32) {
    let slot = ABSOLUTE_POS;
    if slot < keys.len() {
        let point = slot / 8;
        let corner = (slot % 8) as u32;
        let side = resolution + 1;
        let mut key = 0u32;
        let mut parts = Array::<f32>::new(3usize);
        #[unroll]
        for step in 0..3usize {
            // The last axis is the most significant.
            let d = comptime!(2 - step);
            let raw = (points[3 * point + d] - grid[d]) * grid[3 + d];
            // Comparisons with NaN are false: it goes to the lower face.
            let low = select(raw > 0.0, raw, 0.0f32);
            let at = select(low < resolution as f32, low, resolution as f32);
            let floor = at as u32;
            let cell = select(floor < resolution, floor, resolution - 1);
            let part = at - cell as f32;
            let offset = (corner >> (d as u32)) & 1u32;
            parts[d] = select(offset == 1, part, 1.0 - part);
            key = key * side + cell + offset;
        }
        keys[slot] = key;
        slots[slot] = slot as u32;
        // In the order of the CPU.
        weights[slot] = parts[0] * parts[1] * parts[2];
    }
}

/// 1 where a sorted key differs from the one before it.
#[cube(launch)]
fn mark_heads(sorted: &[u32], heads: &mut [u32]) {
    if ABSOLUTE_POS < heads.len() {
        let mut head = 1u32;
        if ABSOLUTE_POS > 0 {
            head = select(sorted[ABSOLUTE_POS] != sorted[ABSOLUTE_POS - 1], 1u32, 0u32);
        }
        heads[ABSOLUTE_POS] = head;
    }
}

/// Vertices, where their slots start, and the vertex of every slot, from the sorted keys and the number of heads before each. Behind the last vertex there are
/// -1 and no slots.
#[cube(launch)]
fn list_vertices(sorted: &[u32], slots: &[u32], before: &[u32], vertices: &mut [i32], starts: &mut [i32], corners: &mut [i32], resolution: u32, capacity: u32) {
    let at = ABSOLUTE_POS;
    if at < sorted.len() {
        let key = sorted[at];
        let mut head = true;
        if at > 0 {
            head = key != sorted[at - 1];
        }
        // `before` counts the heads in front, which is the vertex's own index if this is its head.
        let vertex = before[at] - select(head, 0u32, 1u32);
        let side = resolution + 1;
        if head {
            vertices[3 * vertex as usize] = (key % side) as i32;
            vertices[3 * vertex as usize + 1] = (key / side % side) as i32;
            vertices[3 * vertex as usize + 2] = (key / (side * side)) as i32;
            starts[vertex as usize] = at as i32;
        }
        corners[slots[at] as usize] = vertex as i32;
    }
    let last = sorted.len() - 1;
    let mut found = before[last] + 1;
    if last > 0 {
        found = before[last] + select(sorted[last] != sorted[last - 1], 1u32, 0u32);
    }
    if at >= found as usize && at <= capacity as usize {
        starts[at] = sorted.len() as i32;
        if at < capacity as usize {
            #[unroll]
            for d in 0..3usize {
                vertices[3 * at + d] = -1i32;
            }
        }
    }
}

/// out `[M,F]`: the features of the eight corners, weighted.
#[cube(launch)]
fn interpolate_corners(features: &[f32], corners: &[i32], weights: &[f32], out: &mut [f32], width: u32) {
    if ABSOLUTE_POS < out.len() {
        let (point, f) = (ABSOLUTE_POS / width as usize, ABSOLUTE_POS % width as usize);
        let mut sum = 0.0f32;
        for c in 0..8usize {
            sum += weights[8 * point + c] * features[corners[8 * point + c] as usize * width as usize + f];
        }
        out[ABSOLUTE_POS] = sum;
    }
}

/// Slices of the slots of a vertex where vertices have many.
const SLICES: usize = 8;

/// Gradient `[U,F]` of the features: each vertex visits its slots in order, in `slices` slices that are added up in order, so nothing is scattered.
#[cube(launch)]
fn gather_gradients(grad: &[f32], weights: &[f32], slots: &[i32], starts: &[i32], out: &mut [f32], width: u32, #[comptime] slices: usize) {
    let mut sums = Shared::<[f32]>::new_slice(THREADS as usize);
    let per = comptime!(THREADS as usize / slices);
    let thread = UNIT_POS as usize;
    let (slice, item) = (thread / per, CUBE_POS * per + thread % per);
    let mut sum = 0.0f32;
    if item < out.len() {
        let (vertex, f) = (item / width as usize, item % width as usize);
        let mut index = starts[vertex] as usize + slice;
        let end = starts[vertex + 1] as usize;
        while index < end {
            let slot = slots[index] as usize;
            sum += weights[slot] * grad[slot / 8 * width as usize + f];
            index += slices;
        }
    }
    sums[thread] = sum;
    sync_cube();
    if slice == 0 && item < out.len() {
        let mut total = 0.0f32;
        #[unroll]
        for k in 0..slices {
            total += sums[k * per + thread];
        }
        out[item] = total;
    }
}

/// The corners of `points` `[M,3]`, grouped by vertex; their number stays on the device.
pub fn begin(points: &CubeTensor, grid: GridBox, reuse: bool) -> CornersBegun<CubeBackend> {
    let client = points.client.clone();
    let slots_count = 8 * points.meta.shape()[0];
    let dim = CubeDim::new_1d(THREADS);
    let scale = (0..3).map(|d| if grid.max[d] > grid.min[d] { grid.resolution as f32 / (grid.max[d] - grid.min[d]) } else { 0.0 });
    let numbers: Vec<f32> = grid.min.into_iter().chain(scale).collect();
    let grid_buffer = constant(points, &numbers, DType::F32);
    let (keys, slots) = (empty(points, [slots_count], DType::U32), empty(points, [slots_count], DType::U32));
    let weights = floats(points, [slots_count]);
    find_corners::launch(
        &client,
        workgroups_for(slots_count),
        dim,
        points.clone().into_buffer_arg(),
        grid_buffer.into_buffer_arg(),
        keys.clone().into_buffer_arg(),
        slots.clone().into_buffer_arg(),
        weights.clone().into_buffer_arg(),
        grid.resolution,
    );
    let unused = || empty(points, [1], DType::I32);
    if !reuse {
        let count = upload(points, &[slots_count as i32], DType::I32);
        return CornersBegun { weights, slots: signed(slots), vertices: signed(keys), starts: unused(), corners: unused(), count };
    }
    let side = u64::from(grid.resolution) + 1;
    let (sorted, slots) = sort_pairs(keys, slots, slots_count, u64::BITS - (side * side * side).leading_zeros());
    let heads = empty(points, [slots_count], DType::U32);
    mark_heads::launch(&client, workgroups_for(slots_count), dim, sorted.clone().into_buffer_arg(), heads.clone().into_buffer_arg());
    let count = exclusive_sums(&heads, slots_count);
    CornersBegun { weights, slots: signed(slots), vertices: signed(sorted), starts: signed(heads), corners: unused(), count: signed(count) }
}

/// Vertices `[U,3]`, where their slots start `[U+1]`, and the vertex of every corner `[8M]`, with a capacity of U.
pub fn list(slots: CubeTensor, sorted: CubeTensor, before: CubeTensor, grid: GridBox, reuse: bool, capacity: usize) -> (CubeTensor, CubeTensor, CubeTensor) {
    let client = slots.client.clone();
    let dim = CubeDim::new_1d(THREADS);
    let slots_count = slots.meta.shape().num_elements();
    let int = |shape: Vec<usize>| empty(&slots, shape, DType::I32);
    let (vertices, starts, corners) = (int(vec![capacity, 3]), int(vec![capacity + 1]), int(vec![slots_count]));
    let (v, st, c) = (vertices.clone().into_buffer_arg(), starts.clone().into_buffer_arg(), corners.clone().into_buffer_arg());
    let s = sorted.into_buffer_arg();
    if reuse {
        let (l, b) = (slots.into_buffer_arg(), before.into_buffer_arg());
        list_vertices::launch(&client, workgroups_for(slots_count.max(capacity + 1)), dim, s, l, b, v, st, c, grid.resolution, capacity as u32);
    } else {
        list_all::launch(&client, workgroups_for(slots_count), dim, s, v, st, c, grid.resolution);
    }
    (vertices, starts, corners)
}

/// Without reuse every slot has a vertex of its own.
#[cube(launch)]
fn list_all(keys: &[u32], vertices: &mut [i32], starts: &mut [i32], corners: &mut [i32], resolution: u32) {
    let at = ABSOLUTE_POS;
    if at < keys.len() {
        let (key, side) = (keys[at], resolution + 1);
        vertices[3 * at] = (key % side) as i32;
        vertices[3 * at + 1] = (key / side % side) as i32;
        vertices[3 * at + 2] = (key / (side * side)) as i32;
        starts[at] = at as i32;
        corners[at] = at as i32;
        if at == 0 {
            starts[keys.len()] = keys.len() as i32;
        }
    }
}

/// Interpolated features `[M,F]`.
pub fn interpolate(features: CubeTensor, corners: CubeTensor, weights: CubeTensor) -> CubeTensor {
    let width = features.meta.shape()[1];
    let points = corners.meta.shape().num_elements() / 8;
    let out = floats(&features, [points, width]);
    let client = features.client.clone();
    let (f, c, w, o) = (features.into_buffer_arg(), corners.into_buffer_arg(), weights.into_buffer_arg(), out.clone().into_buffer_arg());
    interpolate_corners::launch(&client, workgroups_for(points * width), CubeDim::new_1d(THREADS), f, c, w, o, width as u32);
    out
}

/// Gradient `[U,F]` of the features.
pub fn interpolate_backward(grad: CubeTensor, weights: CubeTensor, slots: CubeTensor, starts: CubeTensor) -> CubeTensor {
    let width = grad.meta.shape()[1];
    let vertices = starts.meta.shape().num_elements().saturating_sub(1);
    let out = floats(&grad, [vertices, width]);
    let client = grad.client.clone();
    // Few vertices are few threads, each with many slots.
    let slices = if slots.meta.shape().num_elements() >= 2 * SLICES * vertices { SLICES } else { 1 };
    let (g, w) = (grad.into_buffer_arg(), weights.into_buffer_arg());
    let (s, st, o) = (slots.into_buffer_arg(), starts.into_buffer_arg(), out.clone().into_buffer_arg());
    gather_gradients::launch(&client, workgroups_for(vertices * width * slices), CubeDim::new_1d(THREADS), g, w, s, st, o, width as u32, slices);
    out
}
