//! Deformers and loss terms in float64: their plain formulas, with the default settings but for those that [`FORMULAS`] names. Slow and obvious.
//!
//! Weights and attributes are read from a deformer by name, as float32; everything computed from them, from centres and from times is float64. Only the
//! hash signatures of vertices (integers, scaled) and the shapes of layers are shared with the kernels.

mod cdf;
mod deform_mlp;
mod embedding;
mod free_time;
mod grid4d;
mod grids;
mod hexplane;
pub mod losses;
mod native4d;
mod network;
mod swift4d;

use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, Error, Result, toml};
use std::collections::BTreeMap;

/// A row of values per Gaussian.
pub type Rows = Vec<Vec<f64>>;

/// The formulas of one deformer, with its weights, for the Gaussians of its [`Inputs`].
pub trait Formula {
    /// All offsets at the time `t`, a row per Gaussian in the order of [`cc4dgs_core::Offsets::concatenated`].
    ///
    /// # Errors
    /// [`Error::Backend`] where the deformer lacks a weight that the formulas read.
    fn offsets(&self, t: f64) -> Result<Rows>;
}

/// What a [`Formula`] is built from.
pub struct Inputs {
    /// Settings of the deformer: some of those that [`FORMULAS`] names. All others are the defaults.
    settings: toml::Table,
    weights: Weights,
    context: DeformerContext,
    /// Centres, world units.
    points: Vec<[f64; 3]>,
    /// Per Gaussian, the attributes one after the other.
    attributes: Rows,
}

type Build = fn(Inputs) -> Result<Box<dyn Formula>>;

/// The deformers that have formulas, by name, with the settings that the formulas read.
const FORMULAS: [(&str, Build, &[&str]); 10] = [
    ("cdf", cdf::build, cdf::SETTINGS),
    ("cdf-basis", cdf::build_basis, cdf::SETTINGS),
    ("deform-mlp", deform_mlp::build, &[]),
    ("embedding", embedding::build, &[]),
    ("free-time", free_time::build, &[]),
    ("grid4d", grid4d::build, &[]),
    ("hash-basis", cdf::build_hash_basis, cdf::SETTINGS),
    ("hexplane", hexplane::build, &[]),
    ("native-4d", native4d::build, &[]),
    ("swift4d-hash", swift4d::build, &[]),
];

/// A deformer whose offsets are computed in float64.
pub struct Exact {
    formula: Box<dyn Formula>,
}

impl Exact {
    /// Whether there are formulas of the deformer called `name`.
    pub fn knows(name: &str) -> bool {
        FORMULAS.into_iter().any(|(known, ..)| known == name)
    }
    /// The formulas of `deformer`, which was built as `name` with these `settings`, for `means` `[M,3]` and `attributes` by row.
    ///
    /// # Errors
    /// [`Error::Backend`] where there are no formulas of it, or where it lacks a weight that they read; [`Error::Parameter`] for a setting that they do not
    /// read.
    pub fn new(name: &str, settings: &toml::Table, deformer: &dyn Deformer, context: &DeformerContext, means: &[f32], attributes: &[Vec<f32>]) -> Result<Self> {
        let Some((_, build, read)) = FORMULAS.into_iter().find(|(known, ..)| *known == name) else {
            return Err(Error::backend("stress", format!("there are no formulas of the deformer {name}"), "Report this as a defect"));
        };
        if let Some(key) = settings.keys().find(|key| !read.contains(&key.as_str())) {
            let problem = format!("the float64 formulas of the deformer {name} do not read the setting {key}");
            return Err(Error::parameter("stress", problem, "Leave it out: they are those of its default"));
        }
        let mut weights = BTreeMap::new();
        for parameter in deformer.parameters() {
            let values = to_vec(parameter.value.clone(), "weights")?;
            weights.insert(parameter.name.clone(), values.into_iter().map(f64::from).collect());
        }
        let points = means.as_chunks::<3>().0.iter().map(|p| p.map(f64::from)).collect();
        let attributes = attributes.iter().map(|row| row.iter().map(|v| f64::from(*v)).collect()).collect();
        let inputs = Inputs { settings: settings.clone(), weights: Weights(weights), context: context.clone(), points, attributes };
        Ok(Self { formula: build(inputs)? })
    }
    /// All offsets at a time, row by row, in the order of [`cc4dgs_core::Offsets::concatenated`].
    ///
    /// # Errors
    /// As [`Exact::new`].
    pub fn at(&self, time_norm: f32) -> Result<Vec<f32>> {
        Ok(self.formula.offsets(f64::from(time_norm))?.concat().into_iter().map(|v| v as f32).collect())
    }
}

/// Weights by the names of a deformer's parameters.
pub struct Weights(BTreeMap<String, Vec<f64>>);

impl Weights {
    fn of(&self, name: &str) -> Result<&[f64]> {
        self.0.get(name).map(Vec::as_slice).ok_or_else(|| Error::backend("stress", format!("the deformer has no weights {name}"), "Report this as a defect"))
    }
}

/// Largest absolute coordinate of a centre that is not mapped to a box, world units: larger ones are clamped.
const FAR: f64 = 1e6;

/// `point` with every coordinate clamped to ± [`FAR`].
fn within_far(point: &[f64; 3]) -> [f64; 3] {
    point.map(|x| x.clamp(-FAR, FAR))
}

/// `point` mapped so that the deformer's box is 0..1 on every axis, not clamped. The box has an extent on every axis.
fn in_box(point: &[f64; 3], context: &DeformerContext) -> [f64; 3] {
    std::array::from_fn(|d| {
        let (low, high) = (f64::from(context.box_min[d]), f64::from(context.box_max[d]));
        (point[d] - low) / (high - low)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Registry;
    use std::collections::BTreeSet;

    #[test]
    fn every_deformer_but_none_and_every_loss_term_has_formulas() {
        let plugins = Registry::collect().unwrap().plugins();
        let registered = |kind: &str| plugins.iter().filter(|(of, _)| *of == kind).map(|(_, plugin)| plugin.name).collect::<BTreeSet<&str>>();
        let deformers: BTreeSet<&str> = FORMULAS.into_iter().map(|(name, ..)| name).chain(["none"]).collect();
        let terms: BTreeSet<&str> = losses::TERMS.into_iter().map(|(name, _)| name).collect();
        assert_eq!((registered("deformer"), registered("loss")), (deformers, terms));
        assert!(Exact::knows("swift4d-hash") && !Exact::knows("none"));
    }
}
