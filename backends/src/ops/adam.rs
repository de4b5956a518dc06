//! The fused Adam step.

use crate::cpu::adam as kernel;
use crate::cpu::tensor::CpuBackend;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::{Int, Tensor};
use cc4dgs_core::{Error, Result};

/// Gradients have to be smaller than this. The square of one from 1.8e19 on is infinite in float32, and then its second moment would stay infinite.
pub const GRADIENT_LIMIT: f32 = 1e18;

/// The settings of one step.
#[derive(Clone, Debug)]
pub struct AdamSettings {
    /// Learning rate.
    pub lr: f64,
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment; at least [`f32::MIN_POSITIVE`].
    pub epsilon: f64,
    /// Number of this step, from 1; sets the bias corrections.
    pub step: u64,
    /// One entry per row (dimension 0); rows with 0 are unchanged, moments included (selective Adam of gsplat). The radii of a rasterizer can be passed.
    pub visible: Option<Tensor<1, Int>>,
}

impl AdamSettings {
    /// The settings of 3DGS: betas 0.9 and 0.999, epsilon 1e-15, every row.
    pub fn new(lr: f64, step: u64) -> Self {
        Self { lr, beta1: 0.9, beta2: 0.999, epsilon: 1e-15, step, visible: None }
    }
}

/// The scalars of one step, bias corrections folded in.
#[derive(Clone, Copy, Debug)]
pub struct AdamScalars {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// 1 - beta1, from float64.
    pub one_minus_beta1: f32,
    /// 1 - beta2, from float64.
    pub one_minus_beta2: f32,
    /// Learning rate over the first bias correction.
    pub step_size: f32,
    /// 1 / sqrt(second bias correction).
    pub inverse_sqrt_correction: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
}

/// The result of a step.
#[derive(Clone, Debug)]
pub struct AdamStep<const D: usize> {
    /// The parameters after the step.
    pub param: Tensor<D>,
    /// First moment.
    pub m: Tensor<D>,
    /// Second moment.
    pub v: Tensor<D>,
}

type Moved<B> = (FloatTensor<B>, FloatTensor<B>, FloatTensor<B>);

/// The operations per device: `(param, m, v)`.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"))]
pub trait AdamOps: Backend {
    /// Updates `param` by one step; all four float tensors have one shape.
    fn adam(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
    /// The same for the rows whose entry in `visible` is not 0.
    fn adam_visible(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        visible: IntTensor<Self>,
        scalars: AdamScalars,
    ) -> (FloatTensor<Self>, FloatTensor<Self>, FloatTensor<Self>);
}

fn step_on_cpu<B: CpuBackend>(
    param: FloatTensor<B>,
    m: FloatTensor<B>,
    v: FloatTensor<B>,
    grad: FloatTensor<B>,
    visible: Option<IntTensor<B>>,
    scalars: AdamScalars,
) -> Moved<B> {
    let shape = param.shape();
    let width = shape.num_elements().checked_div(shape[0]).unwrap_or(0);
    let rows = visible.as_ref().map(|visible| B::ints(visible));
    let grad = B::floats(&grad);
    let mut moments = (None, None);
    let param = B::update_floats(param, |p| {
        let mut second = None;
        let first = B::update_floats(m, |m| {
            second = Some(B::update_floats(v, |v| kernel::adam(p, m, v, &grad, width, rows.as_deref(), &scalars)));
        });
        moments = (Some(first), second);
    });
    let empty = || B::from_floats(Vec::new(), [0]);
    (param, moments.0.unwrap_or_else(empty), moments.1.unwrap_or_else(empty))
}

impl<B: CpuBackend> AdamOps for B {
    fn adam(param: FloatTensor<Self>, m: FloatTensor<Self>, v: FloatTensor<Self>, grad: FloatTensor<Self>, scalars: AdamScalars) -> Moved<Self> {
        step_on_cpu::<Self>(param, m, v, grad, None, scalars)
    }
    fn adam_visible(
        param: FloatTensor<Self>,
        m: FloatTensor<Self>,
        v: FloatTensor<Self>,
        grad: FloatTensor<Self>,
        visible: IntTensor<Self>,
        scalars: AdamScalars,
    ) -> Moved<Self> {
        step_on_cpu::<Self>(param, m, v, grad, Some(visible), scalars)
    }
}

/// One Adam step, p -= lr / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + eps), in place when the tensors have no other owner.
/// Results carry no autodiff association; rows (dimension 0) with a gradient that is not finite, or of [`GRADIENT_LIMIT`] or more, are skipped.
pub fn adam_step<const D: usize>(param: Tensor<D>, m: Tensor<D>, v: Tensor<D>, grad: Tensor<D>, settings: &AdamSettings) -> Result<AdamStep<D>> {
    let shape = param.dims();
    for (name, other) in [("first moment", m.dims()), ("second moment", v.dims()), ("gradient", grad.dims())] {
        if other != shape {
            return Err(Error::parameter(
                "adam",
                format!("{name} has shape {other:?}, the parameters have {shape:?}"),
                "Resize the optimizer state with the parameters",
            ));
        }
    }
    if let Some(visible) = &settings.visible
        && visible.dims()[0] != shape[0]
    {
        return Err(Error::parameter("adam", format!("{} visibility entries for {} rows", visible.dims()[0], shape[0]), "Give one entry per row"));
    }
    let decays = [settings.beta1, settings.beta2];
    if settings.step == 0 || !settings.lr.is_finite() || decays.iter().any(|b| !(0.0..1.0).contains(b)) {
        return Err(Error::parameter(
            "adam",
            format!("step {}, lr {}, betas {decays:?}", settings.step, settings.lr),
            "Count steps from 1, keep the rate finite and the betas in [0, 1)",
        ));
    }
    // Graphics cards may take subnormal numbers for 0.
    let epsilon = settings.epsilon as f32;
    if epsilon < f32::MIN_POSITIVE || !epsilon.is_finite() {
        return Err(Error::parameter(
            "adam",
            format!("epsilon {:e} is {epsilon:e} in float32", settings.epsilon),
            format!("Give a finite number of at least {:e}, such as 1e-15: without it, a step from moments of 0 is 0 / 0", f32::MIN_POSITIVE),
        ));
    }
    let t = settings.step as f64;
    let scalars = AdamScalars {
        beta1: settings.beta1 as f32,
        beta2: settings.beta2 as f32,
        one_minus_beta1: (1.0 - settings.beta1) as f32,
        one_minus_beta2: (1.0 - settings.beta2) as f32,
        step_size: (settings.lr / (1.0 - settings.beta1.powf(t))) as f32,
        inverse_sqrt_correction: (1.0 / (1.0 - settings.beta2.powf(t)).sqrt()) as f32,
        epsilon,
    };
    let [param, m, v, grad] = [param, m, v, grad].map(|t| t.inner().into_dispatch());
    let (param, m, v) = match settings.visible.clone() {
        Some(visible) => <Dispatch as AdamOps>::adam_visible(param, m, v, grad, visible.inner().into_dispatch(), scalars),
        None => <Dispatch as AdamOps>::adam(param, m, v, grad, scalars),
    };
    Ok(AdamStep { param: Tensor::from_dispatch(param), m: Tensor::from_dispatch(m), v: Tensor::from_dispatch(v) })
}
