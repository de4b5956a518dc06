//! Deformers in float64: the plain formulas of those that have no float64 of their own, with the default settings. Slow and obvious.
//!
//! Weights and attributes are read from a deformer by name, as float32; everything computed from them is float64.

use cc4dgs_backends::ops::field::MishShape;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, Error, LIFE_GATE_STEEPNESS, Result, config, toml};
use cc4dgs_deformers::cdf::CdfConfig;
use cc4dgs_deformers::parts::heads::Head;
use cc4dgs_deformers::parts::voxels::VoxelSettings;
use std::collections::BTreeMap;
use std::f64::consts::TAU;

/// Added to variances in the layer norm of decoders.
const NORM_EPSILON: f64 = 1e-5;
/// Largest absolute coordinate that `deform-mlp` encodes.
const FAR: f64 = 1e6;
/// Bands, width and layers of `deform-mlp`, and after how many layers the input comes again.
const MLP_BANDS: usize = 10;
const MLP_WIDTH: usize = 256;
const MLP_LAYERS: [usize; 2] = [5, 3];
/// Bands, and hidden layers and width of networks, of `cdf-basis`.
const MOST_BANDS: usize = 6;
const BASIS_WIDTH: usize = 128;
const LEARNED: usize = 16;
const BASIS_HEADS: [(&str, usize); 3] = [("means", 3), ("log_scales", 3), ("quaternions", 4)];
/// Lives: factors below this hide a Gaussian; the logarithm of its opacity factor then; the least falloff; the largest logarithm of a width.
const HIDDEN_BELOW: f64 = 0.01;
const HIDDEN: f64 = -30.0;
const LEAST_FALLOFF: f64 = 1e-3;
const MOST_LOG: f64 = 60.0;

type Rows = Vec<Vec<f64>>;

/// A deformer whose offsets are computed in float64.
pub struct Exact {
    formula: Formula,
    weights: BTreeMap<String, Vec<f64>>,
    /// Per Gaussian: voxel features, encoded centre, or attributes.
    features: Rows,
}

enum Formula {
    Cdf { config: Box<CdfConfig>, context: DeformerContext },
    CdfBasis { bands: usize },
    DeformMlp,
    FreeTime,
}

