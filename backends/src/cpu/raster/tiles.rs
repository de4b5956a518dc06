//! Depth order and tile lists. Walking the Gaussians in depth order and appending to the lists keeps every list sorted, so only the
//! Gaussians are sorted, not the pairs.

use super::camera::RuleConstants;
use super::parallel::{SharedMut, run_tasks};
use super::project::CHUNK;
use super::scratch::{Buffers, EMPTY_STRIP, Entry, Footprint, Pair, STRIP_BITS, Workspace, set_len, strips};
use super::{RasterSettings, ScreenSplat, TILE};
use crate::cpu::simd::{dispatch, prefetch};
use pulp::{Simd, WithSimd};

/// Binning tasks. The lists do not depend on it.
const TASKS: usize = 8;
/// Prefetch distance.
const AHEAD: usize = 8;
/// Most bits of a digit of the radix sort: two digits for depths over four octaves.
const MOST_BITS: u32 = 13;
/// What rounding moves the edge of a footprint by, vertically, as a share of the offset of its columns' centres: some twenty roundings of float32.
const ROUNDING: f32 = 2e-6;

/// Fills `ranked`, the tile lists and the record positions from the slots.
pub fn build_lists(settings: &RasterSettings, rules: &RuleConstants, workspace: &mut Workspace) {
    let buffers = &mut **workspace;
    sort_by_depth(buffers);
    let visible = buffers.order.len();
    let tiles_x = settings.width.div_ceil(TILE);
    let tiles = tiles_x * settings.height.div_ceil(TILE);
    set_len(&mut buffers.ranked, visible);
    set_len(&mut buffers.rank_of_slot, buffers.slots.len());
    set_len(&mut buffers.pair_start, visible + 1);
    set_len(&mut buffers.histograms, TASKS * tiles);
    buffers.pairs.resize_with(TASKS, Vec::new);
    let per_task = visible.div_ceil(TASKS).max(1);
    {
        let pairs = SharedMut::new(&mut buffers.pairs);
        let histograms = SharedMut::new(&mut buffers.histograms);
        let ranked = SharedMut::new(&mut buffers.ranked);
        let starts = SharedMut::new(&mut buffers.pair_start);
        let rank_of_slot = SharedMut::new(&mut buffers.rank_of_slot);
        let (slots, footprints, order) = (&buffers.slots, &buffers.footprints, &buffers.order);
        run_tasks(TASKS, |task| {
            let first = (task * per_task).min(visible);
            let len = per_task.min(visible - first);
            // SAFETY: ranks and tasks belong to one task each.
            let (pairs, histogram, ranked, starts) =
                unsafe { (&mut pairs.slice(task, 1)[0], histograms.slice(task * tiles, tiles), ranked.slice(first, len), starts.slice(first, len)) };
            dispatch(Bin { settings, rules, slots, footprints, order: &order[first..first + len], first, pairs, histogram, ranked, starts, rank_of_slot });
        });
    }
    fill_lists(buffers, tiles, per_task);
}

/// One binning task: a run of the depth order.
struct Bin<'a> {
    settings: &'a RasterSettings,
    rules: &'a RuleConstants,
    slots: &'a [ScreenSplat],
    footprints: &'a [Footprint],
    order: &'a [u64],
    first: usize,
    pairs: &'a mut Vec<Pair>,
    histogram: &'a mut [u32],
    ranked: &'a mut [ScreenSplat],
    starts: &'a mut [u32],
    rank_of_slot: SharedMut<'a, u32>,
}

