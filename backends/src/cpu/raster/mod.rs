//! Tile rasterizer for CPUs: projection, binning, blending, and the derivative of each.
//!
//! Every kernel is deterministic: tasks own what they write and all sums have a fixed order, so the bytes do not depend on the number of
//! threads. Order of work: `project` (per Gaussian), `tiles` (depth order, lists), `blend` (per tile); backwards
//! `blend_backward` (per tile, one record per Gaussian and tile), `gradient` (per Gaussian).

// Staged columns are indexed by row and lane; iterators over one of the two hide the other.
#![allow(clippy::needless_range_loop)]

mod blend;
mod blend_backward;
pub mod check;
pub mod geometry;
mod gradient;
pub mod parallel;
mod project;
mod scratch;
pub mod sh;
mod tiles;

pub use gradient::Gradients;
pub use scratch::Workspace;

use crate::ops::rasterize::{AT_A, AT_B, AT_C, AT_COLOR, AT_DEPTH, AT_OPACITY, AT_X, AT_Y, MAX_TILE_PAIRS, RECORD, TILE, TILE_PIXELS};
use crate::ops::rasterize::{GradientRequest, RasterSettings, camera};
use camera::{CameraConstants, RuleConstants};
use cc4dgs_core::RenderWork;

/// The arrays of N Gaussians, row-major.
#[derive(Clone, Copy, Debug)]
pub struct SplatArrays<'a> {
    /// Centres in world units `[N,3]`.
    pub means: &'a [f32],
    /// Log-scales or scales `[N,3]`.
    pub scales: &'a [f32],
    /// Raw quaternions (w,x,y,z) `[N,4]`.
    pub quaternions: &'a [f32],
    /// Logits or opacities `[N]`.
    pub opacities: &'a [f32],
    /// Degree-0 coefficients, or colours `[N,3]`.
    pub colors: &'a [f32],
    /// Higher coefficients `[N,K,3]`.
    pub sh_rest: &'a [f32],
    /// Colour behind everything.
    pub background: [f32; 3],
}

impl SplatArrays<'_> {
    /// The number of Gaussians N.
    pub fn len(&self) -> usize {
        self.opacities.len()
    }
    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.opacities.is_empty()
    }
    /// Floats of higher coefficients per Gaussian, 3 K.
    fn rest_width(&self) -> usize {
        if self.is_empty() { 0 } else { self.sh_rest.len() / self.len() }
    }
}

/// A visible Gaussian, ready to be blended.
// One cache line each: blending jumps through the array.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub struct ScreenSplat {
    /// Centre in pixels.
    pub center: [f32; 2],
    /// l1, l2, l3 of sigma = (l1 dx + l2 dy)^2 + (l3 dy)^2.
    pub factors: [f32; 3],
    /// Opacity, compensation included.
    pub opacity: f32,
    /// Red, green, blue.
    pub color: [f32; 3],
    /// Which of them were negative and are clamped at zero.
    pub clamped: [bool; 3],
    /// Camera depth in world units.
    pub depth: f32,
    /// Half of the width in which alpha can reach 1/255, pixels.
    pub half_width: f32,
    /// Screen radius, rounded up to whole pixels; unlike [`Forward::radii`] without an upper bound.
    pub radius: f32,
    /// Which Gaussian it is.
    pub index: u32,
}

/// What a forward pass returns.
pub struct Forward {
    /// Planes `[5,H,W]`: red, green, blue, alpha, depth.
    pub planes: Vec<f32>,
    /// Screen radius in pixels, 0 where culled `[N]`.
    pub radii: Vec<i64>,
    /// Largest blending weight `[N]`; empty unless the settings ask for it.
    pub max_weights: Vec<f32>,
    /// Counts of work.
    pub work: RenderWork,
    /// What the backward pass needs.
    pub workspace: Workspace,
}

/// Bounding boxes covered more tiles than [`MAX_TILE_PAIRS`]; holds their number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooManyPairs(pub u64);

/// Renders. Non-finite Gaussians are culled. Lengths of the arrays must agree (the operation checks them).
pub fn forward(splats: &SplatArrays, settings: &RasterSettings) -> Result<Forward, TooManyPairs> {
    let mut result = None;
    // One entry into the pool for the whole pass: the steps inside then start without waking threads.
    rayon::scope(|_| result = Some(forward_in_pool(splats, settings)));
    result.unwrap_or(Err(TooManyPairs(0)))
}

fn forward_in_pool(splats: &SplatArrays, settings: &RasterSettings) -> Result<Forward, TooManyPairs> {
    let camera = CameraConstants::new(settings);
    let rules = RuleConstants::new(settings);
    let mut workspace = Workspace::take();
    let mut radii = vec![0i64; splats.len()];
    project::project_all(splats, settings, &camera, &rules, &mut workspace, &mut radii)?;
    tiles::build_lists(settings, &rules, &mut workspace);
    let count = 5 * settings.width * settings.height;
    let mut planes = Vec::with_capacity(count);
    let pixel_pairs = blend::blend_all(splats.background, settings, &rules, &mut workspace, &mut planes.spare_capacity_mut()[..count]);
    // SAFETY: the capacity is there, and every element was written.
    unsafe { planes.set_len(count) };
    let max_weights = if settings.max_weights { blend::max_weights(splats.len(), &workspace) } else { Vec::new() };
    let work = RenderWork { visible: workspace.ranked.len() as u64, tile_pairs: workspace.list.len() as u64, pixel_pairs };
    Ok(Forward { planes, radii, max_weights, work, workspace })
}

/// Gradients of a render from d loss / d planes `[5,H,W]`.
pub fn backward(splats: &SplatArrays, settings: &RasterSettings, workspace: &mut Workspace, upstream: &[f32], request: &GradientRequest) -> Gradients {
    let mut result = None;
    rayon::scope(|_| {
        blend_backward::blend_backward_all(splats.background, settings, workspace, upstream, request.absolute_screen);
        result = Some(gradient::gradients(splats, settings, workspace, upstream, request));
    });
    result.unwrap_or_default()
}

/// Gradient of the screen-space quantities of every visible Gaussian, front to back: (Gaussian, [d centre (2), d (A,B,C), d opacity with
/// compensation, d colour (3), d depth]).
pub fn screen_gradients(background: [f32; 3], settings: &RasterSettings, workspace: &mut Workspace, upstream: &[f32]) -> Vec<(u32, [f32; RECORD])> {
    rayon::scope(|_| blend_backward::blend_backward_all(background, settings, workspace, upstream, false));
    let of_rank = |rank: usize| {
        let splat = &workspace.ranked[rank];
        let mut record = workspace.summed_record(rank, splat);
        let [l1, l2, l3] = splat.factors.map(f64::from);
        let [uu, ut, tt] = [record[AT_A], record[AT_B], record[AT_C]].map(f64::from);
        // dy = t / l3 and dx = (u - l2 dy) / l1.
        let (uy, yy) = (ut / l3, tt / (l3 * l3));
        let xy = (uy - l2 * yy) / l1;
        let xx = ((uu - l2 * uy) / l1 - l2 * xy) / l1;
        (record[AT_A], record[AT_B], record[AT_C]) = ((0.5 * xx) as f32, xy as f32, (0.5 * yy) as f32);
        (splat.index, record)
    };
    (0..workspace.ranked.len()).map(of_rank).collect()
}
