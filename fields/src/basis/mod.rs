//! The deformers `cdf-basis` and `hash-basis`: offsets = C(f) φ(t), where f are features of space. Their settings and sizes, and their evaluation as a
//! playback layer.

mod functions;
mod layer;
mod space;

use crate::heads::{self, Head};
use crate::networks::ReluShape;
use crate::settings::{RATE_KEYS, bounded, refuse_unknown, within};
use crate::time::bands_for;
use cc4dgs_format::{DeformerContext, Error, Result, config};
pub use functions::TemporalFunctions;
pub(crate) use layer::{computed, stored};
use serde::{Deserialize, Serialize};
pub use space::{Space, SpaceKind};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The version of their stored form.
pub const VERSION: &str = "2";
/// Largest number of bands chosen automatically: up to 32 cycles per sequence.
pub const MOST_BANDS: usize = 6;

/// How rotations change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Rotation {
    /// Four numbers added to the quaternion (paper Section IV-B).
    Additive,
    /// Three numbers: the axis times the angle of a rotation in front of the canonical one.
    Exponential,
}

/// Settings of everything after the features of space.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BasisSettings {
    /// Width of the coefficient network; `None`: by the kind of features.
    pub width: Option<usize>,
    /// Hidden layers of the coefficient network; `None`: by the kind of features.
    pub layers: Option<usize>,
    /// Hidden layers of each head.
    pub head_layers: usize,
    /// Fourier bands; 0 chooses by the number of frames.
    pub time_bands: usize,
    /// Cycles of the lowest band.
    pub cycles: f32,
    /// See [`TemporalFunctions::falloff`].
    pub falloff: f32,
    /// Weight of the group lasso over functions.
    pub sparsity: f32,
    /// Cubic B-splines.
    pub splines: usize,
    /// Learned functions.
    pub learned: usize,
    /// What changes.
    pub heads: Vec<Head>,
    /// How rotations change.
    pub rotation: Rotation,
    /// Functions with a smaller share of the offsets of a head are dropped after training.
    pub unused: f64,
    /// Function indices by head, where some were dropped.
    pub kept: BTreeMap<String, Vec<usize>>,
}

impl Default for BasisSettings {
    fn default() -> Self {
        Self {
            width: None,
            layers: None,
            head_layers: 1,
            time_bands: 0,
            cycles: 1.0,
            falloff: 1.0,
            sparsity: 1e-4,
            splines: 0,
            learned: 16,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions],
            rotation: Rotation::Additive,
            unused: 0.001,
            kept: BTreeMap::new(),
        }
    }
}

/// The key that training writes: function indices by head.
const KEPT: &str = "kept";

