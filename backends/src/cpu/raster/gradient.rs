//! From screen-space gradients to those of the parameters, per Gaussian.

use super::camera::{CameraConstants, CameraSums};
use super::geometry::{ProjectionGradient, Vec3, project, project_backward};
use super::parallel::{SharedMut, run_tasks};
use super::project::{CHUNK, Stage, WIDEST, activate, stage_coefficients, stage_inputs, view_direction};
use super::scratch::Workspace;
use super::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, GradientRequest, RECORD, RasterSettings, SplatArrays, TILE, TILE_PIXELS, sh};
use crate::cpu::simd::{Lanes, dispatch, each};
use cc4dgs_core::ParameterSpace;
use pulp::{Simd, WithSimd};
use std::mem::MaybeUninit;

/// The gradients in a [`GradientRequest`]; the others are empty.
#[derive(Clone, Debug, Default)]
pub struct Gradients {
    /// `[N,3]`
    pub means: Vec<f32>,
    /// `[N,3]`
    pub scales: Vec<f32>,
    /// `[N,4]`
    pub quaternions: Vec<f32>,
    /// `[N]`
    pub opacities: Vec<f32>,
    /// `[N,3]`
    pub colors: Vec<f32>,
    /// `[N,K,3]`
    pub sh_rest: Vec<f32>,
    /// `[N,2]`
    pub screen: Vec<f32>,
    /// `[N,2]`
    pub absolute_screen: Vec<f32>,
    /// `[4,4]`
    pub camera: Vec<f32>,
    /// `[3]`
    pub background: Vec<f32>,
}

/// An array that the tasks fill completely, chunk by chunk.
struct Column {
    values: Vec<f32>,
    width: usize,
}

impl Column {
    fn new(wanted: bool, n: usize, width: usize) -> Self {
        Self { values: Vec::with_capacity(if wanted { n * width } else { 0 }), width: if wanted { width } else { 0 } }
    }
    fn share(&mut self) -> (SharedMut<'_, MaybeUninit<f32>>, usize) {
        (SharedMut::new(self.values.spare_capacity_mut()), self.width)
    }
    /// # Safety
    /// All of `n` rows must have been written.
    unsafe fn finish(mut self, n: usize) -> Vec<f32> {
        // SAFETY: the caller's promise; the capacity was reserved for n rows.
        unsafe { self.values.set_len(n * self.width) };
        self.values
    }
}

/// The zeroed rows of one chunk.
///
/// # Safety
/// A chunk belongs to one task.
unsafe fn rows<'a>(shared: &(SharedMut<'a, MaybeUninit<f32>>, usize), first: usize, len: usize) -> &'a mut [f32] {
    let (values, width) = shared;
    // SAFETY: disjoint by the caller's promise.
    let slice = unsafe { values.slice(first * width, len * width) };
    slice.fill(MaybeUninit::new(0.0));
    // SAFETY: every element was written just now, and the array outlives the tasks.
    unsafe { std::slice::from_raw_parts_mut(slice.as_mut_ptr().cast(), slice.len()) }
}

