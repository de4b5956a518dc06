//! Random pairs of neighbouring points, drawn anew in each iteration of training.
//!
//! A tree of all points would have to be built again for each draw, because centres move. Random cuts lead to patches of neighbouring points instead, and only
//! points of one patch are compared. Nothing is kept between draws, so that a resumed training draws what an uninterrupted one does.

use cc4dgs_core::Seed;
use rand::Rng;
use std::cmp::Ordering;

/// The most points of a patch: all are compared with one another.
pub const PATCH: usize = 256;
/// The most pairs of [`neighbour_pairs`].
pub const PAIRS: usize = 2048;
/// The most points that a draw of [`neighbour_pairs`] takes its pairs from.
const REGION: usize = 1 << 14;
/// A cut leaves a share from this to one minus this on its lower side.
const LEAST_SHARE: f64 = 0.3;

/// Two points near each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Index of a random point.
    pub first: u32,
    /// Index of one of its nearest others.
    pub second: u32,
    /// Their squared distance, finite.
    pub squared: f32,
}

/// Up to `most`, and up to 2,048, pairs of a random point and, at random, one of its `count` nearest others.
///
/// With at most 256 points every one is the first of a pair, and neighbours are exact. More points are cut across their longest side, at random ranks near
/// the median, until patches of at most 256 remain: neighbours beyond a cut are missed, and each draw cuts elsewhere. Of more than 16,384 points, a draw takes
/// its pairs from one random region of at most as many. All points are about equally likely to be the first of a pair. Time and memory are linear in the number
/// of points for any distribution, duplicates included. A point that is not finite has no neighbours and is no neighbour.
pub fn neighbour_pairs(points: &[[f32; 3]], most: usize, count: usize, seed: Seed) -> Vec<Pair> {
    let mut rows = finite_rows(points);
    let wanted = rows.len().min(most).min(PAIRS);
    let mut pairs = Vec::with_capacity(wanted);
    divide(points, &mut rows, wanted, count, &mut seed.rng(), &mut pairs);
    pairs
}

/// Up to `most` pairs of a random point and, at random, one of its `count` nearest others, from all points alike. No point is the first of two pairs, and none
/// the second of two.
///
/// Points are cut into patches as in [`neighbour_pairs`], but no region is chosen. A point whose neighbours are all the second of other pairs is the first of
/// none: with `most` over the number of points, more than nine of ten points in general position are. The work is in proportion to N log N + 256 P for N points
/// and P pairs, and parallel; the result does not depend on the number of threads. A point that is not finite has no neighbours and is no neighbour.
pub fn spread_pairs(points: &[[f32; 3]], most: usize, count: usize, seed: Seed) -> Vec<Pair> {
    let mut rows = finite_rows(points);
    let wanted = rows.len().min(most);
    spread(points, &mut rows, wanted, count, seed)
}

fn finite_rows(points: &[[f32; 3]]) -> Vec<u32> {
    (0..points.len() as u32).filter(|row| points[*row as usize].iter().all(|v| v.is_finite())).collect()
}

/// Up to `wanted` pairs, at most as many as there are points, of the points `rows`, which it puts into another order.
fn spread(points: &[[f32; 3]], rows: &mut [u32], wanted: usize, count: usize, seed: Seed) -> Vec<Pair> {
    let (total, mut random) = (rows.len(), seed.rng());
    if wanted == 0 || total <= PATCH {
        return pair_once(points, rows, wanted, count, &mut random);
    }
    let cut = cut_across(points, rows, &mut random);
    let (low, high) = rows.split_at_mut(cut);
    // In proportion to the points, rounded at random; exactly all where all are wanted.
    let of_low = (wanted as f64 * cut as f64 / total as f64 + random.random_range(0.0f64..1.0)) as usize;
    let of_low = of_low.min(cut).min(wanted);
    let of_high = (wanted - of_low).min(total - cut);
    let (mut pairs, others) = rayon::join(|| spread(points, low, of_low, count, seed.index(0)), || spread(points, high, of_high, count, seed.index(1)));
    pairs.extend(others);
    pairs
}

