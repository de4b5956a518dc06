//! The rasterizer `reference`: slow, obvious, float64. It is the oracle of `tile` and shares no arithmetic with it: geometry is
//! differentiated by carrying derivatives along ([`real::Dual`]), blending pixel by pixel over the whole list.
//!
//! The same formulas in float32 ([`Precision::Float32`]) show the error of rounding alone, with which the error of a float32 kernel is compared.

// Formulas with indices read as in the papers.
#![allow(clippy::needless_range_loop)]

pub mod blend;
pub mod gaussian;
pub mod harmonics;
pub mod real;

use super::settings::raster_settings;
use super::tile::raster_inputs;
use crate::ops::rasterize::{AT_COLOR, AT_DEPTH, Method, RECORD, RasterSettings, rasterize};
use blend::Item;
use cc4dgs_core::{Camera, Plugin, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, Result, Splats, config, inventory};
use gaussian::{Gaussian, Projected};
use real::{Dual, Real};

/// What the reference computes in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// The oracle.
    #[default]
    Float64,
    /// The same formulas, rounded.
    Float32,
}

/// The arrays of N Gaussians in float64, row-major, as in [`crate::cpu::raster::SplatArrays`].
#[derive(Clone, Debug, Default)]
pub struct ReferenceInput {
    /// `[N,3]`
    pub means: Vec<f64>,
    /// `[N,3]`
    pub scales: Vec<f64>,
    /// `[N,4]`
    pub quaternions: Vec<f64>,
    /// `[N]`
    pub opacities: Vec<f64>,
    /// `[N,3]`
    pub colors: Vec<f64>,
    /// `[N,K,3]`
    pub sh_rest: Vec<f64>,
    /// Colour behind everything.
    pub background: [f64; 3],
}

/// What a forward pass returns.
#[derive(Clone, Debug)]
pub struct ReferenceOutput {
    /// Red, green, blue, alpha, depth `[5,H,W]`.
    pub planes: Vec<f64>,
    /// Screen radius, the larger of the two axes; 0 where culled `[N]`.
    pub radii: Vec<i64>,
    /// Largest blending weight `[N]`.
    pub max_weights: Vec<f64>,
    /// Visible Gaussians, front to back.
    pub items: Vec<Item>,
    /// Contributing (Gaussian, pixel) pairs.
    pub pairs: u64,
}

/// Gradients of everything.
#[derive(Clone, Debug)]
pub struct ReferenceGradients {
    /// `[N,3]`
    pub means: Vec<f64>,
    /// `[N,3]`
    pub scales: Vec<f64>,
    /// `[N,4]`
    pub quaternions: Vec<f64>,
    /// `[N]`
    pub opacities: Vec<f64>,
    /// `[N,3]`
    pub colors: Vec<f64>,
    /// `[N,K,3]`
    pub sh_rest: Vec<f64>,
    /// `[N,2]`
    pub screen: Vec<f64>,
    /// `[N,2]`
    pub absolute_screen: Vec<f64>,
    /// `[4,4]`
    pub camera: Vec<f64>,
    /// `[3]`
    pub background: Vec<f64>,
    /// Of the screen quantities, by item: centre, conic, opacity, colour, depth.
    pub items: Vec<[f64; RECORD]>,
}

fn three(values: &[f64], i: usize) -> [f64; 3] {
    std::array::from_fn(|k| values[3 * i + k])
}

