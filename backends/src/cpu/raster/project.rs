//! From Gaussians to the visible ones on the screen: activation, projection, culling, colour.

use super::camera::{ALPHA_MIN, CameraConstants, FAR, RuleConstants, SHORTEST_QUATERNION};
use super::geometry::{Vec3, project};
use super::parallel::{SharedMut, run_tasks};
use super::scratch::{Footprint, Workspace, set_len};
use super::{MAX_TILE_PAIRS, RasterSettings, ScreenSplat, SplatArrays, TILE, TooManyPairs, sh, tiles};
use crate::cpu::simd::{Lanes, dispatch, each};
use cc4dgs_core::ParameterSpace;
use pulp::{Simd, WithSimd};

/// Gaussians per task.
pub const CHUNK: usize = 256;
/// Widest vector of any instruction set.
pub const WIDEST: usize = 16;
/// Sigma by which footprints are enlarged, so that rounding never cuts off a pixel that blending would count.
const CUTOFF_MARGIN: f32 = 0.005;
/// Twice the sigma at which an opacity of 1 falls to 1/255, enlarged likewise: the reach of every footprint without the shortcut.
const FULL_REACH: f32 = 11.1 + 2.0 * CUTOFF_MARGIN;
/// Colours of this size and above count as infinite: their sums could overflow.
const COLOR_LIMIT: f32 = 1e20;

/// Rows of numbers, one column per lane.
pub type Stage<const ROWS: usize> = [[f32; WIDEST]; ROWS];

/// Projects and colours all Gaussians into the slots of `workspace`; fills `radii`.
pub fn project_all(
    splats: &SplatArrays,
    settings: &RasterSettings,
    camera: &CameraConstants,
    rules: &RuleConstants,
    workspace: &mut Workspace,
    radii: &mut [i64],
) -> Result<(), TooManyPairs> {
    let n = splats.len();
    let chunks = n.div_ceil(CHUNK);
    set_len(&mut workspace.slots, chunks * CHUNK);
    set_len(&mut workspace.footprints, chunks * CHUNK);
    set_len(&mut workspace.chunk_counts, chunks);
    let buffers = &mut **workspace;
    let slots = SharedMut::new(&mut buffers.slots);
    let footprints = SharedMut::new(&mut buffers.footprints);
    let counts = SharedMut::new(&mut buffers.chunk_counts);
    let radii = SharedMut::new(radii);
    run_tasks(chunks, |chunk| {
        let first = chunk * CHUNK;
        let len = CHUNK.min(n - first);
        // SAFETY: every task has a chunk of its own.
        let (slots, footprints, radii, count) =
            unsafe { (slots.slice(first, CHUNK), footprints.slice(first, CHUNK), radii.slice(first, len), counts.slice(chunk, 1)) };
        let mut kernel = ProjectChunk { splats, settings, camera, rules, first, slots, footprints, radii, count: 0, tiles: 0 };
        dispatch(Project(&mut kernel));
        dispatch(Color(&mut kernel));
        count[0] = (kernel.count as u32, kernel.tiles);
    });
    let tiles: u64 = buffers.chunk_counts.iter().map(|c| c.1).sum();
    if tiles > MAX_TILE_PAIRS { Err(TooManyPairs(tiles)) } else { Ok(()) }
}

struct ProjectChunk<'a> {
    splats: &'a SplatArrays<'a>,
    settings: &'a RasterSettings,
    camera: &'a CameraConstants,
    rules: &'a RuleConstants,
    first: usize,
    slots: &'a mut [ScreenSplat],
    footprints: &'a mut [Footprint],
    radii: &'a mut [i64],
    count: usize,
    tiles: u64,
}

/// The Gaussians staged in columns: means 0-2, scales 3-5, quaternions 6-9, opacity 10.
#[inline(always)]
pub fn stage_inputs<S: Simd>(splats: &SplatArrays, index_of_lane: impl Fn(usize) -> usize, stage: &mut Stage<11>) {
    for lane in 0..S::F32_LANES {
        let i = index_of_lane(lane);
        let (mean, scale) = (&splats.means[3 * i..3 * i + 3], &splats.scales[3 * i..3 * i + 3]);
        let quaternion = &splats.quaternions[4 * i..4 * i + 4];
        for k in 0..3 {
            stage[k][lane] = mean[k];
            stage[3 + k][lane] = scale[k];
        }
        for k in 0..4 {
            stage[6 + k][lane] = quaternion[k];
        }
        stage[10][lane] = splats.opacities[i];
    }
}

/// Linear scales and opacities in 0..1 of staged inputs.
#[inline(always)]
pub fn activate<S: Simd>(space: ParameterSpace, scales: Vec3<S>, opacity: Lanes<S>) -> (Vec3<S>, Lanes<S>) {
    match space {
        ParameterSpace::Raw => {
            let one = opacity.like(1.0);
            (
                each(
                    #[inline(always)]
                    |k| scales[k].exp(),
                ),
                one / (one + (-opacity).exp()),
            )
        }
        ParameterSpace::Activated => (scales, opacity),
    }
}

