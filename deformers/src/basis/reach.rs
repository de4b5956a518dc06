//! How far the combinations can go: a function's largest value times a coefficient's size, added up. Free once coefficients are known.

use super::{CdfBasis, Head};
use burn::tensor::{Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Reach, Result};

/// Times at which learned functions are looked at for their largest values.
const TIMES: usize = 257;
/// What a learned function may have between those times over what it has there.
const BETWEEN: f32 = 1.1;

/// Bounds for Gaussians with these coefficients [M, C].
pub(super) fn reach(field: &CdfBasis, coefficients: Tensor<2>) -> Result<Reach> {
    let device = coefficients.device();
    let maxima = maxima(field, &coefficients)?;
    let [m, _] = coefficients.dims();
    let mut reach = Reach { displacements: Tensor::zeros([m], &device), growths: Tensor::zeros([m], &device) };
    let mut column = 0;
    for ((&head, kept), &(width, own)) in field.settings.heads.iter().zip(&field.kept).zip(&field.shape.groups) {
        if matches!(head, Head::Means | Head::LogScales) {
            let largest: Vec<f32> = kept.iter().map(|&f| maxima[f]).collect();
            let largest = Tensor::<3>::from_data(TensorData::new(largest, [1, 1, own]), &device);
            let sizes = coefficients.clone().narrow(1, column, width * own).reshape([m, width, own]).abs() * largest;
            let bounds: Tensor<2> = sizes.sum_dim(2).reshape([m, width]);
            match head {
                Head::Means => reach.displacements = bounds.powi_scalar(2).sum_dim(1).sqrt().reshape([m]),
                _ => reach.growths = bounds.max_dim(1).reshape([m]),
            }
        }
        column += width * own;
    }
    Ok(reach)
}

/// The largest size of every function over the sequence.
fn maxima(field: &CdfBasis, like: &Tensor<2>) -> Result<Vec<f32>> {
    let mut maxima = field.functions.known_maxima();
    let times: Vec<f32> = (0..TIMES).map(|i| i as f32 / (TIMES - 1) as f32).collect();
    let count = field.functions.count();
    let values = to_vec(field.functions_at(&times, &like.device())?.inner(), "functions")?;
    for k in maxima.len()..count {
        maxima.push(BETWEEN * values.iter().skip(k).step_by(count).fold(0.0f32, |most, v| most.max(v.abs())));
    }
    Ok(maxima)
}
