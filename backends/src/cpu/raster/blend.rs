//! Front-to-back blending of one tile's list, a row of the tile at a time.

use super::camera::{ALPHA_MIN, RuleConstants, TRANSMITTANCE_STOP};
use super::parallel::{SharedMut, run_tasks};
use super::scratch::{Entry, Workspace, set_len};
use super::{RasterSettings, ScreenSplat, TILE, TILE_PIXELS};
use crate::cpu::simd::{Lanes, dispatch, each, prefetch, vectorized};
use pulp::{Simd, WithSimd};
use std::mem::MaybeUninit;
use std::sync::atomic::{AtomicU64, Ordering};

/// Sigma up to which the exponential is evaluated; alpha is far below 1/255 beyond.
const SIGMA_MAX: f32 = 87.0;
/// Prefetch distance in list entries.
pub const AHEAD: usize = 6;
/// Planes of the output.
const PLANES: usize = 5;
/// Ranks per task of [`max_weights`].
const RANKS: usize = 2048;

/// Numbers per pixel of one tile, row-major.
pub type TilePlane = [f32; TILE_PIXELS];

/// Keeps planes from being multiples of 4096 bytes apart: a load at such a distance from a store waits for it, because processors compare the low 12 bits of
/// addresses first.
#[derive(Default)]
pub struct Gap {
    _bytes: [[f32; TILE]; 8],
}

/// Pixel centres of the columns of a tile at `origin_x`.
#[inline(always)]
pub fn column_centers(origin_x: usize) -> [f32; TILE] {
    std::array::from_fn(|x| (origin_x + x) as f32 + 0.5)
}

/// Rows of a tile that [`alphas`] computes together.
pub const TOGETHER: usize = 4;

/// Numbers of the rows of a vector's columns, and of those beyond the tile that are computed with the last ones.
pub type Rows<S> = [Lanes<S>; TILE + TOGETHER - 1];

/// Pixel centres of the rows of a tile at `origin_y`, and of those beyond it.
#[inline(always)]
pub fn row_centers(origin_y: usize) -> [f32; TILE + TOGETHER - 1] {
    std::array::from_fn(|y| (origin_y + y) as f32 + 0.5)
}

/// Writes alpha before it is capped to the rows of `out` that have a bit in `rows`, at the columns `dx` from the centre of `splat`; 0 where it is below 1/255.
#[inline(always)]
pub fn alphas<S: Simd>(simd: S, splat: &ScreenSplat, dx: Lanes<S>, centers: &[f32; TILE + TOGETHER - 1], rows: u32, out: &mut Rows<S>) {
    let like = |v: f32| Lanes::<S>::splat(simd, v);
    let [l1, l2, l3] = splat.factors;
    let (along, opacity, least, limit) = (like(l1), like(splat.opacity), like(ALPHA_MIN), like(SIGMA_MAX));
    let mut left = rows;
    while left != 0 {
        let first = left.trailing_zeros() as usize;
        left &= u32::MAX << (first + TOGETHER);
        let centers = &centers[first..first + TOGETHER];
        let sigma: [Lanes<S>; TOGETHER] = each(
            #[inline(always)]
            |k| {
                let dy = centers[k] - splat.center[1];
                let t = l3 * dy;
                let u = along.fma(dx, like(l2 * dy));
                u.fma(u, like(t * t))
            },
        );
        let shown = Lanes::exp_negated(sigma);
        for (k, out) in out[first..first + TOGETHER].iter_mut().enumerate() {
            let alpha = opacity * shown[k];
            *out = (sigma[k].bits_le(limit) & alpha.ge(least)).keep(alpha);
        }
    }
}

