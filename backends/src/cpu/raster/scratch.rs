//! The working memory of one render. It lives until the backward pass has used it, then returns to a pool, because faulting in fresh pages
//! costs more than the kernels that fill them.

use super::{RECORD, ScreenSplat, TILE};
use crate::cpu::simd::prefetch;
use pulp::Simd;
use std::sync::Mutex;

/// Upper bound on the workspaces in the pool: every view of an iteration holds one until its backward pass.
const POOLED: usize = 8;
/// Upper bound on the bytes of all workspaces in the pool.
const POOLED_BYTES: usize = 2 << 30;

static POOL: Mutex<Vec<Buffers>> = Mutex::new(Vec::new());

/// Extent of the footprint {sigma <= cutoff} of a Gaussian, for its intersection with columns of pixels.
#[derive(Clone, Copy, Debug, Default)]
pub struct Footprint {
    /// Half height in pixels.
    pub half_height: f32,
    /// Offset of the lowest point of the image (largest y) from the centre, along x, pixels.
    pub x_of_bottom: f32,
    /// Slope of the line of centres of the columns.
    pub slope: f32,
    /// Half height of a column over the half width of the ellipse left there.
    pub aspect: f32,
}

/// A (Gaussian, tile) pair in the order of creation: by depth, then tile.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pair {
    /// Index of the tile, row-major.
    pub tile: u32,
    /// Position of the Gaussian in depth order.
    pub rank: u32,
    /// As [`Entry::rows`].
    pub rows: u32,
}

/// An entry of a tile's list.
#[derive(Clone, Copy, Debug, Default)]
pub struct Entry {
    /// Position of the Gaussian in depth order.
    pub rank: u32,
    /// The rows that it reaches in each of the [`strips`] of the tile, from the left, [`STRIP_BITS`] each: the first row, and the last row times 16.
    pub rows: u32,
}

/// Bits of [`Entry::rows`] per strip.
pub const STRIP_BITS: u32 = 8;
/// The bits of a strip that no pixel of is reached: its first row lies below its last.
pub const EMPTY_STRIP: u32 = 15;

/// The number of strips that a tile is cut into, side by side: one per vector of a row, at most four.
pub const fn strips<S: Simd>() -> usize {
    if S::F32_LANES < TILE / 4 { 4 } else { TILE / S::F32_LANES }
}

impl Entry {
    /// One bit per row of the tile that is reached in the strip of its column `column`.
    #[inline(always)]
    pub fn row_mask<S: Simd>(self, column: usize) -> u32 {
        let bits = self.rows >> (STRIP_BITS * (column * strips::<S>() / TILE) as u32);
        let (first, last) = (bits & 15, bits >> 4 & 15);
        ((2u32 << last) - 1) & !((1u32 << first) - 1)
    }
}

/// Buffers of one render.
#[derive(Default)]
pub struct Buffers {
    /// Visible Gaussians by slot: those of a chunk of inputs follow each other from the chunk's start.
    pub slots: Vec<ScreenSplat>,
    /// Footprints by slot.
    pub footprints: Vec<Footprint>,
    /// Visible Gaussians per chunk, and the tiles of their bounding boxes.
    pub chunk_counts: Vec<(u32, u64)>,
    /// (depth bits, slot) in depth order, and a buffer for sorting.
    pub order: Vec<u64>,
    /// The other half of the sort.
    pub order_spare: Vec<u64>,
    /// Visible Gaussians in depth order.
    pub ranked: Vec<ScreenSplat>,
    /// Position in depth order of every slot.
    pub rank_of_slot: Vec<u32>,
    /// First pair of every rank, and the end.
    pub pair_start: Vec<u32>,
    /// Index in `list` of every pair.
    pub list_index_of_pair: Vec<u32>,
    /// Pairs per binning task.
    pub pairs: Vec<Vec<Pair>>,
    /// Entries per binning task and tile.
    pub histograms: Vec<u32>,
    /// All tile lists, one after the other, front to back.
    pub list: Vec<Entry>,
    /// Start of every tile's list, and the end.
    pub tile_start: Vec<u32>,
    /// Tiles, longest list first.
    pub tile_order: Vec<u32>,
    /// How much of its list a tile needed before all its pixels had stopped.
    pub tile_end: Vec<u32>,
    /// Whether a pixel of the tile stopped early (or lies outside the image), so that `stop_at` holds.
    pub tile_stops: Vec<u32>,
    /// Transmittance left, per tile and pixel.
    pub final_transmittance: Vec<f32>,
    /// Position in the list where the pixel stopped, per tile and pixel.
    pub stop_at: Vec<u32>,
    /// By index in `list`: sums over the pixels of a tile of v = -d loss / d sigma times u, t, u^2, u t, t^2 and 1, where sigma = u^2 + t^2, and of the
    /// blending weight times the gradient of the colours and of the depth.
    pub records: Vec<[f32; RECORD]>,
    /// Sums of absolute gradients of the centre (x, y) by index in `list`, when asked for.
    pub absolute: Vec<[f32; 2]>,
    /// Largest weight by index in `list`, when asked for.
    pub pair_weights: Vec<f32>,
}