/// All gradients in `request` from the records of `workspace`.
pub fn gradients(splats: &SplatArrays, settings: &RasterSettings, workspace: &Workspace, upstream: &[f32], request: &GradientRequest) -> Gradients {
    let n = splats.len();
    let camera = CameraConstants::new(settings);
    let chunks = n.div_ceil(CHUNK);
    let mut columns = [
        Column::new(request.means, n, 3),
        Column::new(request.scales, n, 3),
        Column::new(request.quaternions, n, 4),
        Column::new(request.opacities, n, 1),
        Column::new(request.colors, n, 3),
        Column::new(request.sh_rest, n, splats.rest_width()),
        Column::new(request.screen, n, 2),
        Column::new(request.absolute_screen, n, 2),
    ];
    let mut camera_parts = vec![CameraSums::default(); if request.camera { chunks } else { 0 }];
    {
        let shared = columns.each_mut().map(Column::share);
        let parts = SharedMut::new(&mut camera_parts);
        run_tasks(chunks, |chunk| {
            let first = chunk * CHUNK;
            let len = CHUNK.min(n - first);
            // SAFETY: every task has a chunk of its own.
            let (out, camera_sums) = unsafe {
                (shared.each_ref().map(|column| rows(column, first, len)), parts.slice(if request.camera { chunk } else { 0 }, usize::from(request.camera)))
            };
            let count = workspace.chunk_counts[chunk].0 as usize;
            let sums = dispatch(GradientChunk { splats, settings, camera: &camera, workspace, first, count, request, out });
            if let Some(part) = camera_sums.first_mut() {
                *part = sums;
            }
        });
    }
    let mut sums = CameraSums::default();
    camera_parts.iter().for_each(|part| sums.add(part));
    // SAFETY: the chunks cover all rows.
    let [means, scales, quaternions, opacities, colors, sh_rest, screen, absolute_screen] = columns.map(|column| unsafe { column.finish(n) });
    Gradients {
        means,
        scales,
        quaternions,
        opacities,
        colors,
        sh_rest,
        screen,
        absolute_screen,
        camera: if request.camera { sums.matrix_gradient(&settings.world_to_camera).to_vec() } else { Vec::new() },
        background: if request.background { background_gradient(settings, workspace, upstream).to_vec() } else { Vec::new() },
    }
}

/// Sum over pixels of the transmittance left times the upstream colour.
fn background_gradient(settings: &RasterSettings, workspace: &Workspace, upstream: &[f32]) -> [f32; 3] {
    let tiles_x = settings.width.div_ceil(TILE);
    let plane = settings.width * settings.height;
    let mut sums = [0.0f64; 3];
    for y in 0..settings.height {
        let mut row = [0.0f64; 3];
        for x in 0..settings.width {
            let tile = y / TILE * tiles_x + x / TILE;
            let left = workspace.final_transmittance[tile * TILE_PIXELS + y % TILE * TILE + x % TILE];
            for c in 0..3 {
                row[c] += f64::from(left) * f64::from(upstream[c * plane + y * settings.width + x]);
            }
        }
        (0..3).for_each(|c| sums[c] += row[c]);
    }
    sums.map(|v| v as f32)
}

struct GradientChunk<'a> {
    splats: &'a SplatArrays<'a>,
    settings: &'a RasterSettings,
    camera: &'a CameraConstants,
    workspace: &'a Workspace,
    first: usize,
    count: usize,
    request: &'a GradientRequest,
    out: [&'a mut [f32]; OUTPUTS],
}

/// Number of output arrays with a row per Gaussian, and their indices.
const OUTPUTS: usize = 8;
const MEANS: usize = 0;
const SCALES: usize = 1;
const QUATERNIONS: usize = 2;
const OPACITIES: usize = 3;
const COLORS: usize = 4;
const SH_REST: usize = 5;
const SCREEN: usize = 6;
const ABSOLUTE_SCREEN: usize = 7;

/// Staged columns of the screen side: the record, then 1 per colour channel that is not clamped at zero.
const SCREEN_ROWS: usize = RECORD + 3;
/// Rows of the gradient of the camera: rotation, translation, centre.
const CAMERA_ROWS: usize = 15;