impl Exact {
    /// Whether there are formulas of the deformer called `name`.
    pub fn knows(name: &str) -> bool {
        ["cdf", "cdf-basis", "deform-mlp", "free-time"].contains(&name)
    }
    /// The formulas of `deformer`, which was built as `name` with the default settings, for `means` `[M,3]` and `attributes` by row.
    ///
    /// # Errors
    /// [`Error::Backend`] where it lacks a weight that the formulas read.
    pub fn new(name: &str, deformer: &dyn Deformer, context: &DeformerContext, means: &[f32], attributes: &[Vec<f32>]) -> Result<Self> {
        let mut weights = BTreeMap::new();
        for parameter in deformer.parameters() {
            let values = to_vec(parameter.value.clone(), "weights")?;
            weights.insert(parameter.name.clone(), values.into_iter().map(f64::from).collect());
        }
        let points: Vec<[f64; 3]> = means.as_chunks::<3>().0.iter().map(|p| p.map(f64::from)).collect();
        let rows = attributes.iter().map(|row| row.iter().map(|v| f64::from(*v)).collect()).collect();
        let empty = Self { formula: Formula::FreeTime, weights, features: rows };
        Ok(match name {
            "cdf" => {
                let config: CdfConfig = config::parse_section("deformer cdf", &toml::Table::new())?;
                let features = empty.voxels(&config.voxels, context, &points)?;
                Self { formula: Formula::Cdf { config: Box::new(config), context: context.clone() }, features, ..empty }
            }
            "cdf-basis" => {
                let bands = bands_for(context.frame_count).min(MOST_BANDS);
                let features = empty.voxels(&VoxelSettings::default(), context, &points)?;
                Self { formula: Formula::CdfBasis { bands }, features, ..empty }
            }
            "deform-mlp" => {
                let features = points.iter().map(|p| positional(&p.map(|x| x.clamp(-FAR, FAR)))).collect();
                Self { formula: Formula::DeformMlp, features, ..empty }
            }
            _ => empty,
        })
    }
    /// All offsets at a time, row by row, in the order of [`cc4dgs_core::Offsets::concatenated`].
    ///
    /// # Errors
    /// As [`Exact::new`].
    pub fn at(&self, time_norm: f32) -> Result<Vec<f32>> {
        let t = f64::from(time_norm);
        let rows = match &self.formula {
            Formula::Cdf { config, context } => self.cdf(config, context, t)?,
            Formula::CdfBasis { bands } => self.basis(*bands, t)?,
            Formula::DeformMlp => self.deform_mlp(t)?,
            Formula::FreeTime => self.features.iter().map(|row| free_time(row, t)).collect(),
        };
        Ok(rows.concat().into_iter().map(|v| v as f32).collect())
    }
    fn weights(&self, name: &str) -> Result<&[f64]> {
        self.weights
            .get(name)
            .map(Vec::as_slice)
            .ok_or_else(|| Error::backend("stress", format!("the deformer has no weights {name}"), "Report this as a defect"))
    }
    /// CC-4DGS, Section IV-B: hash signatures of the eight corners, a decoder per level, trilinear interpolation.
    fn voxels(&self, settings: &VoxelSettings, context: &DeformerContext, points: &[[f64; 3]]) -> Result<Rows> {
        let sizes = settings.sizes()?;
        let mut rows = vec![Vec::new(); points.len()];
        for (level, &resolution) in sizes.resolutions.iter().enumerate() {
            let hash = settings.hash(context, level);
            let weights = self.weights(&format!("grid.level{level}"))?;
            for (point, row) in points.iter().zip(&mut rows) {
                // The cell, and where in it the point lies.
                let place: [(u32, f64); 3] = std::array::from_fn(|d| {
                    let (low, high) = (f64::from(context.box_min[d]), f64::from(context.box_max[d]));
                    let position = ((point[d] - low) / (high - low)).clamp(0.0, 1.0) * f64::from(resolution);
                    let cell = position.floor().min(f64::from(resolution - 1));
                    (cell as u32, position - cell)
                });
                let mut sum = vec![0.0; sizes.decoder.output];
                for corner in 0..8u32 {
                    let upper = |d: usize| corner >> d & 1;
                    let weight: f64 = (0..3).map(|d| if upper(d) == 1 { place[d].1 } else { 1.0 - place[d].1 }).product();
                    let mut signature = vec![0.0f32; settings.hashes];
                    hash.signatures(&[std::array::from_fn(|d| place[d].0 + upper(d))], &mut signature);
                    let decoded = decoder(signature.into_iter().map(f64::from).collect(), weights, &sizes.decoder);
                    sum.iter_mut().zip(decoded).for_each(|(s, v)| *s += weight * v);
                }
                row.extend(sum);
            }
        }
        Ok(rows)
    }
    /// CC-4DGS, Section IV-B: time features modulate the spatial ones (FiLM), a trunk, and a head per attribute.
    fn cdf(&self, config: &CdfConfig, context: &DeformerContext, t: f64) -> Result<Rows> {
        let sizes = config.sizes(context)?;
        let w = sizes.width;
        let time = encode(t, sizes.time_bands, |_| 1.0);
        let mut widths = vec![time.len()];
        widths.extend(sizes.time.trunk.iter().chain(sizes.time.heads.iter().flatten()));
        let f_time = chain(time, self.weights("net.time")?, &widths, false);
        let modulation = chain(f_time, self.weights("net.film")?, &[w, w, 2 * w], false);
        let (scale, shift) = modulation.split_at(w);
        let trunk: Vec<usize> = std::iter::once(w).chain(sizes.network.trunk.iter().copied()).collect();
        let row = |features: &Vec<f64>| {
            let mut hidden = chain(features.clone(), self.weights("net.spatial")?, &[features.len(), w], false);
            hidden.iter_mut().zip(scale.iter().zip(shift)).for_each(|(h, (scale, shift))| *h = *h * scale + shift);
            let hidden = chain(hidden, self.weights("net.trunk")?, &trunk, true);
            let head =
                |head: &Head| Ok(chain(hidden.clone(), self.weights(&format!("net.head.{}", head.name()))?, &[w, w, head.width(context.sh_degree)], false));
            Ok(config.network.heads.iter().map(head).collect::<Result<Rows>>()?.concat())
        };
        self.features.iter().map(row).collect()
    }
    /// Coefficients per Gaussian times functions that all share: 1, t, bands, and those of a network.
    fn basis(&self, bands: usize, t: f64) -> Result<Rows> {
        let encoding = encode(t, bands, |band| (-(band as f64)).exp2());
        let w = BASIS_WIDTH;
        let learned = chain(encoding.clone(), self.weights("net.functions")?, &[encoding.len(), w, w, LEARNED], false);
        let functions = [vec![1.0], encoding, learned].concat();
        let row = |features: &Vec<f64>| {
            let hidden = chain(features.clone(), self.weights("net.trunk")?, &[features.len(), w, w], true);
            let mut out = Vec::new();
            for (name, width) in BASIS_HEADS {
                let coefficients = chain(hidden.clone(), self.weights(&format!("net.head.{name}"))?, &[w, w, width * functions.len()], false);
                out.extend(coefficients.chunks_exact(functions.len()).map(|own| dot(own, &functions)));
            }
            Ok(out)
        };
        self.features.iter().map(row).collect()
    }
    /// Deformable 3DGS (Yang et al. 2024): eight layers on encoded centre and time, the input again after five of them.
    fn deform_mlp(&self, t: f64) -> Result<Rows> {
        let time = positional(&[t]);
        let [before, after] = [self.weights("net.before")?, self.weights("net.after")?];
        let w = MLP_WIDTH;
        let row = |features: &Vec<f64>| {
            let input = [features.as_slice(), &time].concat();
            let hidden = chain(input.clone(), before, &[&[input.len()], vec![w; MLP_LAYERS[0]].as_slice()].concat(), true);
            let widths = [&[input.len() + w], vec![w; MLP_LAYERS[1]].as_slice()].concat();
            let hidden = chain([input, hidden].concat(), after, &widths, true);
            let mut at: usize = widths.windows(2).map(|pair| (pair[0] + 1) * pair[1]).sum();
            let mut head = |width: usize| {
                let out = chain(hidden.clone(), &after[at..], &[w, width], false);
                at += (w + 1) * width;
                out
            };
            // In the order of the weights; offsets have scales before rotations.
            let (means, rotations, scales) = (head(3), head(4), head(3));
            [means, scales, rotations].concat()
        };
        Ok(self.features.iter().map(row).collect())
    }
}

