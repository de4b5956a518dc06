//! Nearest neighbours, for initial scales, for strain and for velocities.

use rayon::prelude::*;
use std::collections::HashMap;

/// A neighbour: its index, and its squared distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Index of the point; meaningless where `squared` is infinite.
    pub index: u32,
    /// Squared distance; infinite where there are fewer points.
    pub squared: f32,
}

/// Mean of the squared distances to the three nearest other points, per point (what 3DGS's simple-knn computes). Fewer than two points give 1.
pub fn mean_squared_distance_3nn(points: &[[f32; 3]]) -> Vec<f32> {
    let mean = |found: [Neighbour; 3]| {
        let (sum, count) = found.iter().filter(|n| n.squared.is_finite()).fold((0.0, 0), |(sum, count), n| (sum + n.squared, count + 1));
        if count > 0 { sum / count as f32 } else { 1.0 }
    };
    nearest(points).into_iter().map(mean).collect()
}

/// The `K` nearest other points of every point, nearest first. Exact: a uniform grid searched ring by ring.
pub fn nearest<const K: usize>(points: &[[f32; 3]]) -> Vec<[Neighbour; K]> {
    let n = points.len();
    let low: [f32; 3] = std::array::from_fn(|k| points.iter().map(|p| p[k]).fold(f32::INFINITY, f32::min));
    let high: [f32; 3] = std::array::from_fn(|k| points.iter().map(|p| p[k]).fold(f32::NEG_INFINITY, f32::max));
    let longest = (0..3).map(|k| high[k] - low[k]).fold(0.0f32, f32::max).max(1e-12);
    // About two points per occupied cell of a surface-like set; the clamp keeps keys small.
    let cells = ((n as f32 / 2.0).sqrt().ceil()).clamp(1.0, 512.0);
    let cell = longest / cells;
    let key = |p: &[f32; 3]| -> [i32; 3] { std::array::from_fn(|k| (((p[k] - low[k]) / cell) as i32).min(cells as i32 - 1)) };
    let mut grid: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
    for (i, p) in points.iter().enumerate() {
        grid.entry(key(p)).or_default().push(i as u32);
    }
    points
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            let home = key(p);
            let mut best = [Neighbour { index: 0, squared: f32::INFINITY }; K];
            for ring in 0..=(cells as i32) {
                // Everything nearer than (ring - 1) cells has been seen, because the point sits somewhere inside its own cell.
                let safe = (ring - 1).max(0) as f32 * cell;
                if ring > 0 && best[K - 1].squared <= safe * safe {
                    break;
                }
                for_ring(home, ring, |c| {
                    for &j in grid.get(&c).into_iter().flatten() {
                        if j as usize != i {
                            let q = &points[j as usize];
                            insert(&mut best, Neighbour { index: j, squared: (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum() });
                        }
                    }
                });
            }
            best
        })
        .collect()
}

fn insert<const K: usize>(best: &mut [Neighbour; K], found: Neighbour) {
    if found.squared < best[K - 1].squared {
        best[K - 1] = found;
        best.sort_by(|a, b| a.squared.total_cmp(&b.squared));
    }
}

fn for_ring(home: [i32; 3], ring: i32, mut visit: impl FnMut([i32; 3])) {
    for x in -ring..=ring {
        for y in -ring..=ring {
            let faces = x.abs() == ring || y.abs() == ring;
            let step = if faces || ring == 0 { 1 } else { 2 * ring };
            let mut z = -ring;
            while z <= ring {
                visit([home[0] + x, home[1] + y, home[2] + z]);
                z += step;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;
    use rand::Rng;

    #[test]
    fn matches_brute_force() {
        let mut rng = Seed::root(3).rng();
        for flat in [1.0f32, 0.001] {
            let points: Vec<[f32; 3]> = (0..300).map(|_| [rng.random::<f32>(), rng.random::<f32>(), flat * rng.random::<f32>()]).collect();
            let fast = mean_squared_distance_3nn(&points);
            for (i, p) in points.iter().enumerate() {
                let mut d: Vec<f32> = points.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, q)| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum()).collect();
                d.sort_by(f32::total_cmp);
                assert!((fast[i] - (d[0] + d[1] + d[2]) / 3.0).abs() < 1e-6);
            }
        }
        let few = nearest::<6>(&[[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])[0];
        assert_eq!(few.map(|n| n.squared)[..3], [1.0, 9.0, f32::INFINITY]);
        assert_eq!(mean_squared_distance_3nn(&[[1.0; 3]]), vec![1.0]);
        assert_eq!(mean_squared_distance_3nn(&[[1.0; 3]; 5]), vec![0.0; 5]);
    }
}