impl Buffers {
    fn bytes(&self) -> usize {
        let pairs: usize = self.pairs.iter().map(|p| 12 * p.capacity()).sum();
        64 * (self.slots.capacity() + self.ranked.capacity())
            + 16 * (self.footprints.capacity() + self.order.capacity())
            + 12 * self.list.capacity()
            + 4 * RECORD * self.records.capacity()
            + 8 * self.absolute.capacity()
            + 4 * self.pair_weights.capacity()
            + 8 * self.final_transmittance.capacity()
            + pairs
    }
}

/// Buffers on loan from the pool.
#[derive(Default)]
pub struct Workspace {
    buffers: Buffers,
}

impl Workspace {
    /// Takes a workspace; its contents are arbitrary.
    pub fn take() -> Self {
        Self { buffers: POOL.lock().ok().and_then(|mut pool| pool.pop()).unwrap_or_default() }
    }
    /// Prefetches the records that [`Workspace::summed_record`] will read.
    #[inline(always)]
    pub fn prefetch_records(&self, rank: usize) {
        for &index in &self.list_index_of_pair[self.pair_start[rank] as usize..self.pair_start[rank + 1] as usize] {
            prefetch(&self.records, index as usize);
        }
    }
    /// The gradient record of `splat`, the Gaussian at `rank`, from the sum of its records, in the order of its tiles.
    #[inline(always)]
    pub fn summed_record(&self, rank: usize, splat: &ScreenSplat) -> [f32; RECORD] {
        let mut sum = [0.0f32; RECORD];
        for &index in &self.list_index_of_pair[self.pair_start[rank] as usize..self.pair_start[rank + 1] as usize] {
            for (a, b) in sum.iter_mut().zip(&self.records[index as usize]) {
                *a += b;
            }
        }
        // With v = -d loss / d sigma: the signs turn here, but not for the centre, because offsets are pixel minus centre.
        let ([l1, l2, l3], [u, t, uu, ut, tt, v, colors @ ..]) = (splat.factors, sum);
        let [red, green, blue, depth] = colors;
        [2.0 * l1 * u, 2.0 * (l2 * u + l3 * t), -uu, -ut, -tt, v / splat.opacity, red, green, blue, depth]
    }
    /// As [`Workspace::summed_record`], for the absolute gradients of the centre.
    pub fn summed_absolute(&self, rank: usize) -> [f32; 2] {
        let mut sum = [0.0f32; 2];
        for &index in &self.list_index_of_pair[self.pair_start[rank] as usize..self.pair_start[rank + 1] as usize] {
            for (a, b) in sum.iter_mut().zip(self.absolute[index as usize]) {
                *a += b;
            }
        }
        sum
    }
}

impl std::ops::Deref for Workspace {
    type Target = Buffers;
    #[inline(always)]
    fn deref(&self) -> &Buffers {
        &self.buffers
    }
}

impl std::ops::DerefMut for Workspace {
    #[inline(always)]
    fn deref_mut(&mut self) -> &mut Buffers {
        &mut self.buffers
    }
}

impl std::fmt::Debug for Workspace {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Workspace({} visible, {} pairs)", self.ranked.len(), self.list.len())
    }
}

impl Drop for Workspace {
    fn drop(&mut self) {
        if let Ok(mut pool) = POOL.lock() {
            keep(&mut pool, &mut self.buffers, POOLED_BYTES);
        }
    }
}

/// Moves `buffers` to `pool`, if that then has at most [`POOLED`] workspaces of `most_bytes` in all.
fn keep(pool: &mut Vec<Buffers>, buffers: &mut Buffers, most_bytes: usize) {
    let bytes = buffers.bytes() + pool.iter().map(Buffers::bytes).sum::<usize>();
    if pool.len() < POOLED && bytes <= most_bytes {
        pool.push(std::mem::take(buffers));
    }
}

/// Makes `buffer` `len` long without touching what is there; new elements are `T::default()`.
pub fn set_len<T: Clone + Default>(buffer: &mut Vec<T>, len: usize) {
    buffer.resize(len, T::default());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pool_keeps_eight_workspaces_within_its_bytes() {
        let kept = |most_bytes: usize| {
            let mut pool = Vec::new();
            for _ in 0..9 {
                // 400 bytes.
                keep(&mut pool, &mut Buffers { pair_weights: Vec::with_capacity(100), ..Default::default() }, most_bytes);
            }
            pool.len()
        };
        assert_eq!([kept(POOLED_BYTES), kept(1000), kept(399)], [8, 2, 0]);
    }
}
