//! A field that is linear in its functions of time: offsets = C(f_voxel) φ(t).
//!
//! C is a matrix of coefficients per Gaussian, computed from the same hashed voxel features as the CDF's (paper Section IV-B) and cached by playback like
//! them; φ is one vector per frame, shared by all Gaussians: a constant, t, Fourier bands and a few functions learned by a small network. A frame costs
//! a dot product per offset in place of a network per Gaussian, and motion over many cycles is in reach, which FiLM in front of a trunk hardly learns.
//! Trajectories as combinations of few shared functions are the idea of DynMF (Kratimenos et al. 2024) and Gaussian-Flow (Lin et al. 2024), which store the
//! coefficients per Gaussian.

use crate::parts::heads::{self, Head};
use crate::parts::settings::{Rates, take, within};
use crate::parts::time::{bands_for, encode};
use crate::parts::voxels::{VoxelSettings, Voxels, parameter};
use crate::parts::weights;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::basis::{BasisShape, combine};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_core::{
    DeformationField, Error, FieldContext, FieldPlugin, FieldWork, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, config, inventory,
};
use serde::Deserialize;
use std::sync::Arc;

/// Settings with their defaults, as shown to users.
const SCHEMA: &str = r#"capacity = "default"    # small | mid | default, as of `cdf`
# levels, resolutions, hidden, features, hashes, modulus, vertex_reuse: as of `cdf`
# width = 128            # width of the coefficient network (small: 64; mid: 96)
layers = 2               # hidden layers of the coefficient network
time_bands = 0           # Fourier bands; 0 chooses by the number of frames, at most 6
learned = 16             # functions of time learned by a small network; 0 is none
heads = ["means", "log_scales", "quaternions"]
lr_start = 1e-3          # Adam, log-linear to lr_end over the main stage
lr_end = 1e-5
warmup = 0.025           # linear warm-up, as a share of the stage
clip_norm = 1.0          # gradient-norm clip per group; 0 is off
"#;

/// The most bands that are chosen automatically: 32 cycles per sequence.
const MOST_BANDS: usize = 6;
/// Parameter groups by index.
const GRID: usize = 0;
const NET: usize = 1;

/// Settings of what comes after the voxels.
#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct BasisSettings {
    width: Option<usize>,
    layers: usize,
    time_bands: usize,
    learned: usize,
    heads: Vec<Head>,
}

impl Default for BasisSettings {
    fn default() -> Self {
        Self { width: None, layers: 2, time_bands: 0, learned: 16, heads: vec![Head::Means, Head::LogScales, Head::Quaternions] }
    }
}

/// The field. Parameters: decoders by level, the functions' network (if any), the coefficients' trunk, one head each.
struct CdfBasis {
    settings: BasisSettings,
    rates: Rates,
    voxels: Voxels,
    bands: usize,
    shape: Arc<BasisShape>,
    learned: Option<Arc<ReluShape>>,
    coefficients: Arc<ReluShape>,
    sh_degree: usize,
    parameters: Vec<Parameter>,
}