impl WithSimd for GradientChunk<'_> {
    type Output = CameraSums;
    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) -> CameraSums {
        let mut stage: Stage<11> = [[0.0; WIDEST]; 11];
        let mut screen: Stage<SCREEN_ROWS> = [[0.0; WIDEST]; SCREEN_ROWS];
        let mut indices = [0usize; WIDEST];
        let mut camera_sums = [Lanes::splat(simd, 0.0); CAMERA_ROWS];
        let mut start = 0;
        while start < self.count {
            let here = S::F32_LANES.min(self.count - start);
            for lane in 0..S::F32_LANES {
                // Lanes without a Gaussian repeat the last one with no gradient.
                let slot = self.first + start + lane.min(here - 1);
                let splat = &self.workspace.slots[slot];
                indices[lane] = splat.index as usize;
                if lane < here && self.request.absolute_screen {
                    let row = 2 * (indices[lane] - self.first);
                    let sums = self.workspace.summed_absolute(self.workspace.rank_of_slot[slot] as usize);
                    self.out[ABSOLUTE_SCREEN][row..row + 2].copy_from_slice(&sums);
                }
                let record = if lane < here { self.workspace.summed_record(self.workspace.rank_of_slot[slot] as usize, splat) } else { [0.0; RECORD] };
                for (row, value) in screen.iter_mut().zip(record) {
                    row[lane] = value;
                }
                for c in 0..3 {
                    screen[RECORD + c][lane] = if splat.clamped[c] { 0.0 } else { 1.0 };
                }
            }
            // The records of the next group are scattered over the lists: prefetch them.
            for slot in start + here..self.count.min(start + here + S::F32_LANES) {
                self.workspace.prefetch_records(self.workspace.rank_of_slot[self.first + slot] as usize);
            }
            stage_inputs::<S>(self.splats, |lane| indices[lane], &mut stage);
            self.group(simd, &indices[..here], &stage, &screen, &mut camera_sums);
            start += S::F32_LANES;
        }
        let sums: [f64; CAMERA_ROWS] = each(
            #[inline(always)]
            |k| f64::from(camera_sums[k].sum()),
        );
        CameraSums {
            rotation: each(
                #[inline(always)]
                |k| sums[k],
            ),
            translation: each(
                #[inline(always)]
                |k| sums[9 + k],
            ),
            center: each(
                #[inline(always)]
                |k| sums[12 + k],
            ),
        }
    }
}

