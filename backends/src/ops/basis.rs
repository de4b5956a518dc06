//! Offsets as combinations of shared functions of time: out = C φ, a dot product per number and Gaussian.

use super::field::split_heads;
use crate::cpu::basis::{self as kernel, Coefficients};
use crate::cpu::tensor::CpuBackend;
use crate::ops::autodiff::{differentiate, record};
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
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

/// The derivative per device.
pub trait BasisBackward: Backend {
    /// The gradients of coefficients and functions, as far as `wanted`.
    fn combine_backward(
        coefficients: FloatTensor<Self>,
        functions: FloatTensor<Self>,
        shape: &BasisShape,
        grad: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2];
}

/// The operation per device.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "cube"), Autodiff)]
pub trait BasisOps: Backend {
    /// Flat outputs, head after head, each `[M, outputs]`, of coefficients `[M, C]` and functions `[F]`; differentiable in both.
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, shape: Arc<BasisShape>) -> FloatTensor<Self>;
}

impl<B: CpuBackend> BasisBackward for B {
    fn combine_backward(
        coefficients: FloatTensor<Self>,
        functions: FloatTensor<Self>,
        shape: &BasisShape,
        grad: FloatTensor<Self>,
        wanted: [bool; 2],
    ) -> [Option<FloatTensor<Self>>; 2] {
        let (grad, rows) = (B::floats(&grad), coefficients.shape()[0]);
        [
            wanted[0].then(|| B::from_floats(kernel::coefficient_gradient(shape, &B::floats(&functions), &grad), [rows, shape.coefficients()])),
            wanted[1].then(|| B::from_floats(kernel::function_gradient(shape, &B::floats(&coefficients), &grad), [shape.functions()])),
        ]
    }
}

impl<B: CpuBackend> BasisOps for B {
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, shape: Arc<BasisShape>) -> FloatTensor<Self> {
        let (rows, functions) = (coefficients.shape()[0], Self::floats(&functions));
        let out = match Self::columns(&coefficients) {
            Some(columns) => kernel::combine(&shape, rows, &Coefficients::Columns(columns), &functions),
            None => kernel::combine(&shape, rows, &Coefficients::Heads(&Self::floats(&coefficients)), &functions),
        };
        let len = out.len();
        Self::from_floats(out, [len])
    }
}

#[derive(Debug)]
struct Combine;

impl<B: BasisBackward> Backward<B, 2> for Combine {
    type State = (FloatTensor<B>, FloatTensor<B>, Arc<BasisShape>);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _: &mut Checkpointer) {
        differentiate::<B, _, 2>(ops, grads, |(coefficients, functions, shape), upstream, wanted| {
            B::combine_backward(coefficients, functions, &shape, upstream, wanted)
        });
    }
}

impl<B: BasisBackward + BasisOps, C: CheckpointStrategy> BasisOps for Autodiff<B, C> {
    fn combine(coefficients: FloatTensor<Self>, functions: FloatTensor<Self>, shape: Arc<BasisShape>) -> FloatTensor<Self> {
        let ((coefficients, first), (functions, second)) = (coefficients.into_parts(), functions.into_parts());
        record::<B, C, _, 2>(Combine, [first, second], |_| {
            (B::combine(coefficients.clone(), functions.clone(), shape.clone()), (coefficients, functions, shape))
        })
    }
}

/// One output `[M, width]` per group of `coefficients` [M, [`BasisShape::coefficients`]] at the moment at which the functions are `functions` `[F]`.
///
/// In memory, coefficients are stored group after group, each `[M, width x functions]`, as [`super::field::mlp_relu_flat`] returns them. Stored
/// [`by_columns`] they are read faster, but have no gradient.
pub fn combine(coefficients: Tensor<2>, functions: Tensor<1>, shape: &Arc<BasisShape>) -> Result<Vec<Tensor<2>>> {
    let ([m, width], [count]) = (coefficients.dims(), functions.dims());
    if m == 0 || width != shape.coefficients() || count != shape.functions() || shape.groups.iter().any(|g| g.0 == 0 || g.1 == 0) {
        let problem = format!("coefficients have shape [{m},{width}], there are {count} functions, {shape:?} is expected");
        return Err(Error::parameter("combination of functions", problem, "Give at least one row, as many coefficients and functions as the shape says"));
    }
    let flat = Tensor::from_dispatch(<Dispatch as BasisOps>::combine(coefficients.into_dispatch(), functions.into_dispatch(), shape.clone()));
    Ok(split_heads(&flat, m, &shape.widths()))
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