impl ReferenceInput {
    /// Float32 arrays, widened.
    pub fn widen(splats: &crate::cpu::raster::SplatArrays) -> Self {
        let wide = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect();
        Self {
            means: wide(splats.means),
            scales: wide(splats.scales),
            quaternions: wide(splats.quaternions),
            opacities: wide(splats.opacities),
            colors: wide(splats.colors),
            sh_rest: wide(splats.sh_rest),
            background: splats.background.map(f64::from),
        }
    }
    fn gaussian<T: Real>(&self, i: usize, settings: &RasterSettings, number: impl Fn(f64, usize) -> T) -> Gaussian<T> {
        let mean = three(&self.means, i);
        let scales = three(&self.scales, i);
        Gaussian {
            mean: std::array::from_fn(|k| number(mean[k], k)),
            scales: std::array::from_fn(|k| number(scales[k], 3 + k)),
            quaternion: std::array::from_fn(|k| number(self.quaternions[4 * i + k], 6 + k)),
            opacity: number(self.opacities[i], 10),
            view: std::array::from_fn(|r| std::array::from_fn(|c| number(settings.world_to_camera[r][c], 11 + 4 * r + c))),
        }
    }
    /// Whether centre, scales, quaternion and opacity of Gaussian `i` are finite, as they are stored.
    fn is_finite(&self, i: usize) -> bool {
        let stored = [&self.means[3 * i..3 * i + 3], &self.scales[3 * i..3 * i + 3], &self.quaternions[4 * i..4 * i + 4], &self.opacities[i..=i]];
        stored.into_iter().flatten().all(|v| v.is_finite())
    }
    /// The coefficients of Gaussian `i` for basis function `k`.
    fn coefficient(&self, i: usize, k: usize) -> [f64; 3] {
        if k == 0 {
            return three(&self.colors, i);
        }
        let width = self.sh_rest.len() / self.opacities.len();
        std::array::from_fn(|c| self.sh_rest[i * width + 3 * (k - 1) + c])
    }
    /// Colour before the clamp at zero.
    fn color<T: Real>(&self, i: usize, degree: Option<usize>, direction: [T; 3]) -> [T; 3] {
        let Some(degree) = degree else { return three(&self.colors, i).map(T::constant) };
        let mut sum = [T::constant(0.5); 3];
        for (k, value) in harmonics::basis(degree, direction).into_iter().enumerate() {
            let coefficient = self.coefficient(i, k);
            for c in 0..3 {
                sum[c] = sum[c] + value * T::constant(coefficient[c]);
            }
        }
        sum
    }
}

/// Variables of one Gaussian: mean, scales, quaternion, opacity, view matrix.
const VARIABLES: usize = 27;

/// The visible Gaussians front to back, and the screen radius of all, 0 where culled.
fn visible<T: Real>(input: &ReferenceInput, settings: &RasterSettings) -> (Vec<Item>, Vec<i64>) {
    let n = input.opacities.len();
    let mut radii = vec![0i64; n];
    let mut items = Vec::new();
    for i in (0..n).filter(|&i| input.is_finite(i)) {
        let exact: Projected<T> = gaussian::project(&input.gaussian(i, settings, |v, _| T::constant(v)), settings);
        let p = exact.widened();
        let Some((radius, tiles)) = gaussian::extent(&p, settings) else { continue };
        let color = input.color(i, settings.sh_degree, exact.direction).map(T::value);
        if color.iter().any(|c| !c.is_finite()) {
            continue;
        }
        let color = if settings.sh_degree.is_some() { color.map(|c| c.max(0.0)) } else { color };
        radii[i] = radius[0].max(radius[1]).min(1e9) as i64;
        let numbers = [p.center[0], p.center[1], p.conic[0], p.conic[1], p.conic[2], p.opacity, color[0], color[1], color[2], p.depth];
        items.push(Item { index: i, numbers, tiles });
    }
    // By depth as float32; equal depths stay in order of index.
    items.sort_by(|a, b| (a.numbers[AT_DEPTH] as f32).total_cmp(&(b.numbers[AT_DEPTH] as f32)));
    (items, radii)
}

/// Renders in float64.
pub fn forward(input: &ReferenceInput, settings: &RasterSettings) -> ReferenceOutput {
    forward_in(Precision::Float64, input, settings)
}

/// Renders.
pub fn forward_in(precision: Precision, input: &ReferenceInput, settings: &RasterSettings) -> ReferenceOutput {
    match precision {
        Precision::Float64 => forward_real::<f64>(input, settings),
        Precision::Float32 => forward_real::<f32>(input, settings),
    }
}

fn forward_real<T: Real>(input: &ReferenceInput, settings: &RasterSettings) -> ReferenceOutput {
    let (items, radii) = visible::<T>(input, settings);
    let image = blend::blend::<T>(&items, settings, input.background);
    let mut max_weights = vec![0.0; radii.len()];
    for (item, weight) in items.iter().zip(&image.max_weights) {
        max_weights[item.index] = *weight;
    }
    ReferenceOutput { planes: image.planes, radii, max_weights, items, pairs: image.pairs }
}

/// Gradients in float64 for `upstream` `[5,H,W]` at the visible `items` of the forward pass.
pub fn backward(input: &ReferenceInput, settings: &RasterSettings, items: &[Item], upstream: &[f64]) -> ReferenceGradients {
    backward_in(Precision::Float64, input, settings, items, upstream)
}

/// Gradients for `upstream` `[5,H,W]` at the visible `items` of the forward pass in the same precision.
pub fn backward_in(precision: Precision, input: &ReferenceInput, settings: &RasterSettings, items: &[Item], upstream: &[f64]) -> ReferenceGradients {
    match precision {
        Precision::Float64 => backward_real::<f64>(input, settings, items, upstream),
        Precision::Float32 => backward_real::<f32>(input, settings, items, upstream),
    }
}

