//! Back-to-front derivative of blending, one tile at a time.
//!
//! With q_i the upstream gradient of what Gaussian i shows at a pixel and S_i the part of the loss behind it,
//! d loss / d alpha_i = T_i q_i - S_i / (1 - alpha_i). All of a Gaussian's geometry gradients at a tile come from sums over v = -d loss / d sigma times powers
//! of u and t (sigma = u^2 + t^2). Along a column these are linear in the row y, so powers of y are added up over the rows, and turned into those of u and t
//! once. y is the offset from the point of the column that is next to the Gaussian's centre: squares of thousands of pixels would leave nothing of the digits
//! of v.

use super::blend::{AHEAD, Gap, TOGETHER, TilePlane, alphas, column_centers, row_centers};
use super::camera::{ALPHA_MIN, RuleConstants};
use super::parallel::{SharedMut, run_tasks};
use super::scratch::{Entry, Workspace, set_len};
use super::{AT_DEPTH, RECORD, RasterSettings, ScreenSplat, TILE, TILE_PIXELS};
use crate::cpu::simd::{Lanes, dispatch, each, prefetch, vectorized};
use pulp::{Simd, WithSimd};

/// Per column: sums of v times u, t, u^2, u t and t^2 with sigma = u^2 + t^2, from `sums` of v times 1, y and y^2. `dx` is that of the column from the
/// Gaussian's centre, `offset` where y = 0 from it.
#[inline(always)]
fn moments<S: Simd>([l1, l2, l3]: [Lanes<S>; 3], dx: Lanes<S>, offset: Lanes<S>, [v, v_y, v_y2]: [Lanes<S>; 3]) -> [Lanes<S>; 5] {
    // u and t where y = 0.
    let (u0, t0) = (l1.fma(dx, l2 * offset), l3 * offset);
    let (own_u, own_t) = (l2 * v_y, l3 * v_y);
    let (u, t) = (u0.fma(v, own_u), t0.fma(v, own_t));
    let (uu, ut, tt) = (l2 * l2 * v_y2, l2 * l3 * v_y2, l3 * l3 * v_y2);
    [u, t, u0.fma(own_u + u, uu), u0.fma(own_t, t0.fma(u, ut)), t0.fma(own_t + t, tt)]
}

/// Fills the gradient records of all pairs from `upstream` `[5,H,W]`; with `absolute`, also the sums of absolute gradients of the centres.
pub fn blend_backward_all(background: [f32; 3], settings: &RasterSettings, workspace: &mut Workspace, upstream: &[f32], absolute: bool) {
    let rules = RuleConstants::new(settings);
    let tiles_x = settings.width.div_ceil(TILE);
    let buffers = &mut **workspace;
    set_len(&mut buffers.records, buffers.list.len());
    set_len(&mut buffers.absolute, if absolute { buffers.list.len() } else { 0 });
    let records = SharedMut::new(&mut buffers.records);
    let absolute_sums = SharedMut::new(&mut buffers.absolute);
    let (list, starts, ranked, order) = (&buffers.list, &buffers.tile_start, &buffers.ranked, &buffers.tile_order);
    let (ends, stops) = (&buffers.tile_end, &buffers.tile_stops);
    let (transmittance, stop_at) = (&buffers.final_transmittance, &buffers.stop_at);
    run_tasks(order.len(), |position| {
        let tile = order[position] as usize;
        let origin = [tile % tiles_x * TILE, tile / tiles_x * TILE];
        let entries = starts[tile] as usize..starts[tile + 1] as usize;
        // SAFETY: an entry of the list belongs to one tile.
        let (records, absolute_sums) = unsafe {
            let counted = if absolute { entries.clone() } else { 0..0 };
            (records.slice(entries.start, entries.len()), absolute_sums.slice(counted.start, counted.len()))
        };
        if entries.is_empty() {
            return;
        }
        let list = &list[entries];
        let pixels = tile * TILE_PIXELS..(tile + 1) * TILE_PIXELS;
        let mut state = TileGradient::new(origin, settings, background, upstream, &transmittance[pixels.clone()]);
        let end = if state.live_rows == 0 { 0 } else { ends[tile] as usize };
        records[end..].fill([0.0; RECORD]);
        if absolute {
            absolute_sums[end..].fill([0.0; 2]);
        }
        let kernel = BackTile { ranked, list: &list[..end], origin, rules: &rules, state: &mut state, stop_at: &stop_at[pixels], records, absolute_sums };
        match (stops[tile] != 0, kernel.state.depth_matters, absolute) {
            (false, false, false) => dispatch(Flags::<false, false, false>(kernel)),
            (false, true, false) => dispatch(Flags::<false, true, false>(kernel)),
            (true, false, false) => dispatch(Flags::<true, false, false>(kernel)),
            (true, true, false) => dispatch(Flags::<true, true, false>(kernel)),
            (false, false, true) => dispatch(Flags::<false, false, true>(kernel)),
            (false, true, true) => dispatch(Flags::<false, true, true>(kernel)),
            (true, false, true) => dispatch(Flags::<true, false, true>(kernel)),
            (true, true, true) => dispatch(Flags::<true, true, true>(kernel)),
        }
    });
}

