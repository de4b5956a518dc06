//! Nearest neighbours by a k-d tree, for initial scales, for strain, for velocities, and for parents of Gaussians that the trainer adds.

use rayon::prelude::*;

/// The most points of a leaf.
const LEAF: usize = 8;
/// Nodes with at least twice as many points are split by two threads.
const PARALLEL: usize = 1024;
/// Capacity of a query's stack: it grows by at most one node per level, and 2³² points have 30 levels.
const STACK: usize = 32;

/// A neighbour: its index, and its squared distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Index of the point; meaningless where `squared` is infinite.
    pub index: u32,
    /// Squared distance; infinite where there are fewer points.
    pub squared: f32,
}

impl Neighbour {
    const NONE: Self = Self { index: 0, squared: f32::INFINITY };
    /// Whether it is nearer than `other`, or as near with a lower index.
    fn is_before(self, other: Self) -> bool {
        self.squared < other.squared || (self.squared == other.squared && self.index < other.index)
    }
}

/// Mean of the squared distances to the three nearest other points, per point (what 3DGS's simple-knn computes). Fewer than two points give 1.
pub fn mean_squared_distance_3nn(points: &[[f32; 3]]) -> Vec<f32> {
    let mean = |found: [Neighbour; 3]| {
        let (sum, count) = found.iter().filter(|n| n.squared.is_finite()).fold((0.0, 0), |(sum, count), n| (sum + n.squared, count + 1));
        if count > 0 { sum / count as f32 } else { 1.0 }
    };
    nearest(points).into_iter().map(mean).collect()
}

/// The `K` nearest other points of every point, nearest first, ties by index. Exact. A point that is not finite has no neighbours and is no neighbour.
pub fn nearest<const K: usize>(points: &[[f32; 3]]) -> Vec<[Neighbour; K]> {
    let tree = KdTree::new(points);
    points.par_iter().enumerate().map(|(i, p)| tree.nearest(p, Some(i as u32))).collect()
}

/// A k-d tree of the finite points of a set.
///
/// A node is split at the median along the longest side of its box; ties are split by index. The depth is logarithmic for every distribution, duplicates
/// included.
pub(crate) struct KdTree {
    /// The points; those of a node are contiguous.
    points: Vec<Point>,
    /// In pre-order: the first child follows its parent.
    nodes: Vec<Node>,
}

#[derive(Clone, Copy)]
struct Point {
    position: [f32; 3],
    index: u32,
}

struct Node {
    /// The box of its points.
    low: [f32; 3],
    high: [f32; 3],
    /// The lowest index of its points.
    least: u32,
    /// Range of its points.
    start: usize,
    end: usize,
    /// Index of its second child; `None` in a leaf.
    second: Option<usize>,
}

impl Node {
    /// A lower bound of the neighbours of `point` in the node, by distance to its box and by index. Also after rounding: rounded operations are monotonic.
    fn bound(&self, point: &[f32; 3]) -> Neighbour {
        let outside = std::array::from_fn(|k| (self.low[k] - point[k]).max(point[k] - self.high[k]).max(0.0));
        Neighbour { index: self.least, squared: squared_length(outside) }
    }
}

impl KdTree {
    /// The tree of `points`; neighbours are indices into them.
    pub fn new(points: &[[f32; 3]]) -> Self {
        let all = points.iter().enumerate().map(|(i, &position)| Point { position, index: i as u32 });
        let points: Vec<Point> = all.filter(|p| is_finite(&p.position)).collect();
        let count = points.len();
        let mut tree = Self { points, nodes: Vec::new() };
        if count > 0 {
            add_nodes(&mut tree.points, 0, &mut tree.nodes);
        }
        tree
    }
    /// The `K` points nearest to `point`, nearest first, ties by index. The point with the index `except` is left out.
    pub fn nearest<const K: usize>(&self, point: &[f32; 3], except: Option<u32>) -> [Neighbour; K] {
        self.search(point, except).0
    }
    /// What [`KdTree::nearest`] returns, and the number of points that were compared.
    fn search<const K: usize>(&self, point: &[f32; 3], except: Option<u32>) -> ([Neighbour; K], usize) {
        let (mut best, mut compared) = ([Neighbour::NONE; K], 0);
        let mut stack: Vec<(usize, Neighbour)> = Vec::with_capacity(STACK);
        if is_finite(point) {
            stack.extend(self.nodes.first().map(|root| (0, root.bound(point))));
        }
        while let Some((at, bound)) = stack.pop() {
            // The bound has an index, so that most of many duplicates are skipped.
            if !bound.is_before(best[K - 1]) {
                continue;
            }
            let node = &self.nodes[at];
            let Some(second) = node.second else {
                for other in self.points[node.start..node.end].iter().filter(|other| Some(other.index) != except) {
                    let difference = std::array::from_fn(|k| point[k] - other.position[k]);
                    insert(&mut best, Neighbour { index: other.index, squared: squared_length(difference) });
                }
                compared += node.end - node.start;
                continue;
            };
            let [a, b] = [at + 1, second].map(|child| (child, self.nodes[child].bound(point)));
            // The nearer one last: it is popped first.
            stack.extend(if a.1.is_before(b.1) { [b, a] } else { [a, b] });
        }
        (best, compared)
    }
}

