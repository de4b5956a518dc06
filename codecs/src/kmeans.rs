//! K-means with k-means++ seeding (Arthur and Vassilvitskii 2007) and Lloyd iterations, the same bytes for any number of threads.

use cc4dgs_format::Seed;
use rand::Rng;
use rayon::prelude::*;

/// Points per task. Sums are taken within a task and then over tasks in order, so the result does not depend on the number of threads.
const TASK: usize = 2048;
/// Numbers that the sums of tasks take together, unless one task per thread takes more: 128 MiB.
const SUMS: usize = 1 << 24;
/// Centres compared per SIMD block.
const LANES: usize = 16;

/// The nearest centre of each point.
#[derive(Clone, Debug, PartialEq)]
pub struct Assignment {
    /// Index of the nearest centre, the lowest on a tie `[N]`.
    pub labels: Vec<u32>,
    /// Squared distance to it `[N]`.
    pub distances: Vec<f32>,
    /// Sum of the squared distances.
    pub inertia: f64,
}

/// Centres `[K,width]` of `points` `[N,width]` after k-means++ seeding and at most `iterations` Lloyd iterations. K is `k`, or the number of
/// distinct points if that is smaller; no points give no centres.
pub fn cluster(points: &[f32], width: usize, k: usize, iterations: usize, seed: Seed) -> Vec<f32> {
    if points.is_empty() || width == 0 || k == 0 {
        return Vec::new();
    }
    let mut centers = plus_plus(points, width, k, seed);
    let mut labels = Vec::new();
    for _ in 0..iterations {
        let assignment = assign(points, width, &centers);
        if assignment.labels == labels {
            break;
        }
        centers = update(points, width, &assignment, &centers);
        labels = assignment.labels;
    }
    centers
}

/// The nearest of `centers` `[K,width]`, K at least 1, for each of `points` `[N,width]`.
pub fn assign(points: &[f32], width: usize, centers: &[f32]) -> Assignment {
    let k = centers.len() / width;
    // Blocks of LANES centres, one dimension after the other. Padding centres are infinitely far away.
    let mut blocks = vec![[f32::INFINITY; LANES]; k.div_ceil(LANES) * width];
    for (i, center) in centers.chunks_exact(width).enumerate() {
        center.iter().enumerate().for_each(|(d, &v)| blocks[(i / LANES) * width + d][i % LANES] = v);
    }
    let nearest = |point: &[f32]| {
        let mut best = (f32::INFINITY, 0u32);
        for (b, block) in blocks.chunks_exact(width).enumerate() {
            let mut sums = [0.0f32; LANES];
            for (&x, lanes) in point.iter().zip(block) {
                for (sum, &c) in sums.iter_mut().zip(lanes) {
                    *sum += (x - c) * (x - c);
                }
            }
            for (lane, &sum) in sums.iter().enumerate() {
                if sum < best.0 {
                    best = (sum, (b * LANES + lane) as u32);
                }
            }
        }
        best
    };
    let (distances, labels): (Vec<f32>, Vec<u32>) = points.par_chunks_exact(width).with_min_len(64).map(nearest).unzip();
    let inertia = ordered_sum(&distances);
    Assignment { labels, distances, inertia }
}