/// Blends every tile into `planes` `[5,H,W]`, of which every element is written, and saves what the backward pass needs. Returns the number of (Gaussian,
/// pixel) evaluations.
pub fn blend_all(background: [f32; 3], settings: &RasterSettings, rules: &RuleConstants, workspace: &mut Workspace, planes: &mut [MaybeUninit<f32>]) -> u64 {
    let tiles_x = settings.width.div_ceil(TILE);
    let tiles = tiles_x * settings.height.div_ceil(TILE);
    let buffers = &mut **workspace;
    set_len(&mut buffers.tile_end, tiles);
    set_len(&mut buffers.tile_stops, tiles);
    set_len(&mut buffers.final_transmittance, tiles * TILE_PIXELS);
    set_len(&mut buffers.stop_at, tiles * TILE_PIXELS);
    if settings.max_weights {
        set_len(&mut buffers.pair_weights, buffers.list.len());
        buffers.pair_weights.fill(0.0);
    }
    let pixels = settings.width * settings.height;
    let planes = SharedMut::new(planes);
    let ends = SharedMut::new(&mut buffers.tile_end);
    let stops = SharedMut::new(&mut buffers.tile_stops);
    let transmittance = SharedMut::new(&mut buffers.final_transmittance);
    let stop_at = SharedMut::new(&mut buffers.stop_at);
    let weights = SharedMut::new(&mut buffers.pair_weights);
    let (list, starts, ranked, order) = (&buffers.list, &buffers.tile_start, &buffers.ranked, &buffers.tile_order);
    let evaluations = AtomicU64::new(0);
    let ends_early = settings.shortcuts.transmittance;
    run_tasks(tiles, |position| {
        let tile = order[position] as usize;
        let origin = [tile % tiles_x * TILE, tile / tiles_x * TILE];
        let entries = starts[tile] as usize..starts[tile + 1] as usize;
        // SAFETY: an entry of the list belongs to one tile.
        let weights: &mut [f32] = if settings.max_weights { unsafe { weights.slice(entries.start, entries.len()) } } else { &mut [] };
        let list = &list[entries];
        // SAFETY: every tile has its own part of these.
        let (transmittance, stop_at) = unsafe { (transmittance.slice(tile * TILE_PIXELS, TILE_PIXELS), stop_at.slice(tile * TILE_PIXELS, TILE_PIXELS)) };
        let mut state = TileState::new(origin, settings, stop_at);
        if settings.max_weights {
            dispatch(BlendTile::<true> { ranked, list, origin, rules, state: &mut state, weights, ends_early });
        } else {
            dispatch(BlendTile::<false> { ranked, list, origin, rules, state: &mut state, weights, ends_early });
        }
        evaluations.fetch_add(state.evaluations, Ordering::Relaxed);
        // SAFETY: as above.
        unsafe {
            ends.slice(tile, 1)[0] = state.end;
            stops.slice(tile, 1)[0] = u32::from(state.stops);
        }
        // SAFETY: pixels belong to one tile.
        let rows = |plane: usize, from: usize, width: usize| unsafe { planes.slice(plane * pixels + from, width) };
        vectorized(
            #[inline(always)]
            || state.finish(origin, settings, background, transmittance, rows),
        );
    });
    evaluations.into_inner()
}

/// The largest weight of each of `n` Gaussians over all its pairs.
pub fn max_weights(n: usize, workspace: &Workspace) -> Vec<f32> {
    let mut out = vec![0.0f32; n];
    let shared = SharedMut::new(&mut out);
    run_tasks(workspace.ranked.len().div_ceil(RANKS), |task| {
        for (rank, splat) in workspace.ranked.iter().enumerate().skip(task * RANKS).take(RANKS) {
            let pairs = workspace.pair_start[rank] as usize..workspace.pair_start[rank + 1] as usize;
            let weights = workspace.list_index_of_pair[pairs].iter().map(|&index| workspace.pair_weights[index as usize]);
            // SAFETY: a Gaussian has one rank.
            unsafe { shared.slice(splat.index as usize, 1)[0] = weights.fold(0.0, f32::max) };
        }
    });
    out
}

/// Running numbers of one tile. Rows lie within cache lines.
#[repr(C, align(64))]
struct TileState<'a> {
    /// Red, green, blue, depth so far.
    sums: [TilePlane; 4],
    apart: Gap,
    /// Transmittance so far; NaN where the pixel has stopped or is outside the image.
    running: TilePlane,
    /// Transmittance of stopped pixels.
    stopped: TilePlane,
    /// List position where a pixel stopped.
    stop_at: &'a mut [u32],
    /// Bits of rows with a running pixel.
    alive: u32,
    /// Whether `stop_at` holds.
    stops: bool,
    /// Entries looked at.
    end: u32,
    evaluations: u64,
}

