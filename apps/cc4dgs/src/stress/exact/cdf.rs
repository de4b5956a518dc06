//! `cdf` and `cdf-basis`: features of centres without stored tables (CC-4DGS, Section IV-B), and the offsets computed from them. `hash-basis`: as `cdf-basis`,
//! with features from a stored hash grid.

use super::grids::{HashGrid, cell, interpolate};
use super::network::{chain, decoder, dot};
use super::{Formula, Inputs, Rows, Weights, in_box};
use cc4dgs_core::{DeformerContext, Result, config, toml};
use cc4dgs_deformers::cdf::CdfConfig;
use cc4dgs_deformers::parts::heads::Head;
use cc4dgs_deformers::parts::voxels::VoxelSettings;
use serde::Deserialize;
use std::f64::consts::TAU;

/// The settings that the formulas read, of each of the three: those of the bands of time.
pub const SETTINGS: &[&str] = &["cycles", "falloff"];
/// Bands, learned functions and heads of `cdf-basis` and `hash-basis`.
const MOST_BANDS: usize = 6;
const LEARNED: usize = 16;
/// Falloff of the bands that the network of the learned functions reads, whatever the setting.
const NETWORK_FALLOFF: f32 = 1.0;
/// Widths of the hidden layers of the coefficient network of each. The functions' network has two layers of the last width.
const CDF_BASIS: &[usize] = &[128, 128];
const HASH_BASIS: &[usize] = &[64];
/// Levels, vertices per axis of the first, features per level and most rows of a level of `hash-basis`.
const GRID: (u32, u32, usize, usize) = (6, 16, 4, 1 << 15);
const BASIS_HEADS: [(&str, usize); 3] = [("means", 3), ("log_scales", 3), ("quaternions", 4)];

struct Cdf {
    config: CdfConfig,
    context: DeformerContext,
    weights: Weights,
    /// Voxel features per Gaussian.
    features: Rows,
}

struct Basis {
    bands: usize,
    settings: BandSettings,
    weights: Weights,
    /// Hidden layers of the coefficient network.
    hidden: &'static [usize],
    /// Features of space per Gaussian.
    features: Rows,
}

/// [`SETTINGS`] of `cdf-basis` and `hash-basis`.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct BandSettings {
    cycles: f32,
    falloff: f32,
}

impl Default for BandSettings {
    fn default() -> Self {
        Self { cycles: 1.0, falloff: 1.0 }
    }
}

/// `cdf`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let Inputs { settings, weights, context, points, .. } = inputs;
    let config: CdfConfig = config::parse_section("deformer cdf", &settings)?;
    let features = voxels(&config.voxels, &context, &points, &weights)?;
    Ok(Box::new(Cdf { config, context, weights, features }))
}

/// `cdf-basis`.
pub fn build_basis(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let Inputs { settings, weights, context, points, .. } = inputs;
    let features = voxels(&VoxelSettings::default(), &context, &points, &weights)?;
    basis(&settings, weights, &context, CDF_BASIS, features)
}

/// `hash-basis`. Points outside the box are moved to its nearest face.
pub fn build_hash_basis(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let Inputs { settings, weights, context, points, .. } = inputs;
    let (levels, base, features, most_rows) = GRID;
    let grid = HashGrid::<3>::new((0..levels).map(|level| [f64::from((base << level) - 1); 3]), most_rows, features, 0.0, false);
    let table = weights.of("grid.table")?;
    let features = points.iter().map(|point| grid.features(table, in_box(point, &context).map(|x| x.clamp(0.0, 1.0)))).collect();
    basis(&settings, weights, &context, HASH_BASIS, features)
}

/// What `cdf-basis` and `hash-basis` have in common: everything after the features of space.
fn basis(settings: &toml::Table, weights: Weights, context: &DeformerContext, hidden: &'static [usize], features: Rows) -> Result<Box<dyn Formula>> {
    let settings = config::parse_section("bands of cdf-basis and hash-basis", settings)?;
    Ok(Box::new(Basis { bands: bands_for(context.frame_count).min(MOST_BANDS), settings, weights, hidden, features }))
}