impl WithSimd for Bin<'_> {
    type Output = ();
    // No vectors here: the instruction set is for rounding, fused steps and the width of strips.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { settings, rules, slots, footprints, order, first, pairs, histogram, ranked, starts, rank_of_slot } = self;
        pairs.clear();
        histogram.fill(0);
        for (k, key) in order.iter().enumerate() {
            if let Some(&ahead) = order.get(k + AHEAD) {
                prefetch(slots, ahead as u32 as usize);
                prefetch(footprints, ahead as u32 as usize);
            }
            let slot = *key as u32 as usize;
            let splat = slots[slot];
            ranked[k] = splat;
            let rank = (first + k) as u32;
            // SAFETY: a slot occurs once in the order.
            unsafe { rank_of_slot.slice(slot, 1)[0] = rank };
            starts[k] = pairs.len() as u32;
            let limits = if rules.square_tiles { Some(square(splat.center, splat.radius, settings)) } else { None };
            cut_into_tiles::<S>(
                &splat,
                &footprints[slot],
                [settings.width, settings.height],
                limits,
                #[inline(always)]
                |tile, rows| {
                    histogram[tile] += 1;
                    pairs.push(Pair { tile: tile as u32, rank, rows });
                },
            );
        }
    }
}

/// Sorts the visible slots by depth, ties by index.
fn sort_by_depth(buffers: &mut Buffers) {
    buffers.order.clear();
    for (chunk, &(count, _)) in buffers.chunk_counts.iter().enumerate() {
        let slots = chunk * CHUNK..chunk * CHUNK + count as usize;
        // Slots have positive depths, whose bits order like the numbers, and come in order of index.
        buffers.order.extend(slots.map(|slot| u64::from(buffers.slots[slot].depth.to_bits()) << 32 | slot as u64));
    }
    let keys = buffers.order.iter().map(|v| (v >> 32) as u32);
    let (low, high) = keys.fold((u32::MAX, 0), |(low, high), key| (low.min(key), high.max(key)));
    if high <= low {
        return;
    }
    let bits = 32 - (high - low).leading_zeros();
    let len = buffers.order.len();
    set_len(&mut buffers.order_spare, len);
    let passes = bits.div_ceil(MOST_BITS);
    let width = bits.div_ceil(passes);
    let mut counts = vec![0u32; 1 << width];
    for pass in 0..passes {
        let digit = |v: u64| (((v >> 32) as u32 - low) >> (pass * width)) as usize & ((1 << width) - 1);
        counts.fill(0);
        for &v in &buffers.order {
            counts[digit(v)] += 1;
        }
        let mut start = 0;
        for count in &mut counts {
            (*count, start) = (start, start + *count);
        }
        for &v in &buffers.order {
            let next = &mut counts[digit(v)];
            buffers.order_spare[*next as usize] = v;
            *next += 1;
        }
        std::mem::swap(&mut buffers.order, &mut buffers.order_spare);
    }
}

/// Tile rectangle of Inria's getRect for a `radius` of whole pixels: first and end per axis. Empty if the square misses the image.
pub fn square(center: [f32; 2], radius: f32, settings: &RasterSettings) -> [[usize; 2]; 2] {
    let axis = |center: f32, size: usize| {
        let tiles = size.div_ceil(TILE);
        // Inria counts pixels from their centres: column 0 is at 0, not at 0.5.
        let center = center - 0.5;
        // Casting truncates towards zero and saturates, as in C but defined.
        let first = ((center - radius) / TILE as f32) as i64;
        let end = ((center + radius + (TILE - 1) as f32) / TILE as f32) as i64;
        [first.clamp(0, tiles as i64) as usize, end.clamp(0, tiles as i64) as usize]
    };
    [axis(center[0], settings.width), axis(center[1], settings.height)]
}

/// Half the height of the footprint at `dx` from its centre, pixels.
#[inline(always)]
fn half_column(splat: &ScreenSplat, foot: &Footprint, dx: f32) -> f32 {
    foot.aspect * ((splat.half_width - dx) * (splat.half_width + dx)).max(0.0).sqrt()
}

