//! The photometric loss and the cross-entropy of the score stage, with their gradients.

use super::limits::check_binding;
use crate::cpu::cross_entropy::bce_with_logits;
use crate::cpu::photometric as kernel;
use crate::cpu::tensor::CpuBackend;
use crate::ops::autodiff::{differentiate, record, record_beside};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, AutodiffBackend, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::Tensor;
use cc4dgs_core::{Error, Result};
use rayon::prelude::*;

/// Values per task where a gradient is scaled.
const SCALED: usize = 65536;

/// Blurred moments per channel: the largest array of the kernels for GPUs.
pub(crate) const MOMENTS: u32 = 5;

/// The passes per device.
pub trait PhotometricKernels: Backend {
    /// `(loss [1], terms [l1, ssim, mse], gradient)`; the gradient has the shape of `planes`, or is empty without `gradient`.
    fn photometric_pass(
        planes: FloatTensor<Self>,
        target: FloatTensor<Self>,
        lambda_c: f32,
        gradient: bool,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    /// `(loss [1], gradient)` of the first plane of `planes` as logits; the gradient has the shape of `planes`, or is empty without `gradient`.
    fn bce_pass(planes: FloatTensor<Self>, mask: FloatTensor<Self>, gradient: bool) -> (FloatTensor<Self>, FloatTensor<Self>);
    /// `gradient` times the number in `upstream` `[1]`.
    fn scale_by(gradient: FloatTensor<Self>, upstream: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operations of this module per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait PhotometricOps: Backend {
    /// Loss `[1]` and terms `[3]` (l1, ssim, mse; without gradient) of the first three of `planes` `[C,H,W]` against `target` `[3,H,W]`.
    fn photometric(planes: FloatTensor<Self>, target: FloatTensor<Self>, lambda_c: f32) -> (FloatTensor<Self>, FloatTensor<Self>);
    /// Mean binary cross-entropy `[1]` of the first of `planes` `[C,H,W]` as logits against `mask` `[H,W]`.
    fn bce_with_logits(planes: FloatTensor<Self>, mask: FloatTensor<Self>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> PhotometricKernels for B {
    fn photometric_pass(
        planes: FloatTensor<Self>,
        target: FloatTensor<Self>,
        lambda_c: f32,
        gradient: bool,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>) {
        let shape = planes.shape();
        let (height, width) = (shape[1], shape[2]);
        let mut grads = vec![0.0f32; if gradient { shape.num_elements() } else { 0 }];
        let wanted = gradient.then_some(grads.as_mut_slice());
        let terms = kernel::photometric(&B::floats(&planes), &B::floats(&target), (3, height, width), lambda_c, wanted);
        let loss = f64::from(lambda_c) * terms.l1 + (1.0 - f64::from(lambda_c)) * (1.0 - terms.ssim);
        let grads = if gradient { B::from_floats(grads, shape) } else { B::from_floats(grads, [0]) };
        (B::from_floats(vec![loss as f32], [1]), B::from_floats(vec![terms.l1 as f32, terms.ssim as f32, terms.mse as f32], [3]), grads)
    }
    fn bce_pass(planes: FloatTensor<Self>, mask: FloatTensor<Self>, gradient: bool) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let shape = planes.shape();
        let pixels = shape[1] * shape[2];
        let mut grads = vec![0.0f32; if gradient { shape.num_elements() } else { 0 }];
        let wanted = gradient.then_some(&mut grads[..if gradient { pixels } else { 0 }]);
        let loss = bce_with_logits(&B::floats(&planes)[..pixels], &B::floats(&mask), wanted);
        let grads = if gradient { B::from_floats(grads, shape) } else { B::from_floats(grads, [0]) };
        (B::from_floats(vec![loss as f32], [1]), grads)
    }
    fn scale_by(gradient: FloatTensor<Self>, upstream: FloatTensor<Self>) -> FloatTensor<Self> {
        let factor = B::floats(&upstream).first().copied().unwrap_or(1.0);
        if factor == 1.0 {
            return gradient;
        }
        B::update_floats(gradient, |values| values.par_chunks_mut(SCALED).for_each(|values| values.iter_mut().for_each(|v| *v *= factor)))
    }
}

impl<B: CpuBackend> PhotometricOps for B {
    fn photometric(planes: FloatTensor<Self>, target: FloatTensor<Self>, lambda_c: f32) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (loss, terms, _) = Self::photometric_pass(planes, target, lambda_c, false);
        (loss, terms)
    }
    fn bce_with_logits(planes: FloatTensor<Self>, mask: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::bce_pass(planes, mask, false).0
    }
}

/// Backward of a scalar loss whose gradient was computed with it: the state is that gradient.
#[derive(Debug)]
struct KnownGradient;

impl<B: PhotometricKernels> Backward<B, 1> for KnownGradient {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 1>(ops, grads, |gradient, upstream, [wanted]| [wanted.then(|| B::scale_by(gradient, upstream))]);
    }
}

impl<B: PhotometricKernels + PhotometricOps, C: CheckpointStrategy> PhotometricOps for Autodiff<B, C> {
    fn photometric(planes: FloatTensor<Self>, target: FloatTensor<Self>, lambda_c: f32) -> (FloatTensor<Self>, FloatTensor<Self>) {
        let (planes, parent) = planes.into_parts();
        let target = target.into_primitive();
        let (loss, terms) = record_beside::<B, C, _, _, 1>(KnownGradient, [parent], |tracked| {
            let (loss, terms, gradient) = B::photometric_pass(planes, target, lambda_c, tracked);
            (loss, gradient, terms)
        });
        (loss, Self::from_inner(terms))
    }
    fn bce_with_logits(planes: FloatTensor<Self>, mask: FloatTensor<Self>) -> FloatTensor<Self> {
        let (planes, parent) = planes.into_parts();
        let mask = mask.into_primitive();
        record::<B, C, _, 1>(KnownGradient, [parent], |tracked| B::bce_pass(planes, mask, tracked))
    }
}

/// A photometric loss and what it is made of.
#[derive(Clone, Debug)]
pub struct PhotometricLoss {
    /// lambda_c * L1 + (1 - lambda_c) * (1 - SSIM) `[1]`; carries the gradient to the planes.
    pub loss: Tensor<1>,
    /// Mean absolute difference, mean SSIM, mean squared difference `[3]`; no gradient; on the device until [`PhotometricLoss::numbers`] reads them.
    pub terms: Tensor<1>,
}

/// The numbers of [`PhotometricLoss::terms`] on the host.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PhotometricNumbers {
    /// Mean absolute difference.
    pub l1: f32,
    /// Mean structural similarity (Inria's convention).
    pub ssim: f32,
    /// Mean squared difference of the unrounded image.
    pub mse: f32,
}

impl PhotometricNumbers {
    /// PSNR in dB of the unrounded image for a data range of 1; capped at 100 dB, where float32 images stop differing.
    pub fn psnr_db(&self) -> f32 {
        -10.0 * self.mse.clamp(1e-10, f32::INFINITY).log10()
    }
}

impl PhotometricLoss {
    /// Reads the terms back.
    pub fn numbers(&self) -> Result<PhotometricNumbers> {
        match cc4dgs_core::gaussians::to_vec(self.terms.clone(), "photometric terms")?.as_slice() {
            [l1, ssim, mse] => Ok(PhotometricNumbers { l1: *l1, ssim: *ssim, mse: *mse }),
            other => Err(Error::backend("photometric terms", format!("{} numbers came back, expected 3", other.len()), "Try another device (--device flex)")),
        }
    }
}

/// The loss of 3DGS and of CC-4DGS (Section IV-E): lambda_c * L1 + (1 - lambda_c) * (1 - SSIM), SSIM with an 11x11 Gaussian window
/// of sigma 1.5 and zero padding. Reads the first three of `planes` [C>=3,H,W]; the gradient of the others is zero. `target` is `[3,H,W]`.
pub fn photometric_loss(planes: Tensor<3>, target: Tensor<3>, lambda_c: f32) -> Result<PhotometricLoss> {
    let ([c, h, w], [tc, th, tw]) = (planes.dims(), target.dims());
    if c < 3 || [tc, th, tw] != [3, h, w] {
        return Err(Error::parameter(
            "photometric loss",
            format!("planes [{c},{h},{w}] against target [{tc},{th},{tw}]"),
            "Give at least 3 planes and a [3,H,W] target of the same size",
        ));
    }
    if !(0.0..=1.0).contains(&lambda_c) {
        return Err(Error::parameter("photometric loss", format!("lambda_c = {lambda_c} is outside 0..1"), "Give the weight of L1 as a number from 0 to 1"));
    }
    check_binding(&planes.device(), "photometric loss", "pixels", h * w, 3 * MOMENTS as usize * size_of::<f32>())?;
    let (loss, terms) = <Dispatch as PhotometricOps>::photometric(planes.into_dispatch(), target.into_dispatch(), lambda_c);
    Ok(PhotometricLoss { loss: Tensor::from_dispatch(loss), terms: Tensor::<1>::from_dispatch(terms).inner() })
}

/// Mean binary cross-entropy of the first of `planes` [C>=1,H,W] as logits against `mask` `[H,W]` in 0..1: the score stage's loss. The gradient of
/// the other planes is zero.
pub fn bce_with_logits_loss(planes: Tensor<3>, mask: Tensor<2>) -> Result<Tensor<1>> {
    let ([c, h, w], [mh, mw]) = (planes.dims(), mask.dims());
    if c == 0 || [mh, mw] != [h, w] {
        return Err(Error::parameter("score loss", format!("planes [{c},{h},{w}] against mask [{mh},{mw}]"), "Give a mask of the rendered size"));
    }
    check_binding(&planes.device(), "score loss", "pixels", h * w, c * size_of::<f32>())?;
    Ok(Tensor::from_dispatch(<Dispatch as PhotometricOps>::bce_with_logits(planes.into_dispatch(), mask.into_dispatch())))
}