fn backward_real<T: Real>(input: &ReferenceInput, settings: &RasterSettings, items: &[Item], upstream: &[f64]) -> ReferenceGradients {
    let n = input.opacities.len();
    let blended = blend::blend_backward::<T>(items, settings, input.background, upstream);
    let mut out = ReferenceGradients {
        means: vec![0.0; 3 * n],
        scales: vec![0.0; 3 * n],
        quaternions: vec![0.0; 4 * n],
        opacities: vec![0.0; n],
        colors: vec![0.0; 3 * n],
        sh_rest: vec![0.0; input.sh_rest.len()],
        screen: vec![0.0; 2 * n],
        absolute_screen: vec![0.0; 2 * n],
        camera: vec![0.0; 16],
        background: blended.background.to_vec(),
        items: Vec::new(),
    };
    for ((item, g), absolute) in items.iter().zip(&blended.items).zip(&blended.absolute_centers) {
        let i = item.index;
        let p = gaussian::project(&input.gaussian(i, settings, |v, k| Dual::<VARIABLES, T>::variable(T::constant(v), k)), settings);
        let color = input.color(i, settings.sh_degree, p.direction);
        let mut d = [T::constant(0.0); VARIABLES];
        let mut add = |quantity: Dual<VARIABLES, T>, g: f64| (0..VARIABLES).for_each(|v| d[v] = d[v] + T::constant(g) * quantity.slope[v]);
        for (quantity, g) in [p.center[0], p.center[1], p.conic[0], p.conic[1], p.conic[2], p.opacity].into_iter().zip(g) {
            add(quantity, *g);
        }
        add(p.depth, g[AT_DEPTH]);
        let d_color: [f64; 3] = std::array::from_fn(|c| if settings.sh_degree.is_some() && color[c].value() < 0.0 { 0.0 } else { g[AT_COLOR + c] });
        for c in 0..3 {
            add(color[c], d_color[c]);
        }
        let d = d.map(T::value);
        out.means[3 * i..3 * i + 3].copy_from_slice(&d[0..3]);
        out.scales[3 * i..3 * i + 3].copy_from_slice(&d[3..6]);
        out.quaternions[4 * i..4 * i + 4].copy_from_slice(&d[6..10]);
        out.opacities[i] = d[10];
        for k in 0..16 {
            out.camera[k] += d[11 + k];
        }
        out.screen[2 * i..2 * i + 2].copy_from_slice(&g[0..2]);
        out.absolute_screen[2 * i..2 * i + 2].copy_from_slice(absolute);
        let values = settings.sh_degree.map_or(vec![T::constant(1.0)], |degree| harmonics::basis(degree, p.direction.map(|v| v.value)));
        let width = input.sh_rest.len() / n;
        for (k, value) in values.into_iter().enumerate() {
            let to = if k == 0 { &mut out.colors[3 * i..3 * i + 3] } else { &mut out.sh_rest[i * width + 3 * (k - 1)..][..3] };
            for c in 0..3 {
                to[c] = (value * T::constant(d_color[c])).value();
            }
        }
    }
    out.items = blended.items;
    out
}

/// Draws with [`forward_in`] and [`backward_in`]; the time grows with pixels times Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReferenceRasterizer {
    /// What it computes in.
    pub precision: Precision,
}

impl Rasterizer for ReferenceRasterizer {
    fn render(&self, splats: &Splats, camera: &Camera, settings: &RenderSettings) -> Result<RenderOutput> {
        rasterize(raster_inputs(splats, settings), raster_settings(splats, camera, settings)?, Method::Reference(self.precision))
    }
}

/// Settings of the plug-in.
#[derive(serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    #[serde(default)]
    precision: Precision,
}

inventory::submit! {
    RasterizerPlugin {
        info: Plugin {
            name: "reference",
            version: "1",
            summary: "every Gaussian at every pixel in float64: slow, the reference that tests compare with",
            paper: "Kerbl et al. 2023 (3DGS); Ye et al. 2024 (gsplat)",
            schema: "# \"float64\", or \"float32\": the same formulas, rounded\nprecision = \"float64\"\n",
            capabilities: &["differentiable", "antialiased", "max-weights", "rules=gsplat099,gsplat0999,inria"],
        },
        build: |table| {
            let Settings { precision } = config::parse_section("rasterizer reference", table)?;
            Ok(Box::new(ReferenceRasterizer { precision }))
        },
    }
}
