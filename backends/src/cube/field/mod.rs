//! The computational deformation field on the device.

mod activation;
mod decoder;
mod gradients;
mod layers;
mod network;
mod program;
mod voxels;

pub use decoder::widest_row as widest_decoder_row;
pub use gradients::add_segments;
pub use network::widest_row;

use crate::ops::corners::{CornerOps, CornersBegun, GridBox};
use crate::ops::field::{Decoder, FieldKernels, FieldOps, ReluShape};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn_cubecl::CubeBackend;
use burn_cubecl::kernel::into_contiguous;
use std::sync::Arc;

impl FieldKernels for CubeBackend {
    fn decode_backward(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        decoder::backward(&into_contiguous(weights), &into_contiguous(vertices), &decoder, &into_contiguous(grad))
    }
    fn trilinear_backward(grad: FloatTensor<Self>, weights: FloatTensor<Self>, slots: IntTensor<Self>, starts: IntTensor<Self>) -> FloatTensor<Self> {
        voxels::interpolate_backward(into_contiguous(grad), into_contiguous(weights), into_contiguous(slots), into_contiguous(starts))
    }
    fn network_backward(
        x: FloatTensor<Self>,
        weights: FloatTensor<Self>,
        shape: Arc<ReluShape>,
        grad: FloatTensor<Self>,
        wants_input: bool,
    ) -> (Option<FloatTensor<Self>>, FloatTensor<Self>) {
        network::backward(&into_contiguous(x), &into_contiguous(weights), &shape, &into_contiguous(grad), wants_input)
    }
}

impl FieldOps for CubeBackend {
    fn decode(weights: FloatTensor<Self>, vertices: IntTensor<Self>, decoder: Arc<Decoder>) -> FloatTensor<Self> {
        decoder::forward(&into_contiguous(weights), &into_contiguous(vertices), &decoder)
    }
    fn trilinear(
        features: FloatTensor<Self>,
        corners: IntTensor<Self>,
        weights: FloatTensor<Self>,
        _slots: IntTensor<Self>,
        _starts: IntTensor<Self>,
    ) -> FloatTensor<Self> {
        voxels::interpolate(into_contiguous(features), into_contiguous(corners), into_contiguous(weights))
    }
    fn network(x: FloatTensor<Self>, weights: FloatTensor<Self>, shape: Arc<ReluShape>) -> FloatTensor<Self> {
        network::forward(&into_contiguous(x), &into_contiguous(weights), &shape)
    }
}

impl CornerOps for CubeBackend {
    fn begin_corners(points: FloatTensor<Self>, grid: GridBox, reuse: bool) -> CornersBegun<Self> {
        voxels::begin(&into_contiguous(points), grid, reuse)
    }
    fn list_corners(
        slots: IntTensor<Self>,
        vertices: IntTensor<Self>,
        starts: IntTensor<Self>,
        _corners: IntTensor<Self>,
        grid: GridBox,
        reuse: bool,
        capacity: usize,
    ) -> (IntTensor<Self>, IntTensor<Self>, IntTensor<Self>) {
        voxels::list(slots, vertices, starts, grid, reuse, capacity)
    }
}