/// Puts `rows` into another order: those below a random rank along their longest side, then the others. Returns that rank.
fn cut_across(points: &[[f32; 3]], rows: &mut [u32], random: &mut impl Rng) -> usize {
    let axis = longest_side(points, rows);
    let cut = (rows.len() as f64 * random.random_range(LEAST_SHARE..1.0 - LEAST_SHARE)) as usize;
    rows.select_nth_unstable_by(cut, |&a, &b| points[a as usize][axis].total_cmp(&points[b as usize][axis]).then(a.cmp(&b)));
    cut
}

/// Adds up to `wanted` pairs of the points `rows`, which it puts into another order.
fn divide(points: &[[f32; 3]], rows: &mut [u32], wanted: usize, count: usize, random: &mut impl Rng, pairs: &mut Vec<Pair>) {
    let total = rows.len();
    if total <= PATCH {
        pair_up(points, rows, wanted, count, random, pairs);
        return;
    }
    let cut = cut_across(points, rows, random);
    let (low, high) = rows.split_at_mut(cut);
    let of_low = if total > REGION || wanted <= PATCH {
        // All pairs from one side, chosen with a probability in proportion to its points.
        if random.random_range(0..total) < cut { wanted } else { 0 }
    } else {
        wanted * cut / total
    };
    if of_low > 0 {
        divide(points, low, of_low, count, random, pairs);
    }
    if of_low < wanted {
        divide(points, high, wanted - of_low, count, random, pairs);
    }
}

/// The axis along which the points `rows` extend furthest.
fn longest_side(points: &[[f32; 3]], rows: &[u32]) -> usize {
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for &row in rows {
        for (axis, &value) in points[row as usize].iter().enumerate() {
            low[axis] = low[axis].min(value);
            high[axis] = high[axis].max(value);
        }
    }
    let side = |axis: usize| high[axis] - low[axis];
    (1..3).fold(0, |longest, axis| if side(axis) > side(longest) { axis } else { longest })
}

/// Adds a pair for each of up to `wanted` random points of the patch `rows`.
fn pair_up(points: &[[f32; 3]], rows: &mut [u32], wanted: usize, count: usize, random: &mut impl Rng, pairs: &mut Vec<Pair>) {
    let total = rows.len();
    let count = count.min(total.saturating_sub(1));
    if count == 0 {
        return;
    }
    let mut others: Vec<(f32, u32)> = Vec::with_capacity(total);
    for at in 0..wanted.min(total) {
        let drawn = random.random_range(at..total);
        rows.swap(at, drawn);
        let first = rows[at];
        let here = points[first as usize];
        others.clear();
        others.extend(rows.iter().filter(|&&row| row != first).map(|&row| (squared_distance(here, points[row as usize]), row)));
        let (_, found, _) = others.select_nth_unstable_by(random.random_range(0..count), nearer);
        let (squared, second) = *found;
        if squared.is_finite() {
            pairs.push(Pair { first, second, squared });
        }
    }
}

/// A pair for each of up to `wanted` random points of the patch `rows`: with one of its nearest others that is not the second of another pair, at random.
fn pair_once(points: &[[f32; 3]], rows: &[u32], wanted: usize, count: usize, random: &mut impl Rng) -> Vec<Pair> {
    let total = rows.len();
    let (wanted, count) = (wanted.min(total), count.min(total.saturating_sub(1)));
    if wanted == 0 || count == 0 {
        return Vec::new();
    }
    let mut pairs = Vec::with_capacity(wanted);
    let mut order: Vec<usize> = (0..total).collect();
    let mut taken = vec![false; total];
    // Squared distance and index in `rows`.
    let (mut others, mut free) = (Vec::<(f32, u32)>::with_capacity(total), Vec::<(f32, u32)>::with_capacity(count));
    for at in 0..wanted {
        let drawn = random.random_range(at..total);
        order.swap(at, drawn);
        let own = order[at];
        let here = points[rows[own] as usize];
        let to = |(index, row): (usize, &u32)| (squared_distance(here, points[*row as usize]), index as u32);
        others.clear();
        others.extend(rows.iter().enumerate().filter(|(index, _)| *index != own).map(to));
        others.select_nth_unstable_by(count - 1, nearer);
        free.clear();
        free.extend(others[..count].iter().filter(|(squared, index)| squared.is_finite() && !taken[*index as usize]));
        if free.is_empty() {
            continue;
        }
        let rank = random.random_range(0..free.len());
        let (_, &mut (squared, second), _) = free.select_nth_unstable_by(rank, nearer);
        let second = second as usize;
        taken[second] = true;
        pairs.push(Pair { first: rows[own], second: rows[second], squared });
    }
    pairs
}

