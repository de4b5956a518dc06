//! A deformer that is linear in its functions of time: offsets = C(f_voxel) φ(t).
//!
//! C is a matrix of coefficients per Gaussian, computed from the same hashed voxel features as the CDF's (paper Section IV-B) and cached by playback like
//! them; φ is one vector per frame, shared by all Gaussians: a constant, t, Fourier bands, optional splines and functions learned by a small network.
//! A frame costs a dot product per offset instead of a network per Gaussian. It also represents motion over many cycles, which FiLM in front of a trunk hardly
//! learns.
//! Trajectories as combinations of few shared functions are the idea of DynMF (Kratimenos et al. 2024) and Gaussian-Flow (Lin et al. 2024), which store the
//! coefficients per Gaussian.
//!
//! After training, functions that a head hardly uses and heads without effect are dropped: see `simplify`.

mod functions;
mod simplify;
mod sparsity;

use crate::parts::centres::check_time;
use crate::parts::heads::{self, Head};
use crate::parts::settings::{Rates, take, within};
use crate::parts::time::bands_for;
use crate::parts::voxels::{VoxelSettings, Voxels, parameter};
use crate::parts::weights;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::basis::{BasisShape, by_columns, combine_all};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu_flat};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, Simplified, SpatialFeatures,
    SpatialInput, config, inventory,
};
use functions::TemporalFunctions;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Settings with their defaults, as shown to users.
const SCHEMA: &str = r#"capacity = "default"    # small | mid | default, as for `cdf`
# levels, resolutions, hidden, features, hashes, modulus, vertex_reuse: as for `cdf`
# width = 128            # width of the coefficient network (small: 64; mid: 96)
layers = 2               # hidden layers of the coefficient network
time_bands = 0           # Fourier bands; 0 chooses by the number of frames, at most 6
cycles = 1.0             # cycles of the lowest band over the sequence; with whole cycles, what the bands move ends where it began
falloff = 1.0            # amplitude of a band over the next lower one is 2^-falloff: fast motion is learned later; 0 treats all alike
sparsity = 1e-4          # weight of a group lasso on every function of every head (Fourier bands: times their frequency); 0 is off
splines = 0              # cubic B-splines over the sequence, in addition to the bands; 0 or at least 4
learned = 16             # functions of time learned by a small network; 0 is none
heads = ["means", "log_scales", "quaternions"]
rotation = "additive"    # added to quaternions (the paper) | "exponential": a rotation vector, exact for any angle
unused = 0.01            # after training, functions whose part in a head's offsets is below this share are dropped; 0 keeps all
lr_start = 1e-3          # Adam, log-linear to lr_end over the main stage
lr_end = 1e-5
warmup = 0.025           # linear warm-up, as a share of the stage
clip_norm = 1.0          # gradient-norm clip per group; 0 is off
# [deformer.kept]        # function indices per head; written by training
# means = [0, 1, 2]
"#;

/// Largest number of bands chosen automatically: up to 32 cycles per sequence.
const MOST_BANDS: usize = 6;
/// Parameter groups by index.
const GRID: usize = 0;
const NET: usize = 1;

/// How rotations change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
enum Rotation {
    /// Four numbers added to the quaternion (paper Section IV-B).
    Additive,
    /// Three numbers: the axis times the angle of a rotation in front of the canonical one.
    Exponential,
}

/// Settings of everything after the voxel features.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct BasisSettings {
    width: Option<usize>,
    layers: usize,
    time_bands: usize,
    cycles: f32,
    falloff: f32,
    sparsity: f32,
    splines: usize,
    learned: usize,
    heads: Vec<Head>,
    rotation: Rotation,
    unused: f64,
    kept: BTreeMap<String, Vec<usize>>,
}

impl Default for BasisSettings {
    fn default() -> Self {
        Self {
            width: None,
            layers: 2,
            time_bands: 0,
            cycles: 1.0,
            falloff: 1.0,
            sparsity: 1e-4,
            splines: 0,
            learned: 16,
            heads: vec![Head::Means, Head::LogScales, Head::Quaternions],
            rotation: Rotation::Additive,
            unused: 0.01,
            kept: BTreeMap::new(),
        }
    }
}

