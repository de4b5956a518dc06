//! Strain: neighbouring Gaussians should keep their distance while they move. Normalised by the canonical distance, as in "Incoherent Deformation" (arXiv
//! 2604.16747), where the plain difference of distances gained nothing. Rotations and translations cost nothing. Unlike there, the penalty is bounded: with
//! squares alone, two things that are neighbours in the canonical space and part later held each other.

use crate::knn::nearest;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::ordered_sum;
use rayon::prelude::*;
use std::sync::Arc;

/// Neighbours further apart than this multiple of the median distance say nothing of each other.
const FAR: f32 = 4.0;
/// Added to squared distances over the canonical ones: the root has no gradient at 0.
const LEAST: f32 = 1e-8;

/// Neighbours of one Gaussian at most; those nearest to each other count first. Three are looked for, and each may be found by others.
const MOST: usize = 8;

/// Neighbouring moving Gaussians.
#[derive(Clone, Debug)]
pub struct Neighbours {
    /// The canonical centres they were found by `[3 M]`.
    means: Arc<Vec<f32>>,
    /// `None` where no pair is near enough.
    lists: Option<Lists>,
}

/// The neighbours of each of M Gaussians, `most` of them; whoever has fewer has itself instead, with a weight of 0. Everybody is among the neighbours of its
/// neighbours, so that the gradient of a Gaussian is a sum over its own list: nothing is scattered, which burn does with one thread per column on graphics
/// cards.
#[derive(Clone, Debug)]
struct Lists {
    most: usize,
    /// Rows of the neighbours `[M most]`.
    rows: Tensor<1, Int>,
    /// From the neighbour to the Gaussian, in the canonical space, over their distance `[M,most,3]`.
    directions: Tensor<3>,
    /// One over their distance `[M,most,1]`.
    inverse: Tensor<3>,
    /// 2 where both are among the three nearest of the other, else 1, over the sum of the weights of all pairs `[M,most,1]`.
    weights: Tensor<3>,
    /// Twice the weights over the distances `[M,most,1]`.
    slopes: Tensor<3>,
}

/// Pairs of neighbours (i, j, their distance, 1 or 2), nearest first, with i < j; see [`Neighbours::of`].
fn pairs(points: &[[f32; 3]]) -> Vec<(usize, usize, f32, f32)> {
    let mut pairs: Vec<(usize, usize, f32, f32)> = nearest::<3>(points)
        .par_iter()
        .enumerate()
        .flat_map_iter(|(i, found)| found.iter().map(move |n| (i, n.index as usize, n.squared.sqrt())))
        .filter(|(_, _, distance)| distance.is_finite() && *distance > 0.0)
        .map(|(i, j, distance)| (i.min(j), i.max(j), distance, 1.0))
        .collect();
    let mut distances: Vec<f32> = pairs.iter().map(|pair| pair.2).collect();
    let half = distances.len() / 2;
    let most = if distances.is_empty() { 0.0 } else { FAR * *distances.select_nth_unstable_by(half, f32::total_cmp).1 };
    pairs.retain(|pair| pair.2 <= most);
    pairs.par_sort_unstable_by(|a, b| a.2.total_cmp(&b.2).then((a.0, a.1).cmp(&(b.0, b.1))));
    // Found from both sides.
    pairs.dedup_by(|later, kept| {
        let same = (later.0, later.1) == (kept.0, kept.1);
        kept.3 += if same { later.3 } else { 0.0 };
        same
    });
    pairs
}

impl Lists {
    /// See [`Neighbours::of`].
    fn of(means: &[f32], device: &Device) -> Option<Self> {
        let points: Vec<[f32; 3]> = means.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        if points.len() < 2 || points.iter().flatten().any(|v| !v.is_finite()) {
            return None;
        }
        let mut lists: Vec<[(usize, f32, f32); MOST]> = (0..points.len()).map(|i| [(i, f32::INFINITY, 0.0); MOST]).collect();
        let mut lengths = vec![0; points.len()];
        let mut total = 0.0f32;
        for (i, j, distance, weight) in pairs(&points) {
            if lengths[i] < MOST && lengths[j] < MOST {
                lists[i][lengths[i]] = (j, distance, weight);
                lists[j][lengths[j]] = (i, distance, weight);
                (lengths[i], lengths[j]) = (lengths[i] + 1, lengths[j] + 1);
                total += weight;
            }
        }
        let most = lengths.into_iter().max().filter(|&most| most > 0)?;
        let count = most * points.len();
        // In parallel: (Gaussian, neighbour, distance, weight) of every slot, in order.
        let slots = || lists.par_iter().enumerate().flat_map_iter(|(i, list)| list[..most].iter().map(move |&(j, distance, weight)| (i, j, distance, weight)));
        let rows: Vec<i64> = slots().map(|(_, j, _, _)| j as i64).collect();
        let direction = |(i, j, distance, weight): (usize, usize, f32, f32)| (0..3usize).map(move |k| (k, i, j, distance, weight));
        let component = |(k, i, j, distance, weight): (usize, usize, usize, f32, f32)| match weight > 0.0 {
            true => (points[i][k] - points[j][k]) / distance,
            // Of length 1 where there is no neighbour, as if neither had moved.
            false => f32::from(u8::from(k == 0)),
        };
        let directions: Vec<f32> = slots().flat_map_iter(direction).map(component).collect();
        let inverse: Vec<f32> = slots().map(|(_, _, distance, _)| 1.0 / distance).collect();
        let weights: Vec<f32> = slots().map(|(_, _, _, weight)| weight / total).collect();
        let array = |values: Vec<f32>, width: usize| Tensor::<3>::from_data(TensorData::new(values, [points.len(), most, width]), device);
        let (inverse, weights) = (array(inverse, 1), array(weights, 1));
        Some(Self {
            most,
            rows: Tensor::from_data(TensorData::new(rows, [count]), device),
            directions: array(directions, 3),
            slopes: (weights.clone() * inverse.clone()).mul_scalar(2.0),
            inverse,
            weights,
        })
    }
}