/// First and last row of the image with pixel centres inside the footprint in the columns `from` to `to`; none where the first is over the last.
#[inline(always)]
fn rows_between(splat: &ScreenSplat, foot: &Footprint, height: usize, from: usize, to: usize) -> [usize; 2] {
    const NONE: [usize; 2] = [1, 0];
    let [x, y] = splat.center;
    // The strip between the outermost pixel centres, relative to the centre of the Gaussian.
    let left = (from as f32 + 0.5 - x).max(-splat.half_width);
    let right = (to as f32 + 0.5 - x).min(splat.half_width);
    if left > right {
        return NONE;
    }
    let dx_bottom = foot.x_of_bottom.max(left).min(right);
    let dx_top = (-foot.x_of_bottom).max(left).min(right);
    let (middle_bottom, middle_top) = (foot.slope * dx_bottom, foot.slope * dx_top);
    let bottom = (middle_bottom + (half_column(splat, foot, dx_bottom) + ROUNDING * middle_bottom.abs())).min(foot.half_height);
    let top = (middle_top - (half_column(splat, foot, dx_top) + ROUNDING * middle_top.abs())).max(-foot.half_height);
    let last = (y + bottom - 0.5).floor();
    if last < 0.0 || last.is_nan() {
        return NONE;
    }
    [(y + top - 0.5).ceil().max(0.0) as usize, (last as usize).min(height - 1)]
}

/// Calls `found(tile, rows)` for every tile of an image of `size` (width, height) with a pixel centre inside the footprint; `rows` are those of [`Entry`].
#[inline(always)]
fn cut_into_tiles<S: Simd>(splat: &ScreenSplat, foot: &Footprint, size: [usize; 2], limits: Option<[[usize; 2]; 2]>, mut found: impl FnMut(usize, u32)) {
    let x = splat.center[0];
    let tiles_x = size[0].div_ceil(TILE);
    let first_column = (x - splat.half_width - 0.5).ceil().max(0.0) as usize;
    let last_column = ((x + splat.half_width - 0.5).floor().max(0.0) as usize).min(size[0] - 1);
    if first_column > last_column {
        return;
    }
    let (mut first_tile, mut end_tile) = (first_column / TILE, last_column / TILE + 1);
    if let Some([columns, _]) = limits {
        (first_tile, end_tile) = (first_tile.max(columns[0]), end_tile.min(columns[1]));
    }
    let strips = strips::<S>();
    let width = TILE / strips;
    for tile_x in first_tile..end_tile {
        let mut reached = [[1, 0]; 4];
        let (mut first_row, mut last_row) = (usize::MAX, 0);
        for (strip, rows) in reached.iter_mut().enumerate().take(strips) {
            let from = tile_x * TILE + strip * width;
            *rows = rows_between(splat, foot, size[1], from, from + width - 1);
            if rows[0] <= rows[1] {
                (first_row, last_row) = (first_row.min(rows[0]), last_row.max(rows[1]));
            }
        }
        if first_row > last_row {
            continue;
        }
        let (mut first, mut end) = (first_row / TILE, last_row / TILE + 1);
        if let Some([_, rows]) = limits {
            (first, end) = (first.max(rows[0]), end.min(rows[1]));
        }
        for tile_y in first..end {
            let top = tile_y * TILE;
            let mut packed = 0;
            for (strip, rows) in reached.iter().enumerate().take(strips) {
                let (from, to) = (rows[0].max(top), rows[1].min(top + TILE - 1));
                let bits = if from > to { EMPTY_STRIP } else { ((from - top) | ((to - top) << 4)) as u32 };
                packed |= bits << (STRIP_BITS * strip as u32);
            }
            found(tile_y * tiles_x + tile_x, packed);
        }
    }
}

