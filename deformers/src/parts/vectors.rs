//! Differences between the vectors of neighbouring Gaussians (Bae et al. 2024).

use super::neighbours::Pair;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_core::ordered_sum;

/// Added to squared differences: the root has no gradient at 0. As published.
const LEAST_SQUARE: f32 = 1e-20;

/// `weight` times the mean of sqrt(exp(-falloff d²) |z_i - z_j|² + 1e-20) over the `pairs` of i and j, with the vectors z `[M,F]`, at the distance d. `None`
/// without pairs.
///
/// Its gradient scatters, which burn does with one thread per column on graphics cards: for few pairs.
pub fn differences(vectors: &Tensor<2>, pairs: &[Pair], weight: f64, falloff: f64) -> Option<Tensor<1>> {
    let count = pairs.len();
    if count == 0 {
        return None;
    }
    let device = vectors.device();
    let select = |rows: Vec<i64>| vectors.clone().select(0, Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &device));
    let difference = select(pairs.iter().map(|pair| i64::from(pair.first)).collect()) - select(pairs.iter().map(|pair| i64::from(pair.second)).collect());
    let near: Vec<f32> = pairs.iter().map(|pair| nearness(pair, falloff)).collect();
    let near = Tensor::<2>::from_data(TensorData::new(near, [count, 1]), &device);
    let squares = (difference.clone() * difference).sum_dim(1) * near;
    Some(ordered_sum(squares.add_scalar(LEAST_SQUARE).sqrt()).mul_scalar(weight / count as f64))
}

/// What [`differences`] returns, for pairs of which no Gaussian is the first of two, nor the second of two, as
/// [`spread_pairs`](super::neighbours::spread_pairs) gives them. Its gradient gathers: for many pairs.
pub fn spread_differences(vectors: &Tensor<2>, pairs: &[Pair], weight: f64, falloff: f64) -> Option<Tensor<1>> {
    if pairs.is_empty() {
        return None;
    }
    let [m, _] = vectors.dims();
    // For every Gaussian as the first of a pair, and then for every one as the second: the other one and the nearness. Without a pair: itself and 0.
    let mut others: Vec<i64> = (0..m as i64).chain(0..m as i64).collect();
    let mut near = vec![0.0f32; 2 * m];
    for pair in pairs {
        let (first, second) = (pair.first as usize, m + pair.second as usize);
        (others[first], others[second]) = (i64::from(pair.second), i64::from(pair.first));
        near[first] = nearness(pair, falloff);
        near[second] = near[first];
    }
    let device = vectors.device();
    // Outside of the graph; a detached leaf would still be tracked.
    let others = Tensor::<1, Int>::from_data(TensorData::new(others, [2 * m]), &device.clone().without_autodiff());
    let others = vectors.clone().inner().select(0, others);
    let others = if device.is_autodiff() { Tensor::from_inner(others) } else { others };
    let near = Tensor::<2>::from_data(TensorData::new(near, [2 * m, 1]), &device);
    let difference = Tensor::cat(vec![vectors.clone(), vectors.clone()], 0) - others;
    let squares = (difference.clone() * difference).sum_dim(1) * near.clone();
    let terms = squares.add_scalar(LEAST_SQUARE).sqrt().mask_fill(near.equal_elem(0.0), 0.0);
    // Each pair counts twice, with the gradient by one of its vectors each time: the gradient is complete, the value twice what it should be.
    let twice = ordered_sum(terms).mul_scalar(weight / pairs.len() as f64);
    Some(twice.clone() - twice.detach().mul_scalar(0.5))
}

/// exp(-falloff d²) of a pair at the distance d.
fn nearness(pair: &Pair, falloff: f64) -> f32 {
    (-falloff * f64::from(pair.squared)).exp() as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;
    use cc4dgs_core::gaussians::to_vec;

    /// Value and gradient of a term of six Gaussians with two numbers each. Those of the last one are not finite.
    fn term(of: impl Fn(&Tensor<2>, &[Pair], f64, f64) -> Option<Tensor<1>>, pairs: &[Pair]) -> Option<(f32, Vec<f32>)> {
        let vectors = vec![0.1f32, 0.0, 0.4, 0.4, -0.3, 0.2, 0.9, -0.5, 0.0, 0.7, f32::NAN, f32::NAN];
        let vectors = Tensor::<2>::from_data(TensorData::new(vectors, [6, 2]), &Device::flex().autodiff()).require_grad();
        let term = of(&vectors, pairs, 0.8, 10.0)?;
        let gradient = vectors.grad(&term.backward()).unwrap();
        Some((to_vec(term, "term").unwrap()[0], to_vec(gradient, "gradient").unwrap()))
    }

    #[test]
    fn gathered_gradients_are_those_of_the_formula() {
        // Three are the first of one pair and the second of another; two are each other's.
        let pairs = [(0, 1, 0.01), (1, 2, 0.04), (2, 0, 0.09), (3, 4, 0.2), (4, 3, 0.2)].map(|(first, second, squared)| Pair { first, second, squared });
        for count in 1..=pairs.len() {
            let (wanted, slopes) = term(differences, &pairs[..count]).unwrap();
            let (found, gathered) = term(spread_differences, &pairs[..count]).unwrap();
            assert!((found - wanted).abs() < 1e-5 * wanted, "{count} pairs: {found}, {wanted}");
            assert!(gathered.iter().zip(&slopes).take(10).all(|(a, b)| (a - b).abs() < 1e-5), "{count} pairs: {gathered:?}, {slopes:?}");
        }
        assert!(term(differences, &[]).is_none() && term(spread_differences, &[]).is_none());
    }
}
