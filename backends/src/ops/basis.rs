//! Offsets as combinations of shared functions of time: out = C φ, a dot product per number and Gaussian.

use super::field::split_heads;
use super::limits::check_binding;
use super::shared::{Shared, Token, share};
use crate::cpu::basis::{self as kernel, Coefficients};
use crate::cpu::tensor::CpuBackend;
use crate::ops::autodiff::{differentiate, record};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, backend_extension};
use burn::tensor::Tensor;
use cc4dgs_core::{Error, Result};
use std::sync::Arc;

/// The layout of coefficients: group by group (a group is a head), then row by row, then per output those of the group's functions. The functions of all
/// groups follow each other too, so that each group may have its own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BasisShape {
    /// (outputs, functions each of them combines), group by group.
    pub groups: Vec<(usize, usize)>,
}

impl BasisShape {
    /// Outputs of every group.
    pub fn widths(&self) -> Vec<usize> {
        self.groups.iter().map(|g| g.0).collect()
    }
    /// Outputs per Gaussian, all groups.
    pub fn outputs(&self) -> usize {
        self.groups.iter().map(|g| g.0).sum()
    }
    /// Coefficients per Gaussian.
    pub fn coefficients(&self) -> usize {
        self.groups.iter().map(|g| g.0 * g.1).sum()
    }
    /// Functions of all groups.
    pub fn functions(&self) -> usize {
        self.groups.iter().map(|g| g.1).sum()
    }
}

/// What combinations of the same coefficients save for the gradient of the coefficients.
#[derive(Debug)]
pub struct Combinations {
    shape: Arc<BasisShape>,
    rows: usize,
    gradients: Shared,
}

impl Combinations {
    /// The layout of the coefficients.
    pub fn shape(&self) -> &BasisShape {
        &self.shape
    }
}

/// The derivatives per device.
pub trait BasisBackward: Token {
    /// The gradient of the coefficients `[rows, C]`: the sum over all (functions, gradient of their outputs).
    fn coefficient_gradient(parts: Vec<(FloatTensor<Self>, FloatTensor<Self>)>, rows: usize, shape: &BasisShape) -> FloatTensor<Self>;
    /// The gradient of the functions.
    fn function_gradient(coefficients: FloatTensor<Self>, shape: &BasisShape, grad: FloatTensor<Self>) -> FloatTensor<Self>;
}

/// The operations per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait BasisOps: Backend {
    /// Coefficients `[M, C]` as they are; their gradient is computed once all combinations have theirs.
    fn coefficients(coefficients: FloatTensor<Self>, combinations: Arc<Combinations>) -> FloatTensor<Self>;
    /// Flat outputs, head after head, each `[M, outputs]`, of coefficients that [`BasisOps::coefficients`] returned and functions `[F]`; differentiable in
    /// both.
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, combinations: Arc<Combinations>, index: usize) -> FloatTensor<Self>;
}

impl<B: CpuBackend> BasisBackward for B {
    fn coefficient_gradient(parts: Vec<(FloatTensor<Self>, FloatTensor<Self>)>, rows: usize, shape: &BasisShape) -> FloatTensor<Self> {
        let values: Vec<_> = parts.iter().map(|(functions, grad)| (B::floats(functions), B::floats(grad))).collect();
        let slices: Vec<(&[f32], &[f32])> = values.iter().map(|(functions, grad)| (&**functions, &**grad)).collect();
        B::from_floats(kernel::coefficient_gradient(shape, rows, &slices), [rows, shape.coefficients()])
    }
    fn function_gradient(coefficients: FloatTensor<Self>, shape: &BasisShape, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        B::from_floats(kernel::function_gradient(shape, &B::floats(&coefficients), &B::floats(&grad)), [shape.functions()])
    }
}

impl<B: CpuBackend> BasisOps for B {
    fn coefficients(coefficients: FloatTensor<Self>, _: Arc<Combinations>) -> FloatTensor<Self> {
        coefficients
    }
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, combinations: Arc<Combinations>, _: usize) -> FloatTensor<Self> {
        let (rows, functions, shape) = (combinations.rows, Self::floats(&functions), &combinations.shape);
        let out = match Self::columns(&coefficients) {
            Some(columns) => kernel::combine(shape, rows, &Coefficients::Columns(columns), &functions),
            None => kernel::combine(shape, rows, &Coefficients::Heads(&Self::floats(&coefficients)), &functions),
        };
        let len = out.len();
        Self::from_floats(out, [len])
    }
}