/// Upstream gradients and running numbers of one tile. Rows lie within cache lines.
#[repr(C, align(64))]
struct TileGradient {
    /// Upstream of red, green, blue, depth.
    upstream: [TilePlane; 4],
    apart: Gap,
    /// Transmittance behind the current Gaussian.
    running: TilePlane,
    /// The part of the loss behind the current Gaussian.
    behind: TilePlane,
    /// Bits of rows with any upstream gradient.
    live_rows: u32,
    depth_matters: bool,
}

impl TileGradient {
    fn new(origin: [usize; 2], settings: &RasterSettings, background: [f32; 3], upstream: &[f32], transmittance: &[f32]) -> Self {
        let zero = [0.0; TILE_PIXELS];
        let mut state = Self { upstream: [zero; 4], apart: Gap::default(), running: [1.0; TILE_PIXELS], behind: zero, live_rows: 0, depth_matters: false };
        state.running.copy_from_slice(transmittance);
        vectorized(
            #[inline(always)]
            || state.read(origin, settings, background, upstream),
        );
        state
    }
    /// Reads the upstream gradients of the tile.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // Six rows at once.
    fn read(&mut self, origin: [usize; 2], settings: &RasterSettings, background: [f32; 3], upstream: &[f32]) {
        let (width, height) = (TILE.min(settings.width - origin[0]), TILE.min(settings.height - origin[1]));
        let plane = settings.width * settings.height;
        let mut depth_bits = 0;
        for row in 0..height {
            let from = (origin[1] + row) * settings.width + origin[0];
            let at = row * TILE..row * TILE + width;
            let [red, green, blue, alpha, depth]: [&[f32]; 5] = each(
                #[inline(always)]
                |k| &upstream[k * plane + from..][..width],
            );
            let (running, behind) = (&self.running[at.clone()], &mut self.behind[at.clone()]);
            // Numbers are 0 if all bits but the sign are.
            let mut bits = 0;
            for x in 0..width {
                let shown = background[0] * red[x] + background[1] * green[x] + background[2] * blue[x] - alpha[x];
                behind[x] = running[x] * shown;
                bits |= red[x].to_bits() | green[x].to_bits() | blue[x].to_bits() | alpha[x].to_bits() | depth[x].to_bits();
                depth_bits |= depth[x].to_bits();
            }
            self.live_rows |= u32::from(bits << 1 != 0) << row;
            for (own, source) in self.upstream.iter_mut().zip([red, green, blue, depth]) {
                own[at.clone()].copy_from_slice(source);
            }
        }
        self.depth_matters = depth_bits << 1 != 0;
    }
}

struct BackTile<'k> {
    ranked: &'k [ScreenSplat],
    list: &'k [Entry],
    origin: [usize; 2],
    rules: &'k RuleConstants,
    state: &'k mut TileGradient,
    stop_at: &'k [u32],
    records: &'k mut [[f32; RECORD]],
    absolute_sums: &'k mut [[f32; 2]],
}

/// Whether pixels of the tile stopped early, whether depth carries gradient, and whether absolute gradients are summed.
struct Flags<'k, const STOPS: bool, const DEPTH: bool, const ABSOLUTE: bool>(BackTile<'k>);