/// Direction from the camera centre to `mean`, and one over the distance.
#[inline(always)]
pub fn view_direction<S: Simd>(camera: &CameraConstants, mean: Vec3<S>) -> (Vec3<S>, Lanes<S>) {
    let offset: Vec3<S> = each(
        #[inline(always)]
        |k| mean[k] - camera.center[k],
    );
    let squared = offset[0].fma(offset[0], offset[1].fma(offset[1], offset[2] * offset[2]));
    let inverse = offset[0].like(1.0) / squared.sqrt();
    (
        each(
            #[inline(always)]
            |k| offset[k] * inverse,
        ),
        inverse,
    )
}

struct Project<'k, 'a>(&'k mut ProjectChunk<'a>);

impl WithSimd for Project<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let k = self.0;
        let (width, height) = (k.settings.width as f32, k.settings.height as f32);
        let like = |v: f32| Lanes::<S>::splat(simd, v);
        let mut stage: Stage<11> = [[0.0; WIDEST]; 11];
        let mut out: Stage<16> = [[0.0; WIDEST]; 16];
        let len = k.radii.len();
        let mut start = 0;
        while start < len {
            let here = S::F32_LANES.min(len - start);
            stage_inputs::<S>(k.splats, |lane| k.first + start + lane.min(here - 1), &mut stage);
            let inputs: [Lanes<S>; 11] = each(
                #[inline(always)]
                |i| Lanes::load(simd, &stage[i]),
            );
            let mean: Vec3<S> = [inputs[0], inputs[1], inputs[2]];
            let (scales, opacity) = activate(k.settings.space, [inputs[3], inputs[4], inputs[5]], inputs[10]);
            let p = project(k.camera, mean, [inputs[6], inputs[7], inputs[8], inputs[9]], scales);
            let opacity = if k.settings.antialiased { opacity * p.compensation } else { opacity };
            let [xx, xy, yy] = p.covariance;
            // Twice the sigma at which alpha falls to 1/255.
            let reach = if k.settings.shortcuts.opacity { ((opacity * 255.0).max(like(1e-30)).ln_rough() + CUTOFF_MARGIN) * 2.0 } else { like(FULL_REACH) };
            let (half_width, half_height) = ((reach * xx).sqrt(), (reach * yy).sqrt());
            let radius = if k.rules.square_tiles {
                let (mid, half) = ((xx + yy) * 0.5, (xx - yy) * 0.5);
                (mid + half.fma(half, xy * xy).max(like(0.1)).sqrt()).sqrt() * 3.0
            } else {
                xx.max(yy).sqrt() * 3.33
            };
            let zero = like(0.0);
            let mut finite = (p.determinant + half_width + half_height) * zero;
            for input in inputs {
                finite = input.fma(zero, finite);
            }
            let visible = finite.equal(zero)
                & p.point[2].gt(like(k.rules.near))
                & p.point[2].lt(like(FAR))
                & p.norm_squared.gt(like(SHORTEST_QUATERNION))
                & opacity.ge(like(ALPHA_MIN))
                & (p.center[0] + half_width).ge(like(0.5))
                & (p.center[0] - half_width).le(like(width - 0.5))
                & (p.center[1] + half_height).ge(like(0.5))
                & (p.center[1] - half_height).le(like(height - 0.5));
            k.radii[start..start + here].fill(0);
            if visible.any() {
                let columns = [
                    p.center[0],
                    p.center[1],
                    p.factors[0],
                    p.factors[1],
                    p.factors[2],
                    opacity,
                    half_width,
                    half_height,
                    xy / yy * half_height,
                    xy / xx,
                    p.determinant.sqrt() / xx,
                    radius,
                    visible.keep(like(1.0)),
                ];
                for (column, row) in columns.iter().zip(&mut out) {
                    column.store(row);
                }
                for lane in 0..here {
                    if out[12][lane] != 0.0 {
                        k.emit(
                            start + lane,
                            &each(
                                #[inline(always)]
                                |row| out[row][lane],
                            ),
                        );
                    }
                }
            }
            start += S::F32_LANES;
        }
    }
}