/// By distance, ties by index.
fn nearer(a: &(f32, u32), b: &(f32, u32)) -> Ordering {
    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
}

fn squared_distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let [x, y, z]: [f32; 3] = std::array::from_fn(|axis| a[axis] - b[axis]);
    x * x + y * y + z * z
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(count: usize) -> Vec<[f32; 3]> {
        let mut random = Seed::root(3).rng();
        (0..count).map(|_| std::array::from_fn(|_| random.random_range(0.0f32..1.0))).collect()
    }

    #[test]
    fn few_points_are_all_paired_with_their_nearest() {
        let points = cube(200);
        let pairs = neighbour_pairs(&points, PAIRS, 20, Seed::root(1));
        let mut firsts: Vec<u32> = pairs.iter().map(|pair| pair.first).collect();
        firsts.sort_unstable();
        assert_eq!(firsts, (0..200).collect::<Vec<u32>>());
        for pair in &pairs {
            let distance = |row: u32| squared_distance(points[pair.first as usize], points[row as usize]);
            let nearer = (0..200).filter(|&row| row != pair.first && distance(row) < pair.squared).count();
            assert!(pair.first != pair.second && distance(pair.second) == pair.squared && nearer < 20, "{pair:?}: {nearer} are nearer");
        }
        assert_eq!(neighbour_pairs(&points, PAIRS, 20, Seed::root(1)), pairs);
        assert_ne!(neighbour_pairs(&points, PAIRS, 20, Seed::root(2)), pairs);
        assert!(neighbour_pairs(&[], PAIRS, 20, Seed::root(1)).is_empty() && neighbour_pairs(&points[..1], PAIRS, 20, Seed::root(1)).is_empty());
    }

    #[test]
    fn pairs_of_many_points_are_near() {
        for count in [1000, 10_000, 40_000] {
            let points = cube(count);
            let pairs = neighbour_pairs(&points, PAIRS, 20, Seed::root(1));
            assert!((500..=PAIRS).contains(&pairs.len()), "{} pairs", pairs.len());
            // The radius of a ball that holds 20 points on average. Cuts make neighbours further.
            let radius = (20.0 * 3.0 / (4.0 * std::f32::consts::PI * count as f32)).cbrt();
            let mean = pairs.iter().map(|pair| pair.squared.sqrt()).sum::<f32>() / pairs.len() as f32;
            assert!(mean < 1.5 * radius, "{count} points: {mean} of {radius}");
        }
    }

    #[test]
    fn every_point_is_drawn_at_some_time() {
        let points = cube(4000);
        let mut seen = vec![0; points.len()];
        for draw in 0..60 {
            neighbour_pairs(&points, PAIRS, 20, Seed::root(1).index(draw)).iter().for_each(|pair| seen[pair.first as usize] += 1);
        }
        // Each draw has up to half of them, none twice.
        assert!(seen.iter().all(|&times| times > 0 && times <= 60));
    }

    #[test]
    fn duplicates_and_points_that_are_not_finite_are_answered() {
        let same = neighbour_pairs(&[[0.3, -0.2, 7.0]; 5000], PAIRS, 20, Seed::root(1));
        assert!(!same.is_empty() && same.iter().all(|pair| pair.first != pair.second && pair.squared == 0.0));
        let mut points = cube(600);
        (points[3], points[40], points[200]) = ([f32::NAN; 3], [f32::INFINITY, 0.0, 0.0], [3e38; 3]);
        let pairs = neighbour_pairs(&points, PAIRS, 20, Seed::root(1));
        assert!(!pairs.is_empty() && pairs.iter().all(|pair| pair.squared.is_finite()));
        assert!(pairs.iter().all(|pair| [3, 40, 200].iter().all(|&row| pair.first != row && pair.second != row)));
    }

    #[test]
    fn at_most_the_wanted_number_is_drawn() {
        let points = cube(3000);
        for most in [1, 100, 1500] {
            for pairs in [neighbour_pairs(&points, most, 20, Seed::root(1)), spread_pairs(&points, most, 20, Seed::root(1))] {
                assert!(!pairs.is_empty() && pairs.len() <= most, "{} of {most}", pairs.len());
            }
        }
        assert!(spread_pairs(&[], 9, 20, Seed::root(1)).is_empty() && spread_pairs(&points[..1], 9, 20, Seed::root(1)).is_empty());
    }

    #[test]
    fn nearly_every_point_has_a_pair_where_all_are_wanted() {
        for count in [200, 20_000] {
            let points = cube(count);
            let draw = |seed: u64| spread_pairs(&points, usize::MAX, 20, Seed::root(seed));
            let pairs = draw(1);
            assert!(pairs.len() > 9 * count / 10 && pairs.len() <= count, "{} pairs of {count} points", pairs.len());
            let ends: [fn(&Pair) -> u32; 2] = [|pair| pair.first, |pair| pair.second];
            for end in ends {
                let mut rows: Vec<u32> = pairs.iter().map(end).collect();
                rows.sort_unstable();
                assert!(rows.windows(2).all(|two| two[0] < two[1]), "a point is drawn twice");
            }
            // As in `pairs_of_many_points_are_near`.
            let radius = (20.0 * 3.0 / (4.0 * std::f32::consts::PI * count as f32)).cbrt();
            let mean = pairs.iter().map(|pair| pair.squared.sqrt()).sum::<f32>() / pairs.len() as f32;
            assert!(mean < 1.5 * radius, "{count} points: {mean} of {radius}");
            for threads in [1, 3] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                assert_eq!(pool.install(|| draw(1)), pairs, "{threads} threads");
            }
            assert_ne!(draw(2), pairs);
        }
        // Neighbours of few points are exact.
        let points = cube(200);
        for pair in spread_pairs(&points, 200, 20, Seed::root(1)) {
            let distance = |row: u32| squared_distance(points[pair.first as usize], points[row as usize]);
            let nearer = (0..200).filter(|&row| row != pair.first && distance(row) < pair.squared).count();
            assert!(pair.first != pair.second && distance(pair.second) == pair.squared && nearer < 20, "{pair:?}: {nearer} are nearer");
        }
    }

    #[test]
    fn part_of_the_pairs_is_from_all_regions() {
        let points = cube(40_000);
        let pairs = spread_pairs(&points, 4000, 20, Seed::root(1));
        assert!(pairs.len() > 3600, "{} pairs", pairs.len());
        for octant in 0..8usize {
            let inside = |pair: &&Pair| (0..3).all(|axis| (points[pair.first as usize][axis] < 0.5) == ((octant >> axis) & 1 == 0));
            let found = pairs.iter().filter(inside).count();
            assert!((300..700).contains(&found), "{found} pairs in octant {octant}");
        }
    }

    #[test]
    fn spread_pairs_of_duplicates_and_points_that_are_not_finite_are_answered() {
        let same = spread_pairs(&[[0.3, -0.2, 7.0]; 5000], usize::MAX, 20, Seed::root(1));
        assert!(!same.is_empty() && same.iter().all(|pair| pair.first != pair.second && pair.squared == 0.0));
        let mut points = cube(600);
        (points[3], points[40], points[200]) = ([f32::NAN; 3], [f32::INFINITY, 0.0, 0.0], [3e38; 3]);
        let pairs = spread_pairs(&points, usize::MAX, 20, Seed::root(1));
        assert!(pairs.len() > 500 && pairs.iter().all(|pair| pair.squared.is_finite()));
        assert!(pairs.iter().all(|pair| [3, 40, 200].iter().all(|&row| pair.first != row && pair.second != row)));
    }
}
