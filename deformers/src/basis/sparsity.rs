//! Sparsity of functions of time: a group lasso over the columns of the heads' last layers.
//!
//! All weights of one function in one head form a group. The gradient of a group's norm does not shrink with the weights. So a function that the images do
//! not need goes to zero for all Gaussians at once, and is dropped after training (see [`super::simplify`]). The penalty of a Fourier band is proportional to
//! its frequency; with unpenalised high bands, the deformer fits each training time separately.

use super::Basis;
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::ordered_sum;

/// Added to squared norms, so that a group of zeros has a derivative.
const LEAST_SQUARED_NORM: f32 = 1e-12;

/// Lower bound on the half diagonal of the box, world units.
const LEAST_SCALE: f32 = 1e-6;

/// `weight` times the sum over heads and functions of penalty times norm. Norms of centres are in half diagonals of the box, so that the result does not depend
/// on the scene's unit of length.
pub(super) fn group_lasso(field: &Basis, weight: f32) -> Option<Tensor<1>> {
    let prices = field.functions.prices();
    let width = field.coefficients.trunk.last().copied()?;
    let hidden = width * (width + 1) * field.settings.head_layers;
    let first = field.parameters.len() - field.settings.heads.len();
    let mut total: Option<Tensor<1>> = None;
    let heads = field.settings.heads.iter().zip(&field.shape.groups).zip(&field.kept);
    for (parameter, ((&head, &(outputs, own)), kept)) in field.parameters[first..].iter().zip(heads) {
        // The lower bound keeps the penalty finite for a box without extent.
        let weight = weight / (field.scale_of(head) as f32).max(LEAST_SCALE);
        let last = parameter.value.clone().narrow(0, hidden, (width + 1) * outputs * own).reshape([(width + 1) * outputs, own]);
        let norms = (last.clone() * last).sum_dim(0).add_scalar(LEAST_SQUARED_NORM).sqrt().flatten::<1>(0, 1);
        let price: Vec<f32> = kept.iter().map(|&f| weight * prices[f]).collect();
        let term = ordered_sum(norms * Tensor::<1>::from_data(TensorData::new(price, [own]), &parameter.value.device()));
        total = Some(match total {
            Some(sum) => sum + term,
            None => term,
        });
    }
    total
}
