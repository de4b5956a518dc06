//! What keeps functions of time out of heads that do not need them: a group lasso over the columns of the heads' last layers.
//!
//! All weights of one function in one head form a group. Its pull towards zero is as strong for small weights as for large ones, so that a function whose
//! motion pictures do not ask for goes to zero for all Gaussians at once, and is left out after training (see [`super::simplify`]). Fourier bands pay in
//! proportion to their frequency: with free fast bands, each training time is learned by itself.

use super::CdfBasis;
use burn::tensor::{Tensor, TensorData};

/// Added to squared norms, so that a group of zeros has a derivative.
const LEAST_SQUARED_NORM: f32 = 1e-12;

/// Half diagonals are not taken for shorter than this, world units.
const LEAST_SCALE: f32 = 1e-6;

/// The sum over heads and functions of price times norm, times `weight`. Norms of centres count in half diagonals of the box, so that a scene's unit does not
/// matter.
pub(super) fn group_lasso(field: &CdfBasis, weight: f32) -> Option<Tensor<1>> {
    let prices = field.functions.prices();
    let width = field.coefficients.trunk.last().copied()?;
    let first = field.parameters.len() - field.settings.heads.len();
    let mut total: Option<Tensor<1>> = None;
    let heads = field.settings.heads.iter().zip(&field.shape.groups).zip(&field.kept);
    for (parameter, ((&head, &(outputs, own)), kept)) in field.parameters[first..].iter().zip(heads) {
        // A box without extent has nothing to move in; its price stays finite.
        let weight = weight / (field.scale_of(head) as f32).max(LEAST_SCALE);
        let last = parameter.value.clone().narrow(0, width * (width + 1), (width + 1) * outputs * own).reshape([(width + 1) * outputs, own]);
        let norms = (last.clone() * last).sum_dim(0).add_scalar(LEAST_SQUARED_NORM).sqrt().flatten(0, 1);
        let price: Vec<f32> = kept.iter().map(|&f| weight * prices[f]).collect();
        let term = (norms * Tensor::<1>::from_data(TensorData::new(price, [own]), &parameter.value.device())).sum();
        total = Some(match total {
            Some(sum) => sum + term,
            None => term,
        });
    }
    total
}
