//! Strain: neighbouring Gaussians should keep their distance while they move. Normalised by the canonical distance, as in "Incoherent Deformation"
//! (arXiv 2604.16747), where the plain difference of distances gained nothing. Rotations and translations cost nothing. Unlike there, the penalty is bounded: with
//! squares alone, two things that are neighbours in the canonical space and part later held each other.

use crate::knn::nearest;
use burn::tensor::{Device, Int, Tensor, TensorData};
use std::sync::Arc;

/// Neighbours further apart than this multiple of the median distance say nothing of each other.
const FAR: f32 = 4.0;
/// Least squared distance over the canonical one: the root has no gradient at 0.
const LEAST: f32 = 1e-8;

/// Neighbouring moving Gaussians.
#[derive(Clone, Debug)]
pub struct Neighbours {
    /// The canonical centres they were found by `[3 M]`.
    means: Arc<Vec<f32>>,
    /// `None` where no pair is near enough.
    pairs: Option<Pairs>,
}

/// Pairs of neighbours.
#[derive(Clone, Debug)]
struct Pairs {
    first: Tensor<1, Int>,
    second: Tensor<1, Int>,
    /// From the second to the first, in the canonical space, over their distance `[P,3]`.
    directions: Tensor<2>,
    /// One over their distance `[P,1]`.
    inverse: Tensor<2>,
}

impl Pairs {
    /// See [`Neighbours::of`].
    fn of(means: &[f32], device: &Device) -> Option<Self> {
        let points: Vec<[f32; 3]> = means.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        if points.len() < 2 || points.iter().flatten().any(|v| !v.is_finite()) {
            return None;
        }
        let pairs: Vec<(usize, usize, f32)> = nearest::<3>(&points)
            .iter()
            .enumerate()
            .flat_map(|(i, found)| found.iter().map(move |n| (i, n.index as usize, n.squared.sqrt())))
            .filter(|(_, _, distance)| distance.is_finite() && *distance > 0.0)
            .collect();
        let mut distances: Vec<f32> = pairs.iter().map(|pair| pair.2).collect();
        distances.sort_unstable_by(f32::total_cmp);
        let most = FAR * distances.get(distances.len() / 2)?;
        let near: Vec<&(usize, usize, f32)> = pairs.iter().filter(|pair| pair.2 <= most).collect();
        let count = near.len();
        let index = |pick: fn(&(usize, usize, f32)) -> usize| {
            let rows: Vec<i64> = near.iter().map(|pair| pick(pair) as i64).collect();
            Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), device)
        };
        let directions: Vec<f32> =
            near.iter().flat_map(|&&(i, j, d)| (0..3).map(move |k| (i, j, d, k))).map(|(i, j, d, k)| (points[i][k] - points[j][k]) / d).collect();
        let inverse: Vec<f32> = near.iter().map(|pair| 1.0 / pair.2).collect();
        Some(Self {
            first: index(|pair| pair.0),
            second: index(|pair| pair.1),
            directions: Tensor::from_data(TensorData::new(directions, [count, 3]), device),
            inverse: Tensor::from_data(TensorData::new(inverse, [count, 1]), device),
        })
    }
}

impl Neighbours {
    /// The three nearest neighbours of every Gaussian of `means` `[3 M]`.
    pub fn of(means: &[f32], device: &Device) -> Self {
        Self { means: Arc::new(means.to_vec()), pairs: Pairs::of(means, device) }
    }
    /// The canonical centres they were found by `[3 M]`, for checkpoints: centres have moved since.
    pub fn means(&self) -> &[f32] {
        &self.means
    }
    /// Mean over the pairs of s^2 / (1 + s^2), with the change s of their distance as a share of the canonical one: squared where it is small, bounded where neighbours
    /// belong to things that part (Geman and McClure's function). `offsets` are those of the centres `[M,3]`.
    /// `None` without pairs.
    pub fn strain(&self, offsets: Tensor<2>) -> Option<Tensor<1>> {
        let Pairs { first, second, directions, inverse } = self.pairs.as_ref()?;
        let difference = offsets.clone().select(0, first.clone()) - offsets.select(0, second.clone());
        let apart = Tensor::from_inner(directions.clone()) + difference * Tensor::from_inner(inverse.clone());
        let stretch = (apart.clone() * apart).sum_dim(1).clamp_min(LEAST).sqrt().sub_scalar(1.0);
        let squares = stretch.clone() * stretch;
        Some((squares.clone() / squares.add_scalar(1.0)).mean())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;

    #[test]
    fn rigid_motion_costs_nothing_and_stretching_what_it_stretches() {
        let device = Device::flex().autodiff();
        let means: Vec<f32> = (0..30).flat_map(|i| [(i % 5) as f32, (i / 5) as f32, 0.3 * (i % 3) as f32]).collect();
        let neighbours = Neighbours::of(&means, &Device::flex());
        let strain = |to: &dyn Fn([f32; 3]) -> [f32; 3]| {
            let offsets: Vec<f32> = means
                .chunks_exact(3)
                .flat_map(|p| {
                    let q = to([p[0], p[1], p[2]]);
                    [q[0] - p[0], q[1] - p[1], q[2] - p[2]]
                })
                .collect();
            let offsets = Tensor::<2>::from_data(TensorData::new(offsets, [30, 3]), &device);
            to_vec(neighbours.strain(offsets).unwrap(), "strain").unwrap()[0]
        };
        let (sin, cos) = 0.7f32.sin_cos();
        assert!(strain(&|[x, y, z]| [cos * x - sin * y + 4.0, sin * x + cos * y, z - 2.0]) < 1e-9);
        let stretched = strain(&|[x, y, z]| [1.1 * x, 1.1 * y, 1.1 * z]);
        assert!((stretched - 0.01 / 1.01).abs() < 1e-4, "{stretched}");
        let apart = strain(&|[x, y, z]| [100.0 * x, 100.0 * y, 100.0 * z]);
        assert!((0.99..=1.0).contains(&apart), "{apart}");
        for lonely in [&[0.0; 3][..], &[0.0; 6], &[f32::NAN; 6]] {
            let neighbours = Neighbours::of(lonely, &Device::flex());
            assert_eq!(neighbours.means().len(), lonely.len());
            assert!(neighbours.strain(Tensor::zeros([lonely.len() / 3, 3], &device)).is_none());
        }
    }
}