impl<const STOPS: bool, const DEPTH: bool, const ABSOLUTE: bool> WithSimd for Flags<'_, STOPS, DEPTH, ABSOLUTE> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let BackTile { ranked, list, origin, rules, state, stop_at, records, absolute_sums } = self.0;
        let stop_at: &[f32] = bytemuck::cast_slice(stop_at);
        let like = |v: f32| Lanes::<S>::splat(simd, v);
        let columns = column_centers(origin[0]);
        let centers = row_centers(origin[1]);
        let (cap, least, one, zero) = (like(rules.alpha_max), like(ALPHA_MIN), like(1.0), like(0.0));
        let mut uncapped = [zero; TILE + TOGETHER - 1];
        // Largest uncapped alpha whose gradient passes.
        let passing = like(if rules.pass_capped { f32::MAX } else { rules.alpha_max });
        for (i, entry) in list.iter().enumerate().rev() {
            if i >= AHEAD {
                prefetch(ranked, list[i - AHEAD].rank as usize);
            }
            let splat = &ranked[entry.rank as usize];
            let [l1, l2, l3] = splat.factors;
            let factors = splat.factors.map(like);
            // The y of the tile's columns that is next to the centre.
            let nearest = splat.center[1].max(centers[0]).min(centers[TILE - 1]);
            let color: [Lanes<S>; 3] = each(
                #[inline(always)]
                |c| like(splat.color[c]),
            );
            let depth = like(splat.depth);
            let position = like(f32::from_bits(i as u32 + 1));
            // Sums over pixels of v times u, t, u^2, u t, t^2 and 1, of weight times upstream colour and depth, and of absolute gradients.
            let mut sums = [zero; 12];
            for block in 0..TILE / S::F32_LANES {
                let first = block * S::F32_LANES;
                let mut left = entry.row_mask::<S>(first) & state.live_rows;
                if left == 0 {
                    continue;
                }
                let dx = Lanes::load(simd, &columns[first..]) - splat.center[0];
                // Sums over rows of v, v y and v y^2.
                let mut v_sum = zero;
                let mut v_y = zero;
                let mut v_y2 = zero;
                let mut shown = [zero; 4];
                let (mut absolute_x, mut absolute_y) = (zero, zero);
                alphas(simd, splat, dx, &centers, left, &mut uncapped);
                while left != 0 {
                    let row = left.trailing_zeros() as usize;
                    left &= left - 1;
                    let at = row * TILE + first;
                    let full = uncapped[row];
                    let mut hit = full.ge(least);
                    if STOPS {
                        // i < stop_at, on integers.
                        hit = hit & position.bits_le(Lanes::load(simd, &stop_at[at..]));
                        if !hit.any() {
                            continue;
                        }
                    }
                    let alpha = hit.keep(full.min(cap));
                    let inverse = (one - alpha).reciprocal();
                    let before = Lanes::load(simd, &state.running[at..]) * inverse;
                    before.store(&mut state.running[at..]);
                    let weight = alpha * before;
                    let g: [Lanes<S>; 3] = each(
                        #[inline(always)]
                        |c| Lanes::load(simd, &state.upstream[c][at..]),
                    );
                    let mut q = color[0].fma(g[0], color[1].fma(g[1], color[2] * g[2]));
                    if DEPTH {
                        let g_depth = Lanes::load(simd, &state.upstream[3][at..]);
                        q = depth.fma(g_depth, q);
                        shown[3] = weight.fma(g_depth, shown[3]);
                    }
                    let behind = Lanes::load(simd, &state.behind[at..]);
                    let d_alpha = before.fma(q, -(behind * inverse));
                    weight.fma(q, behind).store(&mut state.behind[at..]);
                    // d alpha / d sigma = -alpha, uncapped.
                    let v = (hit & full.le(passing)).keep(full) * d_alpha;
                    if ABSOLUTE {
                        // The factors 2 l1 and 2 follow after the sums.
                        let dy = centers[row] - splat.center[1];
                        let u = like(l1).fma(dx, like(l2 * dy));
                        let along_x = v * u;
                        let along_y = v * u.fma(like(l2), like(l3 * l3 * dy));
                        absolute_x += along_x.max(-along_x);
                        absolute_y += along_y.max(-along_y);
                    }
                    let y = like(centers[row] - nearest);
                    let moment = v * y;
                    v_sum += v;
                    v_y += moment;
                    v_y2 = moment.fma(y, v_y2);
                    for c in 0..3 {
                        shown[c] = weight.fma(g[c], shown[c]);
                    }
                }
                let [u, t, uu, ut, tt] = moments(factors, dx, like(nearest - splat.center[1]), [v_sum, v_y, v_y2]);
                let [red, green, blue, deep] = shown;
                let of_block = [u, t, uu, ut, tt, v_sum, red, green, blue, deep, absolute_x, absolute_y];
                for (sum, value) in sums.iter_mut().zip(of_block).take(if ABSOLUTE { 12 } else { 10 }) {
                    *sum += value;
                }
            }
            // The order is that of the columns of a record.
            records[i] = each(
                #[inline(always)]
                |k| if k == AT_DEPTH && !DEPTH { 0.0 } else { sums[k].sum() },
            );
            if ABSOLUTE {
                absolute_sums[i] = [2.0 * l1 * sums[10].sum(), 2.0 * sums[11].sum()];
            }
        }
    }
}