#[derive(Debug)]
struct Combine;

impl<B: BasisBackward> Backward<B, 2> for Combine {
    type State = (FloatTensor<B>, FloatTensor<B>, Arc<Combinations>, usize);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 2>(ops, grads, |(coefficients, functions, combinations, index), upstream, wanted| {
            let of_functions = wanted[1].then(|| B::function_gradient(coefficients, &combinations.shape, upstream.clone()));
            let token = wanted[0].then(|| B::token(&upstream));
            combinations.gradients.leave(index, (functions, upstream));
            [token, of_functions]
        });
    }
}

impl<B: BasisBackward + BasisOps, C: CheckpointStrategy> BasisOps for Autodiff<B, C> {
    fn coefficients(coefficients: FloatTensor<Self>, combinations: Arc<Combinations>) -> FloatTensor<Self> {
        share::<B, C, _>(coefficients, combinations, |combinations| {
            let parts = combinations.gradients.take().into_iter().flatten().collect();
            B::coefficient_gradient(parts, combinations.rows, &combinations.shape)
        })
    }
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, combinations: Arc<Combinations>, index: usize) -> FloatTensor<Self> {
        let ((coefficients, first), (functions, second)) = (coefficients.into_parts(), functions.into_parts());
        record::<B, C, _, 2>(Combine, [first, second], |_| {
            let out = B::combine(coefficients.clone(), functions.clone(), combinations.clone(), index);
            (out, (coefficients, functions, combinations, index))
        })
    }
}

/// One output `[M, width]` per group of `coefficients` [M, [`BasisShape::coefficients`]] at the moment at which the functions are `functions` `[F]`.
///
/// In memory, coefficients are stored group after group, each `[M, width x functions]`, as [`super::field::mlp_relu_flat`] returns them. Stored
/// [`by_columns`] they are read faster, but have no gradient.
pub fn combine(coefficients: Tensor<2>, functions: Tensor<1>, shape: &Arc<BasisShape>) -> Result<Vec<Tensor<2>>> {
    Ok(combine_all(coefficients, vec![functions], shape)?.into_iter().flatten().collect())
}

/// The outputs of [`combine`] at several moments, in the order of `functions`. The gradient of the coefficients is computed once for all of them.
pub fn combine_all(coefficients: Tensor<2>, functions: Vec<Tensor<1>>, shape: &Arc<BasisShape>) -> Result<Vec<Vec<Tensor<2>>>> {
    let [rows, width] = coefficients.dims();
    for moment in &functions {
        let [count] = moment.dims();
        if rows == 0 || width != shape.coefficients() || count != shape.functions() || shape.groups.iter().any(|g| g.0 == 0 || g.1 == 0) {
            let problem = format!("coefficients have shape [{rows},{width}], there are {count} functions, {shape:?} is expected");
            return Err(Error::parameter("combination of functions", problem, "Give at least one row, as many coefficients and functions as the shape says"));
        }
    }
    let most = shape.coefficients().max(shape.outputs());
    check_binding(&coefficients.device(), "combination of functions", "Gaussians", rows, most * size_of::<f32>())?;
    let combinations = Arc::new(Combinations { shape: shape.clone(), rows, gradients: Shared::new(functions.len()) });
    let coefficients = <Dispatch as BasisOps>::coefficients(coefficients.into_dispatch(), combinations.clone());
    let at = |(index, moment): (usize, Tensor<1>)| {
        let flat = <Dispatch as BasisOps>::combine(coefficients.clone(), moment.into_dispatch(), combinations.clone(), index);
        split_heads(&Tensor::from_dispatch(flat), rows, &shape.widths())
    };
    Ok(functions.into_iter().enumerate().map(at).collect())
}

/// The same coefficients `[M, C]` column by column in memory, for playback.
pub fn by_columns(coefficients: Tensor<2>, shape: &BasisShape) -> Tensor<2> {
    let [m, c] = coefficients.dims();
    if m == 0 {
        return coefficients;
    }
    let widths: Vec<usize> = shape.groups.iter().map(|g| g.0 * g.1).collect();
    let heads = split_heads(&coefficients.reshape([m * c]), m, &widths);
    // Flattening a transposed view moves its elements.
    let columns = heads.into_iter().zip(widths).map(|(head, width)| head.transpose().reshape([m * width])).collect();
    Tensor::cat(columns, 0).reshape([c, m]).transpose()
}