/// One Lloyd update: the mean of each centre's points. A centre without points moves to the point farthest from its own.
pub fn update(points: &[f32], width: usize, assignment: &Assignment, centers: &[f32]) -> Vec<f32> {
    let k = centers.len() / width;
    let task = |(points, labels): (&[f32], &[u32])| {
        let (mut sums, mut counts) = (vec![0.0f64; k * width], vec![0u64; k]);
        for (point, &label) in points.chunks_exact(width).zip(labels) {
            let at = label as usize * width;
            counts[label as usize] += 1;
            sums[at..at + width].iter_mut().zip(point).for_each(|(s, &x)| *s += f64::from(x));
        }
        (sums, counts)
    };
    let (mut sums, mut counts) = (vec![0.0f64; k * width], vec![0u64; k]);
    // A task has sums of all centres, so only some tasks run before they are added up. The order of the additions does not depend on how many.
    let rows = TASK * tasks_at_once(k * width).min(assignment.labels.len().div_ceil(TASK)).max(1);
    for (points, labels) in points.chunks(rows * width).zip(assignment.labels.chunks(rows)) {
        let partial: Vec<(Vec<f64>, Vec<u64>)> = points.par_chunks(TASK * width).zip(labels.par_chunks(TASK)).map(&task).collect();
        for (s, c) in &partial {
            sums.iter_mut().zip(s).for_each(|(a, b)| *a += b);
            counts.iter_mut().zip(c).for_each(|(a, b)| *a += b);
        }
    }
    let mut taken: Vec<usize> = Vec::new();
    let mut out = centers.to_vec();
    for (j, center) in out.chunks_exact_mut(width).enumerate() {
        if counts[j] > 0 {
            center.iter_mut().zip(&sums[j * width..]).for_each(|(c, s)| *c = (s / counts[j] as f64) as f32);
            continue;
        }
        let free = (0..assignment.distances.len()).filter(|i| assignment.distances[*i] > 0.0 && !taken.contains(i));
        if let Some(far) = free.max_by(|&a, &b| assignment.distances[a].total_cmp(&assignment.distances[b]).then(b.cmp(&a))) {
            taken.push(far);
            center.copy_from_slice(&points[far * width..(far + 1) * width]);
        }
    }
    out
}

/// How many tasks of [`update`] run before their sums, so many numbers each, are added up.
fn tasks_at_once(numbers: usize) -> usize {
    rayon::current_num_threads().max(SUMS / numbers.max(1))
}

/// k-means++: each next centre is a point drawn with probability proportional to its squared distance from the centres so far.
fn plus_plus(points: &[f32], width: usize, k: usize, seed: Seed) -> Vec<f32> {
    let n = points.len() / width;
    let mut rng = seed.rng();
    let mut chosen = rng.random_range(0..n);
    let mut centers = Vec::with_capacity(k.min(n) * width);
    let mut nearest = vec![f32::INFINITY; n];
    loop {
        let center = points[chosen * width..(chosen + 1) * width].to_vec();
        nearest.par_iter_mut().zip(points.par_chunks_exact(width)).with_min_len(TASK).for_each(|(best, point)| {
            *best = best.min(squared_distance(point, &center));
        });
        centers.extend(center);
        let total = ordered_sum(&nearest);
        if centers.len() / width >= k || total <= 0.0 || !total.is_finite() {
            return centers;
        }
        let mut left = rng.random::<f64>() * total;
        // Rounding may leave a remainder at the end; then the last point that is not yet a centre is drawn.
        let fallback = nearest.iter().rposition(|&d| d > 0.0).unwrap_or(0);
        chosen = nearest
            .iter()
            .position(|&d| {
                left -= f64::from(d);
                left < 0.0
            })
            .unwrap_or(fallback);
    }
}

fn squared_distance(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 8];
    let (wide_a, wide_b) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = wide_a.remainder().iter().zip(wide_b.remainder()).map(|(x, y)| (x - y) * (x - y)).sum();
    for (x, y) in wide_a.zip(wide_b) {
        for ((lane, x), y) in lanes.iter_mut().zip(x).zip(y) {
            *lane += (x - y) * (x - y);
        }
    }
    rest + lanes.iter().sum::<f32>()
}

/// A float64 sum whose order does not depend on threads.
fn ordered_sum(values: &[f32]) -> f64 {
    let units: Vec<f64> = values.par_chunks(TASK).map(|c| c.iter().map(|&v| f64::from(v)).sum()).collect();
    units.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_distinct_points_give_few_centres() {
        let points = [1.0, 2.0, 1.0, 2.0, 5.0, 6.0, 5.0, 6.0];
        let centers = cluster(&points, 2, 256, 25, Seed::root(3));
        assert_eq!(centers.len(), 4);
        assert_eq!(assign(&points, 2, &centers).inertia, 0.0);
        assert!(cluster(&[], 2, 4, 5, Seed::root(3)).is_empty());
    }

    #[test]
    fn an_empty_centre_moves_to_the_farthest_point() {
        let points = [0.0, 0.1, 10.0];
        let centers = [0.05, 100.0];
        let a = assign(&points, 1, &centers);
        assert_eq!(a.labels, [0, 0, 0]);
        assert_eq!(update(&points, 1, &a, &centers)[1], 10.0);
    }
}
