//! The tile rasterizer on the device.
//!
//! Gaussians are projected, sorted by depth, and appended to the lists of the tiles they meet in that order; sorting the pairs by tile alone then leaves every
//! list in depth order. The number of pairs is the one thing read back per render, and not even that where the caller says how much room to make. Backwards,
//! each pair has a gradient record of its own place, and the pairs of a Gaussian lie side by side, so that all sums have a fixed order.

mod backward;
mod blend;
mod forward;
mod geometry;
mod gradient;
mod harmonics;
mod lists;
mod project;
mod vector;

use super::tensor::{UNITS, empty};
use crate::cpu::raster::RasterSettings;
use crate::ops::rasterize::{Method, PARENTS, RasterBackward, RasterOps, Rasterized, Saved, SavedInputs};
use burn::backend::tensor::FloatTensor;
use burn::tensor::DType;
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

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

const DIM: fn() -> CubeDim = || CubeDim::new_1d(UNITS);

fn words(like: &CubeTensor, count: usize) -> CubeTensor {
    empty(like, [count], DType::U32)
}

/// The numbers of a buffer of words, read back.
fn read_words(tensor: &CubeTensor) -> Vec<u32> {
    u32::from_bytes(&tensor.client.read_one_unchecked(tensor.handle.clone())).to_vec()
}

fn read_floats(tensor: &CubeTensor) -> Vec<f32> {
    f32::from_bytes(&tensor.client.read_one_unchecked(tensor.handle.clone())).to_vec()
}

/// Floats of higher coefficients per Gaussian.
fn rest_width(sh_rest: &CubeTensor, n: usize) -> usize {
    sh_rest.meta.shape().num_elements().checked_div(n).unwrap_or(0)
}

impl RasterOps for CubeBackend {
    fn rasterize(
        means: FloatTensor<Self>,
        scales: FloatTensor<Self>,
        quaternions: FloatTensor<Self>,
        opacities: FloatTensor<Self>,
        colors: FloatTensor<Self>,
        sh_rest: FloatTensor<Self>,
        _screen_probe: FloatTensor<Self>,
        _camera_probe: FloatTensor<Self>,
        background: FloatTensor<Self>,
        settings: RasterSettings,
        _method: Method,
    ) -> Rasterized<Self> {
        forward::forward([means, scales, quaternions, opacities, colors, sh_rest, background], &settings)
    }
}

impl RasterBackward for CubeBackend {
    fn rasterize_backward(
        inputs: SavedInputs<Self>,
        settings: &RasterSettings,
        saved: &Saved,
        upstream: FloatTensor<Self>,
        wanted: [bool; PARENTS],
    ) -> [Option<FloatTensor<Self>>; PARENTS] {
        backward::backward(inputs, settings, saved, upstream, wanted)
    }
}
