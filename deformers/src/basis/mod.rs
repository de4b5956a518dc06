//! Deformers that are linear in their functions of time: offsets = C(f) φ(t).
//!
//! C is a matrix of coefficients per Gaussian, computed by a small network from features f of its canonical centre and cached by playback; φ is one vector per
//! frame, shared by all Gaussians: a constant, t, Fourier bands, optional splines and functions learned by a small network.
//! A frame costs a dot product per offset instead of a network per Gaussian. It also represents motion over many cycles, which FiLM in front of a trunk hardly
//! learns.
//! Trajectories as combinations of few shared functions are the idea of DynMF (Kratimenos et al. 2024) and Gaussian-Flow (Lin et al. 2024), which store the
//! coefficients per Gaussian.
//!
//! Training needs no coefficients: it asks for the offsets at the times of an iteration, and there the network's last layers are combined with φ before it runs
//! (`training`).
//!
//! Two plug-ins differ in their features of space: those of `cdf-basis` ([`computed`]) are the CDF's, hashed and decoded without stored tables (paper Section
//! IV-B); those of `hash-basis` ([`stored`]) are stored in a hash grid, which takes more bytes, less time, and follows finer motion.
//!
//! After training, functions that a head hardly uses and heads without effect are dropped: see `simplify`.

/// The part of the schema that the plug-ins share.
macro_rules! shared_schema {
    () => {
        r#"head_layers = 1          # hidden layers of each head behind them
time_bands = 0           # Fourier bands; 0 chooses by the number of frames, at most 6
cycles = 1.0             # cycles of the lowest band over the sequence; with whole cycles, what the bands move ends where it began
falloff = 1.0            # amplitude of a band over the next lower one is 2^-falloff: fast motion is learned later; 0 treats all alike
sparsity = 1e-4          # weight of a group lasso on every function of every head (Fourier bands: times their frequency); 0 is off
splines = 0              # cubic B-splines over the sequence, in addition to the bands; 0 or at least 4
learned = 16             # functions of time learned by a small network; 0 is none
heads = ["means", "log_scales", "quaternions"]
rotation = "additive"    # added to quaternions (the paper) | "exponential": a rotation vector, exact for any angle
unused = 0.001           # after training, functions that together make less than this share of a head's offsets are dropped; 0 keeps all
lr_start = 1e-3          # Adam, log-linear to lr_end over the main stage
lr_end = 1e-5
warmup = 0.025           # linear warm-up, as a share of the stage
# [deformer.kept]        # function indices per head; written by training
# means = [0, 1, 2]
"#
    };
}

pub mod computed;
mod simplify;
mod space;
mod sparsity;
pub mod stored;
mod training;

use crate::parts::centres::check_time;
use crate::parts::heads::{self, Head};
use crate::parts::settings::{Rates, not_negative, take};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::basis::{BasisShape, by_columns, combine_all};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu, mlp_relu_flat};
use cc4dgs_core::{Deformer, DeformerContext, DeformerWork, Offsets, Parameter, ParameterGroup, Part, Result, Simplified, SpatialFeatures, SpatialInput};
use cc4dgs_fields::basis::{BasisPlan, BasisSettings, Rotation, Space, SpaceKind, TemporalFunctions};
use space::SpaceFeatures;
use std::sync::Arc;

/// Parameter groups by index.
const GRID: usize = 0;
const NET: usize = 1;

/// The deformer. Parameters: those of the features, the functions' network (if any), the coefficients' trunk, one head each.
struct Basis {
    kind: SpaceKind,
    section: toml::Table,
    context: DeformerContext,
    settings: BasisSettings,
    rates: Rates,
    /// Factor on the learning rates of stored features; `None` where they are computed.
    grid_rate: Option<f64>,
    space: SpaceFeatures,
    functions: TemporalFunctions,
    /// Function indices by head.
    kept: Vec<Vec<usize>>,
    shape: Arc<BasisShape>,
    coefficients: Arc<ReluShape>,
    parameters: Vec<Parameter>,
}