impl GradientChunk<'_> {
    /// The Gaussians `indices`, staged in columns. The projection is skipped where nothing that depends on it was requested.
    #[inline(always)]
    fn group<S: Simd>(&mut self, simd: S, indices: &[usize], stage: &Stage<11>, screen: &Stage<SCREEN_ROWS>, camera_sums: &mut [Lanes<S>; CAMERA_ROWS]) {
        let inputs: [Lanes<S>; 11] = each(
            #[inline(always)]
            |i| Lanes::load(simd, &stage[i]),
        );
        let g: [Lanes<S>; RECORD] = each(
            #[inline(always)]
            |i| Lanes::load(simd, &screen[i]),
        );
        let mean: Vec3<S> = [inputs[0], inputs[1], inputs[2]];
        let color: Vec3<S> = each(
            #[inline(always)]
            |c| g[AT_COLOR + c] * Lanes::load(simd, &screen[RECORD + c]),
        );
        let (d_colors, d_offset) = match self.settings.sh_degree {
            Some(degree) => {
                let (d_dc, d_offset) = self.harmonics(simd, degree, indices, mean, color);
                (d_dc, Some(d_offset))
            }
            None => (color, None),
        };
        self.scatter(COLORS, indices, &d_colors);
        self.scatter(SCREEN, indices, &[g[AT_X], g[AT_Y]]);
        let request = self.request;
        let geometry = request.means || request.scales || request.quaternions || request.camera;
        if !geometry && !request.opacities {
            return;
        }
        let (space, antialiased) = (self.settings.space, self.settings.antialiased);
        let (scales, opacity) = activate(space, [inputs[3], inputs[4], inputs[5]], inputs[10]);
        let mut d_opacity = g[AT_OPACITY];
        if geometry || antialiased {
            let p = project(self.camera, mean, [inputs[6], inputs[7], inputs[8], inputs[9]], scales);
            let compensation = if antialiased { d_opacity * opacity } else { Lanes::splat(simd, 0.0) };
            if antialiased {
                d_opacity = d_opacity * p.compensation;
            }
            let upstream = ProjectionGradient { center: [g[AT_X], g[AT_Y]], moments: [g[AT_A], g[AT_B], g[AT_C]], depth: g[AT_DEPTH], compensation };
            let mut d = project_backward(self.camera, mean, &p, &upstream);
            if space == ParameterSpace::Raw {
                for k in 0..3 {
                    d.scales[k] = d.scales[k] * scales[k];
                }
            }
            if let Some(d_offset) = d_offset {
                for k in 0..3 {
                    d.mean[k] += d_offset[k];
                    camera_sums[12 + k] += -d_offset[k];
                }
            }
            if request.camera {
                for k in 0..9 {
                    camera_sums[k] += d.camera_rotation[k / 3][k % 3];
                }
                for k in 0..3 {
                    camera_sums[9 + k] += d.camera_translation[k];
                }
            }
            self.scatter(MEANS, indices, &d.mean);
            self.scatter(SCALES, indices, &d.scales);
            self.scatter(QUATERNIONS, indices, &d.quaternion);
        }
        if space == ParameterSpace::Raw {
            d_opacity = d_opacity * opacity * (Lanes::splat(simd, 1.0) - opacity);
        }
        self.scatter(OPACITIES, indices, &[d_opacity]);
    }
    /// Gradient of the degree-0 coefficients and of the offset from the camera; writes those of the higher coefficients.
    #[inline(always)]
    fn harmonics<S: Simd>(&mut self, simd: S, degree: usize, indices: &[usize], mean: Vec3<S>, color: Vec3<S>) -> (Vec3<S>, Vec3<S>) {
        let zero = Lanes::splat(simd, 0.0);
        let count = (degree + 1) * (degree + 1);
        let (direction, inverse) = view_direction(self.camera, mean);
        let mut values = [zero; sh::MAX_BASIS];
        sh::basis(degree, direction, &mut values);
        let mut offset = [zero; 3];
        if degree > 0 && (self.request.means || self.request.camera) {
            let mut stage: Stage<{ 3 + 3 * sh::MAX_BASIS }> = [[0.0; WIDEST]; 3 + 3 * sh::MAX_BASIS];
            stage_coefficients(self.splats, degree, indices, &mut stage);
            let mut shown = [zero; sh::MAX_BASIS];
            for k in 1..count {
                let coefficient = |c: usize| Lanes::load(simd, &stage[3 + 3 * k + c]);
                shown[k] = coefficient(0).fma(color[0], coefficient(1).fma(color[1], coefficient(2) * color[2]));
            }
            offset = sh::normalize_backward(direction, inverse, sh::basis_backward(degree, direction, &shown));
        }
        if self.request.sh_rest && degree > 0 {
            let width = self.splats.rest_width();
            let mut basis_columns: Stage<{ sh::MAX_BASIS }> = [[0.0; WIDEST]; sh::MAX_BASIS];
            let mut color_columns: Stage<3> = [[0.0; WIDEST]; 3];
            for k in 1..count {
                values[k].store(&mut basis_columns[k]);
            }
            for c in 0..3 {
                color[c].store(&mut color_columns[c]);
            }
            for (lane, index) in indices.iter().enumerate() {
                let row = &mut self.out[SH_REST][(index - self.first) * width..][..3 * (count - 1)];
                let rgb: [f32; 3] = each(
                    #[inline(always)]
                    |c| color_columns[c][lane],
                );
                for (k, coefficient) in row.chunks_exact_mut(3).enumerate() {
                    let value = basis_columns[k + 1][lane];
                    for c in 0..3 {
                        coefficient[c] = value * rgb[c];
                    }
                }
            }
        }
        (
            each(
                #[inline(always)]
                |c| color[c] * values[0],
            ),
            offset,
        )
    }
    /// Writes columns to the rows of the Gaussians `indices` of output `which`, if it was requested.
    #[inline(always)]
    fn scatter<S: Simd, const WIDTH: usize>(&mut self, which: usize, indices: &[usize], columns: &[Lanes<S>; WIDTH]) {
        if self.out[which].is_empty() {
            return;
        }
        let mut staged: Stage<WIDTH> = [[0.0; WIDEST]; WIDTH];
        for (column, row) in columns.iter().zip(&mut staged) {
            column.store(row);
        }
        for (lane, index) in indices.iter().enumerate() {
            let row = &mut self.out[which][(index - self.first) * WIDTH..][..WIDTH];
            for k in 0..WIDTH {
                row[k] = staged[k][lane];
            }
        }
    }
}
