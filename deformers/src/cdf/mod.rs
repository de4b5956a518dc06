//! The computational deformation field (paper Section IV-B): features of grid vertices are computed from hash signatures by small
//! decoders instead of being stored, interpolated at the Gaussians, modulated by time, and turned into offsets.
//!
//! Everything that does not depend on time is in `spatial`. Its output is the hidden state W_s f_voxel + b_s, not f_voxel, so that a cache
//! saves the spatial layer as well. The modulation by time is affine and the same for all Gaussians, so `deform` folds it into the
//! first trunk layer: h (gamma ⊙ T) + (beta T + b) instead of (gamma ⊙ h + beta) T + b.

mod config;
mod formulas;

pub use crate::parts::heads::Head;
pub use crate::parts::settings::Capacity;
pub use config::{CdfConfig, Fusion, SCHEMA, Sizes, TimeEncoding};
pub use formulas::Formulas;

use crate::parts::voxels::{Voxels, parameter};
use crate::parts::{heads, weights};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Error, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput,
    config as toml_config, inventory,
};
use cc4dgs_fields::time;
use std::sync::Arc;

/// Parameter groups by index.
const GRID: usize = 0;
const NET: usize = 1;

/// The deformer: settings, sizes, weights.
pub struct Cdf {
    config: CdfConfig,
    sizes: Sizes,
    voxels: Voxels,
    spatial: Arc<ReluShape>,
    time: Arc<ReluShape>,
    film: Option<Arc<ReluShape>>,
    network: Arc<ReluShape>,
    sh_degree: usize,
    /// Decoders by level, spatial layer, time network, FiLM generator (if any), trunk, heads.
    parameters: Vec<Parameter>,
}

impl Cdf {
    /// A deformer with initial weights on `device` for the scene of `context`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for sizes out of range.
    pub fn new(config: CdfConfig, context: &DeformerContext, device: &Device) -> Result<Self> {
        let sizes = config.sizes(context)?;
        let seed = context.seed;
        let (voxels, mut parameters) = Voxels::new(&config.voxels, context, GRID, device)?;
        let mut add = |name: String, values: Vec<f32>| parameters.push(parameter(name, Part::Net, NET, values, device));
        let width = sizes.width;
        add("net.spatial".into(), weights::linear(seed.child("spatial"), sizes.spatial_inputs(), width));
        add("net.time".into(), weights::chain(seed.child("time"), &weights::widths(&sizes.time)));
        if let Some(film) = &sizes.film {
            add("net.film".into(), weights::film(seed.child("film"), film, width));
        }
        let trunk: Vec<usize> = std::iter::once(width).chain(sizes.network.trunk.iter().copied()).collect();
        add("net.trunk".into(), weights::chain(seed.child("trunk"), &trunk));
        for head in &config.network.heads {
            let values = weights::head(seed.child(head.name()), width, 1, head.width(context.sh_degree));
            add(format!("net.head.{}", head.name()), values);
        }
        Ok(Self {
            spatial: Arc::new(ReluShape::chain(&[voxels.width(), width])),
            voxels,
            time: Arc::new(sizes.time.clone()),
            film: sizes.film.clone().map(Arc::new),
            network: Arc::new(sizes.network.clone()),
            sh_degree: context.sh_degree,
            parameters,
            config,
            sizes,
        })
    }

    /// The sizes that follow from the settings and the scene.
    pub fn sizes(&self) -> &Sizes {
        &self.sizes
    }

    /// The weights of the parameter at index `index` after the decoders.
    fn net(&self, index: usize) -> Tensor<1> {
        self.parameters[self.voxels.levels() + index].value.clone()
    }