/// Turns the pairs of the binning tasks into one list per tile.
fn fill_lists(buffers: &mut Buffers, tiles: usize, per_task: usize) {
    set_len(&mut buffers.tile_start, tiles + 1);
    let mut position = 0u32;
    for tile in 0..tiles {
        buffers.tile_start[tile] = position;
        for task in 0..TASKS {
            let count = &mut buffers.histograms[task * tiles + tile];
            (*count, position) = (position, position + *count);
        }
    }
    buffers.tile_start[tiles] = position;
    set_len(&mut buffers.list, position as usize);
    set_len(&mut buffers.list_index_of_pair, position as usize);
    let mut base = [0u32; TASKS + 1];
    for task in 0..TASKS {
        base[task + 1] = base[task] + buffers.pairs[task].len() as u32;
    }
    let visible = buffers.ranked.len();
    {
        let list = SharedMut::new(&mut buffers.list);
        let list_indices = SharedMut::new(&mut buffers.list_index_of_pair);
        let histograms = SharedMut::new(&mut buffers.histograms);
        let starts = SharedMut::new(&mut buffers.pair_start);
        let pairs = &buffers.pairs;
        run_tasks(TASKS, |task| {
            let first = (task * per_task).min(visible);
            let pairs = &pairs[task];
            // SAFETY: a task's ranks, pairs and histogram are its own, and so are the list entries counted in the histogram.
            let (next, starts, list_indices) = unsafe {
                let starts = starts.slice(first, per_task.min(visible - first));
                (histograms.slice(task * tiles, tiles), starts, list_indices.slice(base[task] as usize, pairs.len()))
            };
            for start in starts {
                *start += base[task];
            }
            for (pair, list_index) in pairs.iter().zip(list_indices) {
                let entry = &mut next[pair.tile as usize];
                // SAFETY: as above.
                unsafe { list.slice(*entry as usize, 1)[0] = Entry { rank: pair.rank, rows: pair.rows } };
                *list_index = *entry;
                *entry += 1;
            }
        });
    }
    buffers.pair_start[visible] = position;
    buffers.tile_order.clear();
    buffers.tile_order.extend(0..tiles as u32);
    let starts = &buffers.tile_start;
    let length = |&tile: &u32| starts[tile as usize + 1] - starts[tile as usize];
    buffers.tile_order.sort_by_key(|tile| (std::cmp::Reverse(length(tile)), *tile));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Asserts that lists with strips for `S` have every pixel centre of a turned ellipse, and returns how many pixels they have.
    fn listed<S: Simd>() -> usize {
        let size = [50, 45];
        let ([xx, xy, yy], reach) = ([30.0f32, 17.0, 14.0], 9.0f32);
        let determinant = xx * yy - xy * xy;
        let l1 = (0.5 * yy / determinant).sqrt();
        let factors = [l1, -xy / yy * l1, (0.5 / yy).sqrt()];
        let half_height = (reach * yy).sqrt();
        let splat = ScreenSplat { center: [21.3, 18.9], factors, half_width: (reach * xx).sqrt(), ..Default::default() };
        let foot = Footprint { half_height, x_of_bottom: xy / yy * half_height, slope: xy / xx, aspect: determinant.sqrt() / xx };
        let mut tiles = std::collections::BTreeMap::new();
        cut_into_tiles::<S>(&splat, &foot, size, None, |tile, rows| assert!(tiles.insert(tile, Entry { rank: 0, rows }).is_none()));
        for (x, y) in (0..size[0]).flat_map(|x| (0..size[1]).map(move |y| (x, y))) {
            let [dx, dy] = [x as f32 + 0.5 - splat.center[0], y as f32 + 0.5 - splat.center[1]];
            let sigma = (factors[0] * dx + factors[1] * dy).powi(2) + (factors[2] * dy).powi(2);
            let rows = tiles.get(&(y / TILE * size[0].div_ceil(TILE) + x / TILE)).map_or(0, |entry| entry.row_mask::<S>(x % TILE));
            assert!(2.0 * sigma > 0.999 * reach || rows >> (y % TILE) & 1 == 1, "pixel {x}, {y} is not listed");
        }
        let width = TILE / strips::<S>();
        tiles.values().flat_map(|entry| (0..TILE).step_by(width).map(|column| entry.row_mask::<S>(column).count_ones() as usize * width)).sum()
    }

    #[test]
    fn lists_have_all_pixels_of_an_ellipse_and_fewer_others_in_narrower_strips() {
        struct Listed;
        impl WithSimd for Listed {
            type Output = [usize; 2];
            #[inline(always)]
            fn with_simd<S: Simd>(self, _: S) -> [usize; 2] {
                [listed::<S>(), S::F32_LANES]
            }
        }
        // Four strips, as NEON has, and those of this machine.
        let ([here, lanes], narrow) = (dispatch(Listed), listed::<pulp::Scalar>());
        assert!(if lanes > 4 { narrow < here } else { narrow == here }, "{narrow} pixels in four strips, {here} in strips of {lanes}");
    }
}
