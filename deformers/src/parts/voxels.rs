//! Features of canonical centres without stored tables (paper Section IV-B). The vertices of a multi-resolution grid have hash signatures. One small decoder
//! per level turns signatures into features. A centre interpolates the features of its eight corners.

pub use cc4dgs_fields::voxels::{VoxelSettings, VoxelSizes};

use super::centres::check_box;
use super::weights;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_backends::ops::field::{Decoder, GridBox, VoxelCorners};
use cc4dgs_core::{DeformerContext, DeformerWork, Parameter, Part, Result};
use std::sync::Arc;

/// The grid over a scene's box with the hash functions and layer shapes of its decoders. The weights are [`Parameter`]s of the deformer that owns the grid.
#[derive(Clone, Debug)]
pub struct Voxels {
    box_min: [f32; 3],
    box_max: [f32; 3],
    resolutions: Vec<u32>,
    decoders: Vec<Arc<Decoder>>,
    reuse: bool,
    width: usize,
}

impl Voxels {
    /// A grid for the scene of `context` and the initial weights of its decoders, one parameter per level in optimizer group `group`.
    pub fn new(settings: &VoxelSettings, context: &DeformerContext, group: usize, device: &Device) -> Result<(Self, Vec<Parameter>)> {
        check_box(context)?;
        let sizes = settings.sizes()?;
        let (mut decoders, mut parameters) = (Vec::new(), Vec::new());
        for level in 0..sizes.resolutions.len() {
            let seed = context.seed.child("level").index(level as u64);
            let values = weights::decoder(seed.child("weights"), &sizes.decoder);
            parameters.push(parameter(format!("grid.level{level}"), Part::Grid, group, values, device));
            decoders.push(Arc::new(Decoder { hash: settings.hash(context, level), shape: sizes.decoder.clone() }));
        }
        let (box_min, box_max, width) = (context.box_min, context.box_max, sizes.width());
        Ok((Self { box_min, box_max, resolutions: sizes.resolutions, decoders, reuse: settings.vertex_reuse, width }, parameters))
    }
    /// Number of levels, which is the number of parameters.
    pub fn levels(&self) -> usize {
        self.decoders.len()
    }
    /// The grid and the decoder of every level.
    pub fn grids(&self) -> impl Iterator<Item = (GridBox, &Decoder)> {
        self.resolutions
            .iter()
            .zip(&self.decoders)
            .map(|(&resolution, decoder)| (GridBox { min: self.box_min, max: self.box_max, resolution }, decoder.as_ref()))
    }
    /// Features per centre.
    pub fn width(&self) -> usize {
        self.width
    }
    /// f_voxel `[M, width]` of `means_world` `[M,3]` (M > 0) by the decoders of `parameters` (the first [`Voxels::levels`]), and the work done.
    pub fn features(&self, parameters: &[Parameter], means_world: Tensor<2>) -> Result<(Tensor<2>, DeformerWork)> {
        let [m, _] = means_world.dims();
        let mut work = DeformerWork { gaussians: m as u64, ..DeformerWork::default() };
        let mut levels = Vec::with_capacity(self.decoders.len());
        let grids: Vec<GridBox> = self.grids().map(|(grid, _)| grid).collect();
        // Training does not read the vertex count back, because only reports use it.
        let counted = !parameters.iter().any(|p| p.value.is_require_grad());
        let found = VoxelCorners::find(means_world, &grids, self.reuse, counted)?;
        for ((decoder, parameter), corners) in self.decoders.iter().zip(parameters).zip(found) {
            work.vertices_queried += 8 * m as u64;
            work.vertices_decoded += corners.vertices.dims()[0] as u64;
            let features = corners.decode(parameter.value.clone(), decoder)?;
            levels.push(corners.interpolate(features)?);
        }
        Ok((Tensor::cat(levels, 1), work))
    }
}

/// A flat parameter from host values.
pub fn parameter(name: String, part: Part, group: usize, values: Vec<f32>, device: &Device) -> Parameter {
    let count = values.len();
    Parameter { name, part, shape: vec![count], value: Tensor::from_data(TensorData::new(values, [count]), device), group }
}