    /// The trunk's weights at `time_norm` (0..1), modulation folded into its first layer.
    fn modulated_trunk(&self, time_norm: f32) -> Result<Tensor<1>> {
        let w = self.sizes.width;
        let trunk = self.net(if self.film.is_some() { 3 } else { 2 });
        let len = trunk.dims()[0];
        let matrix = trunk.clone().narrow(0, 0, w * w).reshape([w, w]);
        let bias = trunk.clone().narrow(0, w * w, w).reshape([1, w]);
        let rest = trunk.narrow(0, w * (w + 1), len - w * (w + 1));
        let network = &self.config.network;
        let encoding = time::encode_scaled(time_norm, self.sizes.time_bands, network.cycles, network.falloff);
        let inputs = encoding.len();
        let encoding = Tensor::<2>::from_data(TensorData::new(encoding, [1, inputs]), &matrix.device());
        let f_time = single(mlp_relu(encoding, self.net(1), &self.time)?)?;
        let (matrix, shift) = match &self.film {
            Some(film) => {
                let modulation = single(mlp_relu(f_time, self.net(2), film)?)?;
                let scale = modulation.clone().narrow(1, 0, w).reshape([w, 1]);
                let shift = modulation.narrow(1, w, w).matmul(matrix.clone());
                (matrix * scale, shift)
            }
            None => {
                let from_time = self.net(0).narrow(0, self.voxels.width() * w, w * w).reshape([w, w]);
                let shift = f_time.matmul(from_time).matmul(matrix.clone());
                (matrix, shift)
            }
        };
        Ok(Tensor::cat(vec![matrix.reshape([w * w]), (bias + shift).reshape([w]), rest], 0))
    }
}

fn single(outputs: Vec<Tensor<2>>) -> Result<Tensor<2>> {
    outputs.into_iter().next().ok_or_else(|| Error::backend("deformer cdf", "a network returned no output", "Report this as a defect"))
}

impl Deformer for Cdf {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let [m, _] = means_world.dims();
        if m == 0 {
            return Ok(SpatialFeatures { values: Tensor::zeros([0, self.sizes.width], &means_world.inner().device()), work: DeformerWork::default() });
        }
        let (voxel, work) = self.voxels.features(&self.parameters, means_world)?;
        let (rows, w) = (self.voxels.width(), self.sizes.width);
        let layer = self.net(0);
        let layer = if self.film.is_some() {
            layer
        } else {
            // `deform` applies the rows that read the time features.
            let end = layer.dims()[0];
            Tensor::cat(vec![layer.clone().narrow(0, 0, rows * w), layer.narrow(0, end - w, w)], 0)
        };
        Ok(SpatialFeatures { values: single(mlp_relu(voxel, layer, &self.spatial)?)?, work })
    }

    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        if !time_norm.is_finite() {
            return Err(Error::parameter("deformer time", format!("{time_norm} is not a number"), "Use a time in 0..1"));
        }
        let [m, _] = features.dims();
        let outputs = if m == 0 {
            let device = features.device();
            self.network.output_widths().into_iter().map(|w| Tensor::zeros([0, w], &device)).collect()
        } else {
            let first_head = self.parameters.len() - self.config.network.heads.len();
            let heads = self.parameters[first_head..].iter().map(|p| p.value.clone());
            let weights = std::iter::once(self.modulated_trunk(time_norm)?).chain(heads).collect();
            mlp_relu(features, Tensor::cat(weights, 0), &self.network)?
        };
        Ok(heads::offsets(&self.config.network.heads, outputs, self.sh_degree))
    }

    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }

    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }

    fn groups(&self) -> Vec<ParameterGroup> {
        vec![self.config.rates.group("cdf grid"), self.config.rates.group("cdf net")]
    }

    fn caches_spatial(&self) -> bool {
        self.config.network.cache
    }
}

fn build(settings: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    let config: CdfConfig = toml_config::parse_section("deformer cdf", settings)?;
    Ok(Box::new(Cdf::new(config, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "cdf",
            version: "1",
            summary: "computational deformation field: grid features are computed from hashes by small networks, not stored; modulated by time, five heads",
            paper: "CC-4DGS, Section IV-B",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "vertex-reuse", "cached-spatial", "fusion=film,concat"],
        },
        build,
    }
}