impl BasisSettings {
    /// Values per Gaussian of a head.
    fn width_of(&self, head: Head, sh_degree: usize) -> usize {
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

/// The deformer. Parameters: decoders by level, the functions' network (if any), the coefficients' trunk, one head each.
struct CdfBasis {
    section: toml::Table,
    context: DeformerContext,
    settings: BasisSettings,
    rates: Rates,
    voxels: Voxels,
    functions: TemporalFunctions,
    /// Function indices by head.
    kept: Vec<Vec<usize>>,
    shape: Arc<BasisShape>,
    coefficients: Arc<ReluShape>,
    parameters: Vec<Parameter>,
}

impl CdfBasis {
    fn new(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Self> {
        let mut rest = section.clone();
        let (voxel_settings, rates): (VoxelSettings, Rates) = (take(&mut rest, &VoxelSettings::KEYS)?, take(&mut rest, &Rates::KEYS)?);
        let settings: BasisSettings = config::parse_section("deformer cdf-basis", &rest)?;
        rates.check()?;
        heads::check(&settings.heads)?;
        let width = settings.width.unwrap_or(voxel_settings.capacity.width());
        within("width", width, 1, 4096)?;
        within("layers", settings.layers, 1, 8)?;
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
        let groups = settings.heads.iter().zip(&kept).map(|(h, own)| (settings.width_of(*h, context.sh_degree), own.len())).collect();
        let shape = Arc::new(BasisShape { groups });

        let (voxels, mut parameters) = Voxels::new(&voxel_settings, context, GRID, device)?;
        let seed = context.seed;
        let mut add = |name: String, values: Vec<f32>| parameters.push(parameter(name, Part::Net, NET, values, device));
        if let Some(shape) = &functions.network {
            add("net.functions".into(), weights::chain(seed.child("functions"), &weights::widths(shape)));
        }
        let trunk = vec![width; settings.layers];
        let chain: Vec<usize> = std::iter::once(voxels.width()).chain(trunk.iter().copied()).collect();
        add("net.trunk".into(), weights::chain(seed.child("trunk"), &chain));
        let outputs: Vec<usize> = shape.groups.iter().map(|g| g.0 * g.1).collect();
        for (head, &output) in settings.heads.iter().zip(&outputs) {
            add(format!("net.head.{}", head.name()), weights::head(seed.child(head.name()), width, output));
        }
        let heads = outputs.iter().map(|&output| vec![width, output]).collect();
        let coefficients = Arc::new(ReluShape { input: voxels.width(), trunk, heads });
        let (section, context) = (section.clone(), context.clone());
        Ok(Self { section, context, rates, voxels, functions, kept, shape, coefficients, parameters, settings })
    }
    /// The weights of all parameters from index `place` after the decoders to the end, concatenated.
    fn weights_after(&self, place: usize) -> Tensor<1> {
        Tensor::cat(self.parameters[self.voxels.levels() + place..].iter().map(|p| p.value.clone()).collect(), 0)
    }
    /// The unit of a head's outputs: half the diagonal of the box (world units) for centres, else 1.
    fn scale_of(&self, head: Head) -> f64 {
        let side = |k: usize| f64::from(self.context.box_max[k]) - f64::from(self.context.box_min[k]);
        if head == Head::Means { 0.5 * (0..3).map(|k| side(k).powi(2)).sum::<f64>().sqrt() } else { 1.0 }
    }
    /// All functions at `times_norm` (0..1): φ(t) `[times, functions]`.
    fn functions_at(&self, times_norm: &[f32], like: &Device) -> Result<Tensor<2>> {
        let weights = self.functions.network.as_ref().map(|_| self.parameters[self.voxels.levels()].value.clone());
        self.functions.at(times_norm, weights, like)
    }
    /// φ(t) at each of `times_norm` for each head (its own functions only), concatenated head after head.
    fn functions_by_head(&self, times_norm: &[f32], like: &Device) -> Result<Vec<Tensor<1>>> {
        let all = self.functions_at(times_norm, like)?;
        let indices: Vec<i64> = self.kept.iter().flatten().map(|&f| f as i64).collect();
        let count = indices.len();
        let indices = Tensor::<1, Int>::from_data(TensorData::new(indices, [count]), like);
        Ok((0..times_norm.len()).map(|k| all.clone().narrow(0, k, 1).flatten::<1>(0, 1).select(0, indices.clone())).collect())
    }
}

impl Deformer for CdfBasis {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let [m, _] = means_world.dims();
        if m == 0 {
            let empty = Tensor::zeros([0, self.shape.coefficients()], &means_world.inner().device());
            return Ok(SpatialFeatures { values: empty, work: DeformerWork::default() });
        }
        let (voxel, work) = self.voxels.features(&self.parameters, means_world)?;
        let weights = self.weights_after(usize::from(self.functions.network.is_some()));
        let flat = mlp_relu_flat(voxel, weights, &self.coefficients)?;
        Ok(SpatialFeatures { values: flat.reshape([m, self.shape.coefficients()]), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        Ok(self.deform_all(features, &[time_norm])?.pop().unwrap_or_default())
    }
    fn deform_all(&self, features: Tensor<2>, times_norm: &[f32]) -> Result<Vec<Offsets>> {
        if times_norm.is_empty() {
            return Ok(Vec::new());
        }
        times_norm.iter().try_for_each(|&time_norm| check_time(time_norm))?;
        let ([m, _], device) = (features.dims(), features.device());
        let outputs = if m == 0 {
            let empty = || self.shape.widths().into_iter().map(|width| Tensor::zeros([0, width], &device)).collect();
            times_norm.iter().map(|_| empty()).collect()
        } else {
            combine_all(features, self.functions_by_head(times_norm, &device)?, &self.shape)?
        };
        let at = |outputs| {
            let mut offsets = heads::offsets(&self.settings.heads, outputs, self.context.sh_degree);
            if self.settings.rotation == Rotation::Exponential {
                offsets.rotation_vectors = offsets.quaternions.take();
            }
            offsets
        };
        Ok(outputs.into_iter().map(at).collect())
    }
    fn packed(&self, features: Tensor<2>) -> Tensor<2> {
        by_columns(features, &self.shape)
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        vec![self.rates.group("cdf-basis grid"), self.rates.group("cdf-basis net")]
    }
    fn regularizer(&self, _input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        Ok(if self.settings.sparsity > 0.0 { sparsity::group_lasso(self, self.settings.sparsity) } else { None })
    }
    fn simplified(&self, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
        simplify::simplified(self, features, times)
    }
}

fn build(settings: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(CdfBasis::new(settings, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "cdf-basis",
            version: "2",
            summary: "computational deformation field, linear in shared functions of time: a dot product per frame",
            paper: "CC-4DGS, Section IV-B (spatial half); DynMF, Gaussian-Flow (shared temporal functions)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "vertex-reuse", "cached-spatial", "simplifies", "rotation=additive,exponential"],
        },
        build,
    }
}