impl Neighbours {
    /// The three nearest neighbours of every Gaussian of `means` `[3 M]`.
    pub fn of(means: &[f32], device: &Device) -> Self {
        Self { means: Arc::new(means.to_vec()), lists: Lists::of(means, device) }
    }
    /// The canonical centres they were found by `[3 M]`, for checkpoints: centres have moved since.
    pub fn means(&self) -> &[f32] {
        &self.means
    }
    /// Mean over the pairs of s^2 / (1 + s^2), with the change s of their distance as a share of the canonical one: squared where it is small, bounded where
    /// neighbours belong to things that part (Geman and McClure's function). `offsets` are those of the centres `[M,3]`. `None` without pairs.
    pub fn strain(&self, offsets: Tensor<2>) -> Option<Tensor<1>> {
        let Lists { most, rows, directions, inverse, weights, slopes } = self.lists.as_ref()?;
        let own = offsets.clone().inner();
        let count = own.dims()[0];
        // Value and gradient are computed outside of the graph: with it there are half as many passes again over all pairs.
        let others = own.clone().select(0, rows.clone()).reshape([count, *most, 3]);
        let apart = (own.reshape([count, 1, 3]) - others) * inverse.clone() + directions.clone();
        let length = (apart.clone() * apart.clone()).sum_dim(2).add_scalar(LEAST).sqrt();
        let stretch = length.clone().sub_scalar(1.0);
        let squares = stretch.clone() * stretch.clone();
        let bound = squares.clone().add_scalar(1.0);
        // Each pair is in two lists.
        let value = ordered_sum(squares / bound.clone() * weights.clone()).mul_scalar(0.5);
        // In its own list a Gaussian has its whole gradient.
        let slope = stretch / (bound.clone() * bound * length) * slopes.clone();
        let gradient = (apart * slope).sum_dim(1).reshape([count, 3]);
        // What has this gradient, and then this value.
        let linear = ordered_sum(offsets * Tensor::from_inner(gradient));
        let missing = value - linear.clone().inner();
        Some(linear + Tensor::from_inner(missing))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::gaussians::to_vec;

    #[test]
    fn rigid_motion_costs_nothing_and_stretching_what_it_stretches() {
        for name in ["flex", "ndarray", "wgpu"] {
            match cc4dgs_core::parse_device(name) {
                Ok(device) => costs_what_it_stretches(&device),
                Err(e) => assert!(name != "wgpu" || std::env::var_os("CC4DGS_REQUIRE_WGPU").is_none(), "{e}"),
            }
        }
    }

    fn costs_what_it_stretches(plain: &Device) {
        let device = plain.clone().autodiff();
        let means: Vec<f32> = (0..30).flat_map(|i| [(i % 5) as f32, (i / 5) as f32, 0.3 * (i % 3) as f32]).collect();
        let neighbours = Neighbours::of(&means, plain);
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
        // The gradient is that of the value, though each is computed by itself.
        let wiggle: Vec<f32> = (0..90).map(|k| 0.2 * (0.7 * k as f32).sin()).collect();
        let at = |values: &[f32]| neighbours.strain(Tensor::from_data(TensorData::new(values.to_vec(), [30, 3]), &device)).unwrap();
        let offsets = Tensor::<2>::from_data(TensorData::new(wiggle.clone(), [30, 3]), &device).require_grad();
        let gradient = to_vec(offsets.grad(&neighbours.strain(offsets.clone()).unwrap().backward()).unwrap(), "gradient").unwrap();
        for k in 0..90 {
            let moved = |by: f32| {
                let mut values = wiggle.clone();
                values[k] += by;
                to_vec(at(&values), "strain").unwrap()[0]
            };
            let expected = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            assert!((gradient[k] - expected).abs() < 2e-4, "{k}: {} {expected}", gradient[k]);
        }
        for lonely in [&[0.0; 3][..], &[0.0; 6], &[f32::NAN; 6]] {
            let neighbours = Neighbours::of(lonely, plain);
            assert_eq!(neighbours.means().len(), lonely.len());
            assert!(neighbours.strain(Tensor::zeros([lonely.len() / 3, 3], &device)).is_none());
        }
    }
}