impl<'a> TileState<'a> {
    fn new(origin: [usize; 2], settings: &RasterSettings, stop_at: &'a mut [u32]) -> Self {
        let (width, height) = (TILE.min(settings.width - origin[0]), TILE.min(settings.height - origin[1]));
        let partial = width < TILE || height < TILE;
        let mut state = Self {
            sums: [[0.0; TILE_PIXELS]; 4],
            apart: Gap::default(),
            running: [1.0; TILE_PIXELS],
            stopped: [1.0; TILE_PIXELS],
            stop_at,
            alive: (1 << height) - 1,
            stops: false,
            end: 0,
            evaluations: 0,
        };
        if partial {
            state.start_stopping();
            for pixel in 0..TILE_PIXELS {
                if pixel % TILE >= width || pixel / TILE >= height {
                    state.running[pixel] = f32::NAN;
                    state.stop_at[pixel] = 0;
                }
            }
        }
        state
    }
    /// Saves the transmittance that is left, and writes the tile's pixels. `rows(plane, from, width)` are pixels of the image.
    #[inline(always)]
    fn finish<'p>(
        &self,
        origin: [usize; 2],
        settings: &RasterSettings,
        background: [f32; 3],
        transmittance: &mut [f32],
        rows: impl Fn(usize, usize, usize) -> &'p mut [MaybeUninit<f32>],
    ) {
        for ((left, running), stopped) in transmittance.iter_mut().zip(&self.running).zip(&self.stopped) {
            // A running transmittance of NaN marks a stopped pixel.
            *left = if running.is_nan() { *stopped } else { *running };
        }
        let width = TILE.min(settings.width - origin[0]);
        for row in 0..TILE.min(settings.height - origin[1]) {
            let from = (origin[1] + row) * settings.width + origin[0];
            let at = row * TILE..row * TILE + width;
            let transmittance = &transmittance[at.clone()];
            for (c, background) in background.into_iter().enumerate() {
                for ((value, sum), left) in rows(c, from, width).iter_mut().zip(&self.sums[c][at.clone()]).zip(transmittance) {
                    value.write(sum + left * background);
                }
            }
            for (value, left) in rows(3, from, width).iter_mut().zip(transmittance) {
                value.write(1.0 - left);
            }
            for (value, depth) in rows(4, from, width).iter_mut().zip(&self.sums[3][at]) {
                value.write(*depth);
            }
        }
    }
    /// From here on `stop_at` is read.
    #[cold]
    fn start_stopping(&mut self) {
        if !self.stops {
            self.stops = true;
            self.stop_at.fill(u32::MAX);
        }
    }
    /// Stops the running pixels of `row` that the Gaussian at list position `i` would take to the stop value or below.
    #[cold]
    #[inline(never)]
    fn stop_pixels(&mut self, row: usize, first: usize, stopping: &[f32], i: u32) {
        self.start_stopping();
        for (lane, &stops) in stopping.iter().enumerate() {
            let pixel = row * TILE + first + lane;
            if stops != 0.0 {
                self.stopped[pixel] = self.running[pixel];
                self.running[pixel] = f32::NAN;
                self.stop_at[pixel] = i;
            }
        }
        if self.running[row * TILE..(row + 1) * TILE].iter().all(|t| t.is_nan()) {
            self.alive &= !(1 << row);
        }
    }
}

struct BlendTile<'k, 'a, const WEIGHTS: bool> {
    ranked: &'k [ScreenSplat],
    list: &'k [Entry],
    origin: [usize; 2],
    rules: &'k RuleConstants,
    state: &'k mut TileState<'a>,
    weights: &'k mut [f32],
    /// Whether rows and the tile end when their pixels have stopped.
    ends_early: bool,
}

impl<const WEIGHTS: bool> WithSimd for BlendTile<'_, '_, WEIGHTS> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { ranked, list, origin, rules, state, weights, ends_early } = self;
        let like = |v: f32| Lanes::<S>::splat(simd, v);
        let columns = column_centers(origin[0]);
        let centers = row_centers(origin[1]);
        let (cap, least, stop, one) = (like(rules.alpha_max), like(ALPHA_MIN), like(TRANSMITTANCE_STOP), like(1.0));
        let mut full = [like(0.0); TILE + TOGETHER - 1];
        for (i, entry) in list.iter().enumerate() {
            if let Some(ahead) = list.get(i + AHEAD) {
                prefetch(ranked, ahead.rank as usize);
            }
            let splat = &ranked[entry.rank as usize];
            let alive = if ends_early { state.alive } else { u32::MAX };
            let shown = [like(splat.color[0]), like(splat.color[1]), like(splat.color[2]), like(splat.depth)];
            let mut largest = like(0.0);
            for block in 0..TILE / S::F32_LANES {
                let first = block * S::F32_LANES;
                let dx = Lanes::load(simd, &columns[first..]) - splat.center[0];
                let mut left = entry.row_mask::<S>(first) & alive;
                state.evaluations += u64::from(left.count_ones()) * S::F32_LANES as u64;
                alphas(simd, splat, dx, &centers, left, &mut full);
                while left != 0 {
                    let row = left.trailing_zeros() as usize;
                    left &= left - 1;
                    let at = row * TILE + first;
                    let alpha = full[row].min(cap);
                    let hit = alpha.ge(least);
                    let before = Lanes::load(simd, &state.running[at..]);
                    let after = alpha.nfma(before, before);
                    let drawn = hit & after.gt(stop);
                    let weight = drawn.keep(alpha * before);
                    for plane in 0..PLANES - 1 {
                        let sum = &mut state.sums[plane][at..];
                        weight.fma(shown[plane], Lanes::load(simd, sum)).store(sum);
                    }
                    // As `drawn.select(after, before)`, which becomes a masked store: a slow instruction without AVX-512.
                    drawn.keep(alpha).nfma(before, before).store(&mut state.running[at..]);
                    if WEIGHTS {
                        largest = largest.max(weight);
                    }
                    // False for pixels that have stopped already: they hold NaN.
                    let stopping = hit & after.le(stop);
                    if stopping.any() {
                        let mut flags = [0.0f32; TILE];
                        stopping.keep(one).store(&mut flags);
                        state.stop_pixels(row, first, &flags[..S::F32_LANES], i as u32);
                    }
                }
            }
            if WEIGHTS {
                weights[i] = largest.largest();
            }
            if ends_early && state.alive == 0 {
                state.end = i as u32 + 1;
                return;
            }
        }
        state.end = list.len() as u32;
    }
}