/// Adds the node of `own`, the points from `start` on, and those below it, in pre-order; sorts the points. Indices of nodes count in `nodes`.
fn add_nodes(own: &mut [Point], start: usize, nodes: &mut Vec<Node>) {
    let low: [f32; 3] = std::array::from_fn(|k| own.iter().map(|p| p.position[k]).fold(f32::INFINITY, f32::min));
    let high: [f32; 3] = std::array::from_fn(|k| own.iter().map(|p| p.position[k]).fold(f32::NEG_INFINITY, f32::max));
    let least = own.iter().map(|p| p.index).fold(u32::MAX, u32::min);
    let node = nodes.len();
    nodes.push(Node { low, high, least, start, end: start + own.len(), second: None });
    if own.len() <= LEAF {
        return;
    }
    let side = |k: usize| high[k] - low[k];
    let axis = (1..3).fold(0, |longest, k| if side(k) > side(longest) { k } else { longest });
    let half = own.len() / 2;
    own.select_nth_unstable_by(half, |a, b| a.position[axis].total_cmp(&b.position[axis]).then(a.index.cmp(&b.index)));
    let (first, second) = own.split_at_mut(half);
    if half < PARALLEL {
        add_nodes(first, start, nodes);
        nodes[node].second = Some(nodes.len());
        add_nodes(second, start + half, nodes);
        return;
    }
    let mut others = Vec::new();
    rayon::join(|| add_nodes(first, start, nodes), || add_nodes(second, start + half, &mut others));
    let shift = nodes.len();
    nodes[node].second = Some(shift);
    nodes.extend(others.into_iter().map(|node| Node { second: node.second.map(|second| shift + second), ..node }));
}

fn is_finite(point: &[f32; 3]) -> bool {
    point.iter().all(|v| v.is_finite())
}

fn squared_length([x, y, z]: [f32; 3]) -> f32 {
    x * x + y * y + z * z
}

