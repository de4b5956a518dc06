//! The tile rasterizer on the device.
//!
//! Gaussians are projected, sorted by depth, and appended to the lists of the tiles they meet in that order; a stable sort of the pairs by tile alone then
//! keeps every list in depth order. The number of pairs is the one thing read back per render, unless the caller states a capacity. Backwards, each pair has a
//! gradient record of its own, and the pairs of a Gaussian are adjacent, so that all sums have a fixed order.

mod backward;
mod blend;
mod cells;
mod forward;
mod geometry;
mod gradient;
mod harmonics;
mod lists;
mod project;
mod vector;

use super::tensor::{THREADS, empty};
use crate::ops::rasterize::{GradientRequest, Method, Probes, RasterBackward, RasterGradients, RasterOps, RasterSettings, Rasterized, Saved, SplatTensors};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;
use cubecl::server::ServerError;

/// What the backward pass needs of the forward pass.
struct Lists {
    cam: CubeTensor,
    splats: CubeTensor,
    keys: CubeTensor,
    gaussian_of_pair: CubeTensor,
    start_of_gaussian: CubeTensor,
    sorted: CubeTensor,
    tile_starts: CubeTensor,
    state: CubeTensor,
    pairs: usize,
}

const DIM: fn() -> CubeDim = || CubeDim::new_1d(THREADS);

fn words(like: &CubeTensor, count: usize) -> CubeTensor {
    empty(like, [count], DType::U32)
}

/// Reads the first word of a buffer back.
fn read_word(tensor: &CubeTensor) -> Result<u32, ServerError> {
    let bytes = tensor.client.read_one(tensor.handle.clone())?;
    Ok(u32::from_bytes(&bytes).first().copied().unwrap_or(0))
}

/// Floats of higher coefficients per Gaussian.
fn rest_width(sh_rest: &CubeTensor, n: usize) -> usize {
    sh_rest.meta.shape().num_elements().checked_div(n).unwrap_or(0)
}

/// Every tensor with its elements side by side.
fn contiguous(splats: SplatTensors<CubeBackend>) -> SplatTensors<CubeBackend> {
    SplatTensors {
        means: into_contiguous(splats.means),
        scales: into_contiguous(splats.scales),
        quaternions: into_contiguous(splats.quaternions),
        opacities: into_contiguous(splats.opacities),
        colors: into_contiguous(splats.colors),
        sh_rest: into_contiguous(splats.sh_rest),
        background: into_contiguous(splats.background),
    }
}

impl RasterOps for CubeBackend {
    fn rasterize(splats: SplatTensors<Self>, _: Probes<Self>, settings: RasterSettings, _: Method) -> Rasterized<Self> {
        forward::forward(splats, &settings)
    }
}

impl RasterBackward for CubeBackend {
    fn rasterize_backward(
        splats: SplatTensors<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        request: GradientRequest,
    ) -> RasterGradients<Self> {
        backward::backward(splats, settings, saved, upstream, request)
    }
}
