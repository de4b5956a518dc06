//! An affine transform of the colours of an image: one pass over the pixels each way. As a product of a 3x3 matrix with all pixels it took 79 ms on an H200 for
//! 640x360 pixels, forwards and backwards: matrix products are made for large matrices.

use crate::cpu::colors as kernel;
use crate::cpu::tensor::CpuBackend;
use crate::ops::autodiff::{differentiate, record};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::Tensor;
use cc4dgs_core::{Error, Result};

/// Numbers of a transform: the rows of its 3x3 matrix, then its offset.
pub const NUMBERS: usize = 12;

/// The derivatives per device.
pub trait ColorBackward: Backend {
    /// The gradient of the planes `[C,H,W]`.
    fn planes_gradient(transform: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self>;
    /// The gradient of the transform `[12]`.
    fn transform_gradient(planes: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait ColorOps: Backend {
    /// Planes `[C,H,W]` (red, green and blue first) of which the colours are M rgb + b, with M and b of `transform` `[12]`; differentiable in both.
    fn colors(planes: FloatTensor<Self>, transform: FloatTensor<Self>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> ColorBackward for B {
    fn planes_gradient(transform: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let shape = grad.shape();
        let pixels = shape[1] * shape[2];
        B::from_floats(kernel::planes_gradient(&B::floats(&transform), &B::floats(&grad), pixels), shape)
    }
    fn transform_gradient(planes: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let pixels = grad.shape()[1] * grad.shape()[2];
        B::from_floats(kernel::transform_gradient(&B::floats(&planes), &B::floats(&grad), pixels), [NUMBERS])
    }
}

impl<B: CpuBackend> ColorOps for B {
    fn colors(planes: FloatTensor<Self>, transform: FloatTensor<Self>) -> FloatTensor<Self> {
        let shape = planes.shape();
        let pixels = shape[1] * shape[2];
        B::from_floats(kernel::forward(&B::floats(&planes), &B::floats(&transform), pixels), shape)
    }
}

#[derive(Debug)]
struct Colors;

impl<B: ColorBackward> Backward<B, 2> for Colors {
    type State = (FloatTensor<B>, FloatTensor<B>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 2>(ops, grads, |(planes, transform), upstream, [of_planes, of_transform]| {
            [of_planes.then(|| B::planes_gradient(transform, upstream.clone())), of_transform.then(|| B::transform_gradient(planes, upstream))]
        });
    }
}

impl<B: ColorBackward + ColorOps, C: CheckpointStrategy> ColorOps for Autodiff<B, C> {
    fn colors(planes: FloatTensor<Self>, transform: FloatTensor<Self>) -> FloatTensor<Self> {
        let (planes, transform) = (planes.into_parts(), transform.into_parts());
        record::<B, C, _, 2>(Colors, [planes.1, transform.1], |_| (B::colors(planes.0.clone(), transform.0.clone()), (planes.0, transform.0)))
    }
}

/// Planes `[C,H,W]` (red, green and blue first, C > 2) of which the colours are M rgb + b, with the rows of M, then b in `transform` `[12]`. Differentiable in
/// both.
///
/// # Errors
/// [`Error::Parameter`] for other shapes.
pub fn affine_colors(planes: Tensor<3>, transform: Tensor<1>) -> Result<Tensor<3>> {
    let ([channels, height, width], [numbers]) = (planes.dims(), transform.dims());
    if channels < 3 || height * width == 0 || numbers != NUMBERS {
        let problem =
            format!("planes have shape [{channels},{height},{width}], their transform has {numbers} numbers; [3 or more,H,W] and {NUMBERS} are expected");
        return Err(Error::parameter("affine colours", problem, "Give an image and the transform of its camera"));
    }
    Ok(Tensor::from_dispatch(<Dispatch as ColorOps>::colors(planes.into_dispatch(), transform.into_dispatch())))
}