fn insert<const K: usize>(best: &mut [Neighbour; K], found: Neighbour) {
    let mut at = K;
    while at > 0 && found.is_before(best[at - 1]) {
        at -= 1;
    }
    if at < K {
        best[at..].rotate_right(1);
        best[at] = found;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;
    use rand::Rng;

    /// Point sets by name, each of about `count` points.
    fn distributions(count: usize) -> Vec<(&'static str, Vec<[f32; 3]>)> {
        let mut rng = Seed::root(3).rng();
        let mut random = |scale: [f32; 3]| -> Vec<[f32; 3]> { (0..count).map(|_| scale.map(|s| s * (rng.random::<f32>() - 0.5))).collect() };
        let uniform = random([1.0; 3]);
        let mut outlier = uniform.clone();
        outlier[count / 2] = [1e6, -1e6, 1e6];
        let far_apart = |(i, p): (usize, &[f32; 3])| -> [f32; 3] { std::array::from_fn(|k| 1e3 * ((i * (k + 3)) % 5) as f32 + 1e-3 * p[k]) };
        let side = (count as f64).cbrt().ceil() as usize;
        vec![
            ("flat", random([1.0, 1.0, 0.001])),
            ("on a line", random([0.0, 1.0, 0.0])),
            ("clustered", uniform.iter().enumerate().map(far_apart).collect()),
            ("one far outlier", outlier),
            ("all identical", vec![[0.3, -0.2, 7.0]; count]),
            ("two positions", (0..count).map(|i| [(i % 2) as f32, 0.0, 0.0]).collect()),
            ("a cubic grid", (0..count).map(|i| [i % side, i / side % side, i / side / side].map(|v| v as f32)).collect()),
            ("halvings", (0..count).map(|i| [0.5f32.powi((i % 120) as i32), 0.0, 0.0]).collect()),
            ("uniform", uniform),
        ]
    }

    /// All others by distance, then by index.
    fn brute_force<const K: usize>(points: &[[f32; 3]]) -> Vec<[Neighbour; K]> {
        let of = |i: usize| -> [Neighbour; K] {
            let to = |j: usize| Neighbour { index: j as u32, squared: (0..3).map(|k| (points[i][k] - points[j][k]) * (points[i][k] - points[j][k])).sum() };
            let mut all: Vec<Neighbour> = (0..points.len()).filter(|&j| j != i).map(to).filter(|n| n.squared.is_finite()).collect();
            all.sort_by(|a, b| a.squared.total_cmp(&b.squared).then(a.index.cmp(&b.index)));
            std::array::from_fn(|k| all.get(k).copied().unwrap_or(Neighbour::NONE))
        };
        (0..points.len()).map(of).collect()
    }

    #[test]
    fn matches_brute_force() {
        for (name, points) in distributions(400).into_iter().chain(distributions(5)) {
            assert_eq!(nearest::<6>(&points), brute_force::<6>(&points), "{name}, {} points", points.len());
            assert_eq!(nearest::<1>(&points), brute_force::<1>(&points), "{name}, {} points", points.len());
        }
        let few = nearest::<6>(&[[0.0; 3], [1.0, 0.0, 0.0], [3.0, 0.0, 0.0]])[0];
        assert_eq!(few.map(|n| n.squared)[..3], [1.0, 9.0, f32::INFINITY]);
        // So many that threads share the tree.
        let many = distributions(3 * PARALLEL).pop().unwrap().1;
        assert_eq!(nearest::<3>(&many), brute_force::<3>(&many));
        assert!(nearest::<3>(&[]).is_empty());
        assert_eq!(mean_squared_distance_3nn(&[[1.0; 3]]), vec![1.0]);
        assert_eq!(mean_squared_distance_3nn(&[[1.0; 3]; 5]), vec![0.0; 5]);
    }

    #[test]
    fn a_query_compares_few_points_in_any_distribution() {
        const COUNT: usize = 20_000;
        for (name, points) in distributions(COUNT) {
            let tree = KdTree::new(&points);
            let compared: usize = (0..COUNT).step_by(7).map(|i| tree.search::<6>(&points[i], Some(i as u32)).1).sum();
            let mean = compared / COUNT.div_ceil(7);
            assert!(mean < 400, "{name}: {mean} of {COUNT} points per query");
        }
    }

    #[test]
    fn points_that_are_not_finite_have_no_neighbours_and_are_none() {
        let mut points = distributions(60).swap_remove(0).1;
        for (row, value) in [(3, f32::NAN), (20, f32::INFINITY), (40, f32::NEG_INFINITY)] {
            points[row][row % 3] = value;
        }
        // Its squared distance to the others is over the range of float32.
        points[50] = [3e38; 3];
        let found = nearest::<4>(&points);
        assert_eq!(found, brute_force::<4>(&points));
        assert!([3, 20, 40, 50].iter().all(|&row| found[row] == [Neighbour::NONE; 4]));
        assert!(nearest::<2>(&[[f32::NAN; 3]; 20]).iter().all(|found| *found == [Neighbour::NONE; 2]));
    }

    #[test]
    fn any_place_has_a_nearest_point() {
        let points: Vec<[f32; 3]> = (0..100).map(|i| [i as f32, 0.0, 0.0]).collect();
        let tree = KdTree::new(&points);
        let nearest = |x: f32| tree.nearest::<2>(&[x, 0.0, 0.0], None).map(|n| n.index);
        assert_eq!((nearest(41.4), nearest(41.5), nearest(-7.0), nearest(1e6)), ([41, 42], [41, 42], [0, 1], [99, 98]));
        assert_eq!(KdTree::new(&[]).nearest::<1>(&[0.0; 3], None), [Neighbour::NONE]);
    }
}