/// Hash signatures of the eight corners, a decoder per level, trilinear interpolation. Points outside the box are moved to its nearest face.
fn voxels(settings: &VoxelSettings, context: &DeformerContext, points: &[[f64; 3]], weights: &Weights) -> Result<Rows> {
    let sizes = settings.sizes()?;
    let mut rows = vec![Vec::new(); points.len()];
    for (level, &resolution) in sizes.resolutions.iter().enumerate() {
        let hash = settings.hash(context, level);
        let weights = weights.of(&format!("grid.level{level}"))?;
        let decoded = |vertex: [u32; 3]| {
            let mut signature = vec![0.0f32; settings.hashes];
            hash.signatures(&[vertex], &mut signature);
            decoder(signature.into_iter().map(f64::from).collect(), weights, &sizes.decoder)
        };
        for (point, row) in points.iter().zip(&mut rows) {
            let cell_at = in_box(point, context).map(|x| cell(x.clamp(0.0, 1.0) * f64::from(resolution), resolution - 1));
            row.extend(interpolate(cell_at, decoded));
        }
    }
    Ok(rows)
}

impl Formula for Cdf {
    /// Time features modulate the spatial ones (FiLM), a trunk, and a head per attribute.
    fn offsets(&self, t: f64) -> Result<Rows> {
        let sizes = self.config.sizes(&self.context)?;
        let w = sizes.width;
        let network = &self.config.network;
        let time = encode(t, sizes.time_bands, network.cycles, network.falloff);
        let mut widths = vec![time.len()];
        widths.extend(sizes.time.trunk.iter().chain(sizes.time.heads.iter().flatten()));
        let f_time = chain(time, self.weights.of("net.time")?, &widths, false);
        let modulation = chain(f_time, self.weights.of("net.film")?, &[w, w, 2 * w], false);
        let (scale, shift) = modulation.split_at(w);
        let trunk: Vec<usize> = std::iter::once(w).chain(sizes.network.trunk.iter().copied()).collect();
        let row = |features: &Vec<f64>| {
            let mut hidden = chain(features.clone(), self.weights.of("net.spatial")?, &[features.len(), w], false);
            hidden.iter_mut().zip(scale.iter().zip(shift)).for_each(|(h, (scale, shift))| *h = *h * scale + shift);
            let hidden = chain(hidden, self.weights.of("net.trunk")?, &trunk, true);
            let head = |head: &Head| {
                let widths = [w, w, head.width(self.context.sh_degree)];
                Ok(chain(hidden.clone(), self.weights.of(&format!("net.head.{}", head.name()))?, &widths, false))
            };
            Ok(network.heads.iter().map(head).collect::<Result<Rows>>()?.concat())
        };
        self.features.iter().map(row).collect()
    }
}

impl Formula for Basis {
    /// Coefficients per Gaussian times functions that all share: 1, t, bands, and those of a network.
    fn offsets(&self, t: f64) -> Result<Rows> {
        let encoded = |falloff: f32| encode(t, self.bands, self.settings.cycles, falloff);
        let w = self.hidden.last().copied().unwrap_or(0);
        let input = encoded(NETWORK_FALLOFF);
        let widths = [input.len(), w, w, LEARNED];
        let learned = chain(input, self.weights.of("net.functions")?, &widths, false);
        let functions = [vec![1.0], encoded(self.settings.falloff), learned].concat();
        let row = |features: &Vec<f64>| {
            let trunk: Vec<usize> = std::iter::once(features.len()).chain(self.hidden.iter().copied()).collect();
            let hidden = chain(features.clone(), self.weights.of("net.trunk")?, &trunk, true);
            let mut out = Vec::new();
            for (name, width) in BASIS_HEADS {
                let coefficients = chain(hidden.clone(), self.weights.of(&format!("net.head.{name}"))?, &[w, w, width * functions.len()], false);
                out.extend(coefficients.chunks_exact(functions.len()).map(|own| dot(own, &functions)));
            }
            Ok(out)
        };
        self.features.iter().map(row).collect()
    }
}

/// As `cc4dgs_fields::time::bands_for` says: the highest band is near half the frame count.
fn bands_for(frames: usize) -> usize {
    (frames.max(1) as f64).log2().round().clamp(1.0, 16.0) as usize
}

/// t, then sine and cosine of each band: `cycles` cycles per sequence in the lowest, twice as many in each higher one, whose amplitude is 2^-`falloff` times
/// that of the one below.
fn encode(t: f64, bands: usize, cycles: f32, falloff: f32) -> Vec<f64> {
    let pair = |band: usize| {
        let (sin, cos) = (TAU * (t * f64::from(cycles) * (band as f64).exp2()).fract()).sin_cos();
        let amplitude = (-f64::from(falloff) * band as f64).exp2();
        [amplitude * sin, amplitude * cos]
    };
    std::iter::once(t).chain((0..bands).flat_map(pair)).collect()
}