impl BasisSettings {
    /// The keys of these settings in a `[deformer]` section, but for the one that training writes.
    pub const KEYS: [&'static str; 12] =
        ["width", "layers", "head_layers", "time_bands", "cycles", "falloff", "sparsity", "splines", "learned", "heads", "rotation", "unused"];
    /// Values per Gaussian of a head.
    pub fn width_of(&self, head: Head, sh_degree: usize) -> usize {
        if head == Head::Quaternions && self.rotation == Rotation::Exponential { 3 } else { head.width(sh_degree) }
    }
    /// The function indices of every head: all of `count` unless some were dropped.
    fn functions_of_heads(&self, count: usize) -> Result<Vec<Vec<usize>>> {
        if let Some(name) = self.kept.keys().find(|name| !self.heads.iter().any(|h| h.name() == name.as_str())) {
            return Err(Error::parameter(format!("deformer.kept.{name}"), "no such head", "Name heads of deformer.heads"));
        }
        let of_head = |head: &Head| {
            let Some(own) = self.kept.get(head.name()) else { return Ok((0..count).collect()) };
            if own.is_empty() || own.windows(2).any(|w| w[0] >= w[1]) || own.iter().any(|&f| f >= count) {
                let problem = format!("{own:?} is not an ascending list of function indices below {count}");
                return Err(Error::parameter(format!("deformer.kept.{}", head.name()), problem, "Give each function once, or omit the list"));
            }
            Ok(own.clone())
        };
        self.heads.iter().map(of_head).collect()
    }
}

/// Everything about the field that follows from settings and scene.
#[derive(Clone, Debug)]
pub struct BasisPlan {
    /// Settings of everything after the features of space.
    pub settings: BasisSettings,
    /// Settings of the features of space.
    pub space: Space,
    /// The functions of time.
    pub functions: TemporalFunctions,
    /// Function indices by head.
    pub kept: Vec<Vec<usize>>,
    /// By head, the values per Gaussian and its number of functions.
    pub groups: Vec<(usize, usize)>,
    /// The network from features of space to coefficients: an output per head, [values, functions].
    pub coefficients: Arc<ReluShape>,
}

impl BasisPlan {
    /// Reads a `[deformer]` section without `kind` and the keys of learning rates.
    ///
    /// # Errors
    /// [`Error::Parameter`] for unknown keys and values out of range.
    pub fn new(kind: SpaceKind, section: &toml::Table, context: &DeformerContext) -> Result<Self> {
        let mut rest = section.clone();
        refuse_unknown(rest.keys().filter(|key| *key != KEPT), &[kind.keys(), &BasisSettings::KEYS, &RATE_KEYS])?;
        let space = kind.take(&mut rest)?;
        let settings: BasisSettings = config::parse_section(&format!("deformer {}", kind.name()), &rest)?;
        heads::check(&settings.heads)?;
        let (width, layers) = (settings.width.unwrap_or(space.network().0), settings.layers.unwrap_or(space.network().1));
        within("width", width, 1, 4096)?;
        within("layers", layers, 1, 8)?;
        within("head_layers", settings.head_layers, 0, 8)?;
        within("time_bands", settings.time_bands, 0, 24)?;
        within("learned", settings.learned, 0, 256)?;
        within("splines", settings.splines, 0, 1024)?;
        if (1..4).contains(&settings.splines) {
            return Err(Error::parameter(
                "deformer.splines",
                format!("{} splines are too few; cubic splines need 4", settings.splines),
                "Give 0 (none) or at least 4",
            ));
        }
        within("spherical-harmonics degree", context.sh_degree, 0, 4)?;
        if !(0.1..=16.0).contains(&settings.cycles) {
            return Err(Error::parameter("deformer.cycles", format!("{} cannot be used", settings.cycles), "Give 0.1 to 16; 0.5 and 1 are usual"));
        }
        if !(0.0..=4.0).contains(&settings.falloff) {
            return Err(Error::parameter("deformer.falloff", format!("{} cannot be used", settings.falloff), "Give 0 (none) to 4"));
        }
        if !(0.0..=1.0).contains(&settings.sparsity) {
            return Err(Error::parameter("deformer.sparsity", format!("{} cannot be used", settings.sparsity), "Give 0 (off) to 1"));
        }
        if !(0.0..1.0).contains(&settings.unused) {
            return Err(Error::parameter("deformer.unused", format!("{} is not in 0..1", settings.unused), "Give a share from 0 to below 1"));
        }
        let bands = if settings.time_bands == 0 { bands_for(context.frame_count).min(MOST_BANDS) } else { settings.time_bands };
        let network = (settings.learned > 0).then(|| Arc::new(ReluShape::chain(&[TemporalFunctions::encoding(bands), width, width, settings.learned])));
        let functions = TemporalFunctions { bands, cycles: settings.cycles, falloff: settings.falloff, splines: settings.splines, network };
        let kept = settings.functions_of_heads(functions.count())?;
        let groups: Vec<(usize, usize)> = settings.heads.iter().zip(&kept).map(|(h, own)| (settings.width_of(*h, context.sh_degree), own.len())).collect();
        let outputs = groups.iter().map(|(values, own)| [vec![width; settings.head_layers], vec![values * own]].concat()).collect();
        let coefficients = Arc::new(ReluShape { input: space.width()?, trunk: vec![width; layers], heads: outputs });
        let plan = Self { settings, space, functions, kept, groups, coefficients };
        bounded(plan.parameter_counts()?)?;
        Ok(plan)
    }
    /// Weights of the features of space, of the coefficients, and of the functions of time.
    fn parameter_counts(&self) -> Result<[usize; 3]> {
        let of_functions = self.functions.network.as_ref().map_or(0, |network| network.parameter_count());
        Ok([self.space.parameter_count()?, self.coefficients.parameter_count(), of_functions])
    }
    /// Weights of the whole field.
    ///
    /// # Errors
    /// As [`BasisPlan::new`].
    pub fn parameter_count(&self) -> Result<usize> {
        Ok(self.parameter_counts()?.into_iter().fold(0, usize::saturating_add))
    }
    /// Width of the coefficient network.
    pub fn width(&self) -> usize {
        self.coefficients.trunk.last().copied().unwrap_or(0)
    }
}
