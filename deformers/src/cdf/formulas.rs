//! The computational deformation field by the paper's formulas, in burn's primitives: no fused kernels, nothing folded. Slow and obvious: tests compare the
//! fused implementation with it, and so do the benchmarks.

use super::Cdf;
use burn::tensor::activation::{mish, relu};
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::field::{MishShape, VoxelCorners};
use cc4dgs_core::{Error, Result};
use cc4dgs_fields::time;

/// A deformer to be evaluated step by step.
pub struct Formulas<'a>(pub &'a Cdf);

fn matrix(values: Vec<f32>, width: usize, device: &Device) -> Tensor<2> {
    let rows = values.len() / width;
    Tensor::from_data(TensorData::new(values, [rows, width]), device)
}

/// Linear layer from `input` to `output` features. Its weights start at `at` in a flat array; `at` is advanced past them.
fn linear(x: Tensor<2>, weights: &Tensor<1>, at: &mut usize, (input, output): (usize, usize)) -> Tensor<2> {
    let w = weights.clone().narrow(0, *at, input * output).reshape([input, output]);
    let b = weights.clone().narrow(0, *at + input * output, output).reshape([1, output]);
    *at += (input + 1) * output;
    x.matmul(w) + b
}

fn decoder(x: Tensor<2>, weights: &Tensor<1>, shape: &MishShape) -> Tensor<2> {
    let (mut x, mut at, mut input) = (x, 0, shape.input);
    for &h in &shape.hidden {
        x = linear(x, weights, &mut at, (input, h));
        let centred = x.clone() - x.mean_dim(1);
        let deviation = (centred.clone().powi_scalar(2).mean_dim(1) + 1e-5).sqrt();
        let [gain, shift] = [0, h].map(|offset| weights.clone().narrow(0, at + offset, h).reshape([1, h]));
        at += 2 * h;
        x = mish(centred / deviation * gain + shift);
        input = h;
    }
    linear(x, weights, &mut at, (input, shape.output))
}

fn chain(mut x: Tensor<2>, weights: &Tensor<1>, widths: &[usize], last_relu: bool) -> Tensor<2> {
    let mut at = 0;
    for (i, pair) in widths.windows(2).enumerate() {
        x = linear(x, weights, &mut at, (pair[0], pair[1]));
        if last_relu || i + 2 < widths.len() {
            x = relu(x);
        }
    }
    x
}

impl Formulas<'_> {
    fn weight(&self, name: &str) -> Result<Tensor<1>> {
        let found = self.0.parameters.iter().find(|p| p.name == name).map(|p| p.value.clone());
        found.ok_or_else(|| Error::backend("deformer cdf", format!("it has no weights {name}"), "Report this as a defect"))
    }
    /// f_voxel `[M, width]` of `means_world` `[M,3]` on the device of the weights. Cells and signatures are computed on the host, by the same functions as in
    /// [`Cdf`].
    fn voxels(&self, means_world: &Tensor<2>, device: &Device) -> Result<Tensor<2>> {
        let mut levels = Vec::new();
        let m = means_world.dims()[0];
        let (grids, nets): (Vec<_>, Vec<_>) = self.0.voxels.grids().unzip();
        let found = VoxelCorners::find(means_world.clone(), &grids, true, true)?;
        for (level, (corners, net)) in found.into_iter().zip(nets).enumerate() {
            let flat: Vec<i64> = corners.vertices.into_data().iter::<i64>().collect();
            let vertices: Vec<[u32; 3]> = flat.as_chunks::<3>().0.iter().map(|v| v.map(|c| c as u32)).collect();
            let mut signatures = vec![0.0; vertices.len() * net.shape.input];
            net.hash.signatures(&vertices, &mut signatures);
            let features = decoder(matrix(signatures, net.shape.input, device), &self.weight(&format!("grid.level{level}"))?, &net.shape);
            let gathered = features.select(0, Tensor::<1, Int>::from_data(corners.corners.into_data(), device));
            let weights = Tensor::<1>::from_data(corners.weights.into_data(), device).reshape([8 * m, 1]);
            levels.push((gathered * weights).reshape([m, 8, net.shape.output]).sum_dim(1).reshape([m, net.shape.output]));
        }
        Ok(Tensor::cat(levels, 1))
    }
    /// All heads' offsets `[M, sum of widths]` of `means_world` `[M,3]` (M > 0) at a time, in the order of the heads.
    pub fn offsets(&self, means_world: Tensor<2>, time_norm: f32) -> Result<Tensor<2>> {
        let sizes = &self.0.sizes;
        let device = self.weight("net.time")?.device();
        let voxel = self.voxels(&means_world.inner(), &device)?;
        let (m, w) = (voxel.dims()[0], sizes.width);
        let network = &self.0.config.network;
        let encoding = time::encode_scaled(time_norm, sizes.time_bands, network.cycles, network.falloff);
        let inputs = encoding.len();
        let widths: Vec<usize> = std::iter::once(inputs).chain(sizes.time.trunk.iter().copied()).chain(sizes.time.heads.iter().flatten().copied()).collect();
        let f_time = chain(matrix(encoding, inputs, &device), &self.weight("net.time")?, &widths, false);
        let fused = if sizes.film.is_some() {
            let h = chain(voxel, &self.weight("net.spatial")?, &[sizes.voxels.width(), w], false);
            let modulation = chain(f_time, &self.weight("net.film")?, &[w, w, 2 * w], false);
            h * modulation.clone().narrow(1, 0, w) + modulation.narrow(1, w, w)
        } else {
            let both = Tensor::cat(vec![voxel, f_time.repeat_dim(0, m)], 1);
            chain(both, &self.weight("net.spatial")?, &[sizes.spatial_inputs(), w], false)
        };
        let trunk: Vec<usize> = std::iter::once(w).chain(sizes.network.trunk.iter().copied()).collect();
        let hidden = chain(fused, &self.weight("net.trunk")?, &trunk, true);
        let heads = self.0.config.network.heads.iter().map(|head| {
            let weights = self.weight(&format!("net.head.{}", head.name()))?;
            Ok(chain(hidden.clone(), &weights, &[w, w, head.width(self.0.sh_degree)], false))
        });
        Ok(Tensor::cat(heads.collect::<Result<Vec<_>>>()?, 1))
    }
}