impl ProjectChunk<'_> {
    /// Adds one visible Gaussian, unless it misses Inria's square or its depth for sorting is not positive.
    #[inline(always)]
    fn emit(&mut self, offset: usize, v: &[f32; 12]) {
        let radius = v[11].ceil();
        if self.rules.square_tiles && tiles::square([v[0], v[1]], radius, self.settings).iter().any(|axis| axis[0] >= axis[1]) {
            return;
        }
        let index = self.first + offset;
        // The float32 depth was over the near plane. At a near plane of 0, this one may be 0 or less all the same.
        let depth = self.camera.depth(&self.splats.means[3 * index..3 * index + 3]);
        if depth <= 0.0 {
            return;
        }
        let span = |center: f32, half: f32, size: usize| {
            let first = ((center - half - 0.5).ceil().max(0.0) as usize).min(size - 1) / TILE;
            let last = ((center + half - 0.5).floor().max(0.0) as usize).min(size - 1) / TILE;
            (last + 1 - first.min(last)) as u64
        };
        self.tiles += span(v[0], v[6], self.settings.width) * span(v[1], v[7], self.settings.height);
        // Integer radii stay below 2^31, as in Inria's code. The square has no such bound: its centre may be further than that from the image.
        self.radii[offset] = radius.min(1e9) as i64;
        self.slots[self.count] = ScreenSplat {
            center: [v[0], v[1]],
            factors: [v[2], v[3], v[4]],
            opacity: v[5],
            color: [0.0; 3],
            clamped: [false; 3],
            depth,
            half_width: v[6],
            radius,
            index: index as u32,
        };
        self.footprints[self.count] = Footprint { half_height: v[7], x_of_bottom: v[8], slope: v[9], aspect: v[10] };
        self.count += 1;
    }
    /// Sets the colour of a slot and moves it to `kept`, or culls it if the colour, before its clamp at zero, is not finite.
    #[inline(always)]
    fn finish(&mut self, slot: usize, kept: &mut usize, color: [f32; 3]) {
        let clamps = self.settings.sh_degree.is_some();
        let shown = each(
            #[inline(always)]
            |c| if clamps { color[c].max(0.0) } else { color[c] },
        );
        // A colour of exactly zero is not clamped: without its gradient, what is black could never change.
        let clamped = each(
            #[inline(always)]
            |c| clamps && color[c] < 0.0,
        );
        let splat = ScreenSplat { color: shown, clamped, ..self.slots[slot] };
        // False for NaN as well.
        if color.iter().all(|c| c.abs() < COLOR_LIMIT) {
            self.slots[*kept] = splat;
            self.footprints[*kept] = self.footprints[slot];
            *kept += 1;
        } else {
            self.radii[splat.index as usize - self.first] = 0;
        }
    }
}

struct Color<'k, 'a>(&'k mut ProjectChunk<'a>);

impl WithSimd for Color<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let k = self.0;
        let mut kept = 0;
        let Some(degree) = k.settings.sh_degree else {
            for slot in 0..k.count {
                let i = k.slots[slot].index as usize;
                k.finish(
                    slot,
                    &mut kept,
                    each(
                        #[inline(always)]
                        |c| k.splats.colors[3 * i + c],
                    ),
                );
            }
            k.count = kept;
            return;
        };
        let mut stage: Stage<{ 3 + 3 * sh::MAX_BASIS }> = [[0.0; WIDEST]; 3 + 3 * sh::MAX_BASIS];
        let mut indices = [0usize; WIDEST];
        let mut colors: Stage<3> = [[0.0; WIDEST]; 3];
        let mut values = [Lanes::splat(simd, 0.0); sh::MAX_BASIS];
        let mut start = 0;
        while start < k.count {
            let here = S::F32_LANES.min(k.count - start);
            for lane in 0..S::F32_LANES {
                indices[lane] = k.slots[start + lane.min(here - 1)].index as usize;
            }
            stage_coefficients(k.splats, degree, &indices[..S::F32_LANES], &mut stage);
            let mean: Vec3<S> = each(
                #[inline(always)]
                |c| Lanes::load(simd, &stage[c]),
            );
            let (direction, _) = view_direction(k.camera, mean);
            sh::basis(degree, direction, &mut values);
            for c in 0..3 {
                let mut sum = Lanes::splat(simd, 0.5);
                for (j, value) in values[..(degree + 1) * (degree + 1)].iter().enumerate() {
                    sum = value.fma(Lanes::load(simd, &stage[3 + 3 * j + c]), sum);
                }
                sum.store(&mut colors[c]);
            }
            for lane in 0..here {
                k.finish(
                    start + lane,
                    &mut kept,
                    each(
                        #[inline(always)]
                        |c| colors[c][lane],
                    ),
                );
            }
            start += S::F32_LANES;
        }
        k.count = kept;
    }
}

/// Means of the Gaussians `indices` in rows 0-2, then the coefficients up to `degree`, one column each.
///
/// Never inlined: inside a kernel the compiler turns the transposition into scatter instructions, which are slower than plain stores.
#[inline(never)]
pub fn stage_coefficients(splats: &SplatArrays, degree: usize, indices: &[usize], stage: &mut Stage<{ 3 + 3 * sh::MAX_BASIS }>) {
    let width = splats.rest_width();
    let needed = 3 * ((degree + 1) * (degree + 1) - 1);
    for (lane, &i) in indices.iter().enumerate().take(WIDEST) {
        for c in 0..3 {
            stage[c][lane] = splats.means[3 * i + c];
            stage[3 + c][lane] = splats.colors[3 * i + c];
        }
        let rest = &splats.sh_rest[i * width..i * width + needed];
        for (row, value) in stage[6..6 + needed].iter_mut().zip(rest) {
            row[lane] = *value;
        }
    }
}