impl Basis {
    fn new(kind: SpaceKind, section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Self> {
        let mut rest = section.clone();
        let rates: Rates = take(&mut rest, &Rates::KEYS)?;
        rates.check()?;
        let plan = BasisPlan::new(kind, &rest, context)?;
        let width = plan.width();
        let grid_rate = match &plan.space {
            Space::Computed(_) => None,
            Space::Stored(tables) => Some(tables.grid_rate),
        };
        not_negative(&[("grid_rate", grid_rate.unwrap_or_default())])?;
        let BasisPlan { settings, space, functions, kept, groups, coefficients } = plan;
        let shape = Arc::new(BasisShape { groups });

        let (space, mut parameters) = SpaceFeatures::new(&space, context, GRID, device)?;
        let seed = context.seed;
        let mut add = |name: String, values: Vec<f32>| parameters.push(parameter(name, Part::Net, NET, values, device));
        if let Some(shape) = &functions.network {
            add("net.functions".into(), weights::chain(seed.child("functions"), &weights::widths(shape)));
        }
        let chain: Vec<usize> = std::iter::once(coefficients.input).chain(coefficients.trunk.iter().copied()).collect();
        add("net.trunk".into(), weights::chain(seed.child("trunk"), &chain));
        for (head, &(values, own)) in settings.heads.iter().zip(&shape.groups) {
            add(format!("net.head.{}", head.name()), weights::head(seed.child(head.name()), width, settings.head_layers, values * own));
        }
        let (section, context) = (section.clone(), context.clone());
        Ok(Self { kind, section, context, rates, grid_rate, space, functions, kept, shape, coefficients, parameters, settings })
    }
    /// The weights of all parameters from index `index` after those of the features to the end, concatenated.
    fn weights_after(&self, index: usize) -> Tensor<1> {
        Tensor::cat(self.parameters[self.space.parameters() + index..].iter().map(|p| p.value.clone()).collect(), 0)
    }
    /// The unit of a head's outputs: half the diagonal of the box (world units) for centres, else 1.
    fn scale_of(&self, head: Head) -> f64 {
        let side = |k: usize| f64::from(self.context.box_max[k]) - f64::from(self.context.box_min[k]);
        if head == Head::Means { 0.5 * (0..3).map(|k| side(k).powi(2)).sum::<f64>().sqrt() } else { 1.0 }
    }
    /// All functions at `times_norm` (0..1): φ(t) `[times, functions]`.
    fn functions_at(&self, times_norm: &[f32], like: &Device) -> Result<Tensor<2>> {
        let weights = self.functions.network.as_ref().map(|_| self.parameters[self.space.parameters()].value.clone());
        let rows = |of: &dyn Fn(f32) -> Vec<f32>| {
            let values: Vec<f32> = times_norm.iter().flat_map(|&t| of(t)).collect();
            let width = values.len() / times_norm.len().max(1);
            Tensor::<2>::from_data(TensorData::new(values, [times_norm.len(), width]), like)
        };
        let functions = &self.functions;
        let mut parts = vec![rows(&|t| functions.plain(t))];
        if let (Some(network), Some(weights)) = (&functions.network, weights) {
            parts.extend(mlp_relu(rows(&|t| functions.network_input(t)), weights, network)?);
        }
        Ok(Tensor::cat(parts, 1))
    }
    /// Whether the weights are in training. The features of Gaussians are then those of space `[M,S]`, otherwise coefficients `[M,C]`.
    fn trains(&self) -> bool {
        self.parameters.iter().any(|p| p.value.is_require_grad())
    }
    /// The coefficients `[M,C]` for features of space `[M,S]`, M > 0.
    fn coefficients_of(&self, features: Tensor<2>) -> Result<Tensor<2>> {
        let [m, _] = features.dims();
        let weights = self.weights_after(usize::from(self.functions.network.is_some()));
        let flat = mlp_relu_flat(features, weights, &self.coefficients)?;
        Ok(flat.reshape([m, self.shape.coefficients()]))
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

impl Deformer for Basis {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let [m, _] = means_world.dims();
        if m == 0 {
            let empty = Tensor::zeros([0, self.shape.coefficients()], &means_world.inner().device());
            return Ok(SpatialFeatures { values: empty, work: DeformerWork::default() });
        }
        let (features, work) = self.space.features(&self.parameters, means_world)?;
        let values = if self.trains() { features } else { self.coefficients_of(features)? };
        Ok(SpatialFeatures { values, work })
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
        } else if self.trains() {
            self.outputs_at(features, times_norm)?
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
        if self.trains() { features } else { by_columns(features, &self.shape) }
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let name = |part: &str| format!("{} {part}", self.kind.name());
        let grid = self.rates.group(&name("grid"));
        let grid = match self.grid_rate {
            // Few rows of a table have gradients in an iteration, and the norm of all says little about them.
            Some(factor) => ParameterGroup { lr_start: factor * grid.lr_start, lr_end: factor * grid.lr_end, clip_norm: 0.0, ..grid },
            None => grid,
        };
        vec![grid, self.rates.group(&name("net"))]
    }
    fn regularizer(&self, _input: &SpatialInput, _time_norm: f32, _progress: f32) -> Result<Option<Tensor<1>>> {
        Ok(if self.settings.sparsity > 0.0 { sparsity::group_lasso(self, self.settings.sparsity) } else { None })
    }
    fn simplified(&self, features: Tensor<2>, times: &[f32]) -> Result<Option<Simplified>> {
        simplify::simplified(self, features, times)
    }
}

#[cfg(test)]
mod tests;