impl CdfBasis {
    fn new(section: &toml::Table, context: &FieldContext, device: &Device) -> Result<Self> {
        let mut section = section.clone();
        let (voxel_settings, rates): (VoxelSettings, Rates) = (take(&mut section, &VoxelSettings::KEYS)?, take(&mut section, &Rates::KEYS)?);
        let settings: BasisSettings = config::parse_section("deformer cdf-basis", &section)?;
        rates.check()?;
        heads::check(&settings.heads)?;
        let width = settings.width.unwrap_or(voxel_settings.capacity.width());
        within("width", width, 1, 4096)?;
        within("layers", settings.layers, 1, 8)?;
        within("time_bands", settings.time_bands, 0, 24)?;
        within("learned", settings.learned, 0, 256)?;
        within("spherical-harmonics degree", context.sh_degree, 0, 4)?;
        let bands = if settings.time_bands == 0 { bands_for(context.frame_count).min(MOST_BANDS) } else { settings.time_bands };
        // The constant, t, and a sine and a cosine per band.
        let functions = 2 + 2 * bands + settings.learned;

        let (voxels, mut parameters) = Voxels::new(&voxel_settings, context, GRID, device)?;
        let seed = context.seed;
        let mut add = |name: String, values: Vec<f32>| parameters.push(parameter(name, Part::Net, NET, values, device));
        let learned = (settings.learned > 0).then(|| ReluShape::chain(&[1 + 2 * bands, width, width, settings.learned]));
        if let Some(shape) = &learned {
            add("net.functions".into(), weights::chain(seed.child("functions"), &weights::widths(shape)));
        }
        let trunk = vec![width; settings.layers];
        let chain: Vec<usize> = std::iter::once(voxels.width()).chain(trunk.iter().copied()).collect();
        add("net.trunk".into(), weights::chain(seed.child("trunk"), &chain));
        let outputs: Vec<usize> = settings.heads.iter().map(|h| h.width(context.sh_degree) * functions).collect();
        for (head, &output) in settings.heads.iter().zip(&outputs) {
            add(format!("net.head.{}", head.name()), weights::head(seed.child(head.name()), width, output));
        }
        let heads = outputs.iter().map(|&output| vec![width, output]).collect();
        let coefficients = Arc::new(ReluShape { input: voxels.width(), trunk, heads });
        let shape = Arc::new(BasisShape { groups: settings.heads.iter().map(|h| (h.width(context.sh_degree), functions)).collect() });
        Ok(Self { rates, voxels, bands, shape, learned: learned.map(Arc::new), coefficients, sh_degree: context.sh_degree, parameters, settings })
    }
    /// The weights of the parameters from `place` after the decoders to the end, side by side.
    fn weights_after(&self, place: usize) -> Tensor<1> {
        Tensor::cat(self.parameters[self.voxels.levels() + place..].iter().map(|p| p.value.clone()).collect(), 0)
    }
    /// φ(t) [functions].
    fn functions_at(&self, time_norm: f32, like: &Device) -> Result<Tensor<1>> {
        let encoding = encode(time_norm, self.bands);
        let constant = |values: Vec<f32>| {
            let n = values.len();
            Tensor::<2>::from_data(TensorData::new(values, [1, n]), like)
        };
        let mut parts = vec![constant(vec![1.0]), constant(encoding.clone())];
        if let Some(shape) = &self.learned {
            parts.extend(mlp_relu(constant(encoding), self.parameters[self.voxels.levels()].value.clone(), shape)?);
        }
        Ok(Tensor::cat(parts, 1).flatten(0, 1))
    }
}

impl DeformationField for CdfBasis {
    fn spatial(&self, means_world: Tensor<2>) -> Result<SpatialFeatures> {
        let [m, _] = means_world.dims();
        let total: usize = self.coefficients.output_widths().iter().sum();
        if m == 0 {
            return Ok(SpatialFeatures { values: Tensor::zeros([0, total], &means_world.inner().device()), work: FieldWork::default() });
        }
        let (voxel, work) = self.voxels.features(&self.parameters, means_world)?;
        let weights = self.weights_after(usize::from(self.learned.is_some()));
        Ok(SpatialFeatures { values: Tensor::cat(mlp_relu(voxel, weights, &self.coefficients)?, 1), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let [m, _] = features.dims();
        let functions = self.functions_at(time_norm, &features.device())?;
        let combined = if m == 0 { Tensor::zeros([0, self.shape.outputs()], &features.device()) } else { combine(features, functions, &self.shape)? };
        let mut at = 0;
        let outputs = self.settings.heads.iter().map(|head| {
            let width = head.width(self.sh_degree);
            at += width;
            combined.clone().narrow(1, at - width, width)
        });
        let outputs = outputs.collect();
        Ok(heads::offsets(&self.settings.heads, outputs, self.sh_degree))
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
}

fn build(section: &toml::Table, context: &FieldContext, device: &Device) -> Result<Box<dyn DeformationField>> {
    Ok(Box::new(CdfBasis::new(section, context, device)?))
}

inventory::submit! {
    FieldPlugin {
        info: Plugin {
            name: "cdf-basis",
            version: "1",
            summary: "computational field, linear in shared functions of time: a dot product per frame",
            paper: "CC-4DGS, Section IV-B (spatial half); DynMF, Gaussian-Flow (shared temporal functions)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "vertex-reuse", "cached-spatial"],
        },
        build,
    }
}