/// A life: T, ln r, ln s, the gate's logit over the steepness, a velocity. The shift v (t - T), and the logarithm of g + (1 - g) exp(-(max(|t - T| - r, 0) / s)²).
fn free_time(row: &[f64], t: f64) -> Vec<f64> {
    let since = t - row[0];
    let (half_width, falloff) = (row[1].min(MOST_LOG).exp(), row[2].min(MOST_LOG).exp().max(LEAST_FALLOFF));
    let gate = 1.0 / (1.0 + (-f64::from(LIFE_GATE_STEEPNESS) * row[3]).exp());
    let in_falloffs = (since.abs() - half_width).max(0.0) / falloff;
    let factor = gate + (1.0 - gate) * (-in_falloffs * in_falloffs).exp();
    let log_factor = if factor < HIDDEN_BELOW { HIDDEN } else { factor.ln() };
    row[4..7].iter().map(|v| v * since).chain([log_factor]).collect()
}

/// As `cc4dgs_fields::time::bands_for` says: the highest band is near half the frame count.
fn bands_for(frames: usize) -> usize {
    (frames.max(1) as f64).log2().round().clamp(1.0, 16.0) as usize
}

/// t, then sine and cosine of each doubling frequency times the band's amplitude.
fn encode(t: f64, bands: usize, amplitude: impl Fn(usize) -> f64) -> Vec<f64> {
    let pair = |band: usize| {
        let (sin, cos) = (TAU * (t * (band as f64).exp2()).fract()).sin_cos();
        [amplitude(band) * sin, amplitude(band) * cos]
    };
    std::iter::once(t).chain((0..bands).flat_map(pair)).collect()
}

/// x, then all sines and all cosines of x times each power of two.
fn positional(x: &[f64]) -> Vec<f64> {
    let mut out = x.to_vec();
    for band in 0..MLP_BANDS {
        let turned = x.iter().map(|x| x * (band as f64).exp2());
        out.extend(turned.clone().map(f64::sin));
        out.extend(turned.map(f64::cos));
    }
    out
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A linear layer: W `[input, output]`, then b `[output]`, at the start of `weights`.
fn linear(x: &[f64], weights: &[f64], output: usize) -> Vec<f64> {
    let mut out = weights[x.len() * output..][..output].to_vec();
    for (x, row) in x.iter().zip(weights.chunks_exact(output)) {
        out.iter_mut().zip(row).for_each(|(out, w)| *out += x * w);
    }
    out
}

/// Layers of `widths`, input first, with ReLUs between them and, with `last_relu`, after the last one.
fn chain(mut x: Vec<f64>, mut weights: &[f64], widths: &[usize], last_relu: bool) -> Vec<f64> {
    for (i, pair) in widths.windows(2).enumerate() {
        x = linear(&x, weights, pair[1]);
        weights = &weights[(pair[0] + 1) * pair[1]..];
        if last_relu || i + 2 < widths.len() {
            x.iter_mut().for_each(|v| *v = v.max(0.0));
        }
    }
    x
}

/// Layers of linear map, layer norm and Mish, and a linear one.
fn decoder(mut x: Vec<f64>, mut weights: &[f64], shape: &MishShape) -> Vec<f64> {
    for &width in &shape.hidden {
        let input = x.len();
        x = linear(&x, weights, width);
        weights = &weights[(input + 1) * width..];
        let n = width as f64;
        let mean = x.iter().sum::<f64>() / n;
        let deviation = (x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n + NORM_EPSILON).sqrt();
        for (k, v) in x.iter_mut().enumerate() {
            let z = (*v - mean) / deviation * weights[k] + weights[width + k];
            *v = z * z.exp().ln_1p().tanh();
        }
        weights = &weights[2 * width..];
    }
    linear(&x, weights, shape.output)
}
