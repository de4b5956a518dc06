//! From depth maps to points: a depth counts when other views see the same surface there and none sees through it. Between such depths others are
//! interpolated, and where neither fits the images, the depth that looks least wrong is a guess.

use super::Candidate;
use super::choose::Arrangement;
use super::sweep::DepthMap;
use super::views::{WorkSet, WorkView};
use cc4dgs_core::Seed;
use glam::Vec3;
use rand::Rng;
use rayon::prelude::*;

/// Correlation a depth needs to be believed.
const MIN_SCORE: f32 = 0.5;
/// Correlation at which another view's depth is proof against a point before it.
const PROOF_SCORE: f32 = 0.7;
/// Largest mean colour difference between views, 0..1, for points between matches.
const MAX_COLOR_DIFFERENCE: f32 = 0.10;
/// Depths tried per guess.
const GUESSES: usize = 8;
/// The nearest guess, as a share of the distance of what the cameras look at: what is guessed nearer hides more than it explains.
const NEAREST_GUESS: f64 = 0.5;

/// The points of all depth maps.
#[derive(Default)]
pub(super) struct Fused {
    /// Matched in several views.
    pub matched: Vec<Candidate>,
    /// On depth interpolated between matches.
    pub between: Vec<Candidate>,
    /// At the depth whose colours differ least, where nothing matches: things that move or shine.
    pub guessed: Vec<Candidate>,
    /// Share of the solid pixels that neither matched nor interpolated points explain.
    pub unexplained: f64,
}

/// What the other views say about a point.
#[derive(Default)]
struct Verdict {
    agree: u32,
    through: u32,
    /// Sum over those that agree of the inverse depth they see, over that of the point.
    ratios: f32,
}

impl Verdict {
    /// The inverse depth that the view and those that agree with it mean together.
    fn mean(&self, own: f32) -> f32 {
        own * (1.0 + self.ratios) / (1.0 + self.agree as f32)
    }
}

/// Asks all depth maps.
pub(super) fn fuse(set: &WorkSet, maps: &[DepthMap], seed: Seed) -> Fused {
    let parts: Vec<_> = (0..set.keys).into_par_iter().map(|i| fuse_view(set, maps, i, seed.index(i as u64))).collect();
    let (mut all, mut explained, mut open) = (Fused::default(), 0usize, 0usize);
    for (part, counts) in parts {
        all.matched.extend(part.matched);
        all.between.extend(part.between);
        all.guessed.extend(part.guessed);
        (explained, open) = (explained + counts[0], open + counts[1]);
    }
    all.unexplained = open as f64 / (explained + open).max(1) as f64;
    all
}

/// The points of one depth map, and how many pixels of its lattice are explained and not.
fn fuse_view(set: &WorkSet, maps: &[DepthMap], index: usize, seed: Seed) -> (Fused, [usize; 2]) {
    let (view, map) = (&set.views[index], &maps[index]);
    let level = view.fine();
    let needed = if set.keys >= 6 { 2 } else { 1 };
    let solid = |p: usize| view.solid(set.foreground, p);
    let point_at = |p: usize, inverse: f32| {
        let (u, v) = ((p % level.width) as f64 + 0.5, (p / level.width) as f64 + 0.5);
        let depth = 1.0 / f64::from(inverse.max(1e-9));
        (view.unproject(level, u, v, depth), depth as f32)
    };
    let mut found = Fused::default();
    let mut known = vec![f32::NAN; map.inverse.len()];
    // What matches best at the very near end would match better before it.
    let nearest = (1.0 / view.depth_range[0]) as f32 - 0.5 * map.step;
    for (p, &inverse) in map.inverse.iter().enumerate() {
        if map.score[p] < MIN_SCORE || inverse >= nearest || !solid(p) {
            continue;
        }
        let verdict = ask(set, maps, view, point_at(p, inverse).0);
        if verdict.agree >= needed && verdict.agree > verdict.through {
            known[p] = verdict.mean(inverse);
            let (position, depth) = point_at(p, known[p]);
            found.matched.push(Candidate { position, color: level.rgb[p], confidence: map.score[p] + 0.1 * verdict.agree as f32, depth });
        }
    }
    let smooth = interpolate(&known, level.width);
    let least = (1.0 / view.depth_range[1]) as f32;
    let focus = super::choose::focus_depth(view.center, view.rotation.transpose() * glam::DVec3::Z, &set.rig);
    let most = (1.0 / (NEAREST_GUESS * focus).max(view.depth_range[0])) as f32;
    let mut rng = seed.rng();
    let mut counts = [0, 0];
    // Every third pixel each way is enough between the matches.
    for p in (0..smooth.len()).filter(|p| (p % level.width) % 3 == 1 && (p / level.width) % 3 == 1 && solid(*p)) {
        if known[p].is_finite() {
            counts[0] += 1;
            continue;
        }
        if smooth[p].is_finite() {
            let (position, depth) = point_at(p, smooth[p]);
            let difference = color_difference(set, view, position, level.rgb[p]);
            if difference < MAX_COLOR_DIFFERENCE && ask(set, maps, view, position).through == 0 {
                found.between.push(Candidate { position, color: level.rgb[p], confidence: -difference, depth });
                counts[0] += 1;
                continue;
            }
        }
        counts[1] += 1;
        // What hides the surface around it is before it.
        let from = if smooth[p].is_finite() && smooth[p] < 0.9 * most { smooth[p] } else { least };
        let tried = (0..GUESSES).map(|i| from + (most - from) * (i as f32 + rng.random::<f32>()) / GUESSES as f32);
        let guess = |inverse: f32| {
            let (position, depth) = point_at(p, inverse);
            Candidate { position, color: level.rgb[p], confidence: -color_difference(set, view, position, level.rgb[p]), depth }
        };
        let best = tried.map(guess).max_by(|a, b| a.confidence.total_cmp(&b.confidence));
        let seen_through = |c: &Candidate| set.arrangement == Arrangement::OneTime && ask(set, maps, view, c.position).through > 0;
        found.guessed.extend(best.filter(|c| c.confidence.is_finite() && !seen_through(c)));
    }
    (found, counts)
}

fn ask(set: &WorkSet, maps: &[DepthMap], view: &WorkView, position: Vec3) -> Verdict {
    let mut verdict = Verdict::default();
    for &other in &view.witnesses {
        let (theirs, map) = (&set.views[other], &maps[other]);
        let Some((u, v, z)) = theirs.project(theirs.fine(), position) else { continue };
        let Some(p) = theirs.fine().pixel(u, v) else { continue };
        let (own, seen) = (1.0 / z, map.inverse[p]);
        let tolerance = map.step + 0.01 * own;
        if (own - seen).abs() < tolerance {
            if map.score[p] > 0.5 * MIN_SCORE {
                verdict.agree += 1;
                verdict.ratios += seen / own;
            }
        } else if seen < own - 2.0 * tolerance && map.score[p] > PROOF_SCORE {
            verdict.through += 1;
        }
    }
    verdict
}

/// Mean colour difference to the two most similar partners that see the point (to the only one, if there is one); infinite if fewer do.
fn color_difference(set: &WorkSet, view: &WorkView, position: Vec3, color: [f32; 3]) -> f32 {
    let difference = |&other: &usize| {
        let theirs = &set.views[other];
        let c = theirs.fine().rgb[theirs.pixel_of(position)?];
        Some((0..3).map(|k| (c[k] - color[k]).abs()).sum::<f32>() / 3.0)
    };
    let mut differences: Vec<f32> = view.partners.iter().filter_map(difference).collect();
    differences.sort_by(f32::total_cmp);
    match differences[..] {
        [a, b, ..] => 0.5 * (a + b),
        [a] if view.partners.len() == 1 => a,
        _ => f32::INFINITY,
    }
}

/// Fills NaN from the known values around, by averages over ever larger blocks; all NaN if nothing is known.
fn interpolate(known: &[f32], width: usize) -> Vec<f32> {
    let height = known.len() / width.max(1);
    let (w2, h2) = (width.div_ceil(2), height.div_ceil(2));
    if width * height <= 1 {
        return known.to_vec();
    }
    let mut coarse = vec![f32::NAN; w2 * h2];
    for (q, c) in coarse.iter_mut().enumerate() {
        let (x, y) = (2 * (q % w2), 2 * (q / w2));
        let block = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
        let values = block.iter().filter(|(i, j)| *i < width && *j < height).map(|(i, j)| known[j * width + i]).filter(|v| v.is_finite());
        let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
        if n > 0.0 {
            *c = sum / n;
        }
    }
    let filled = interpolate(&coarse, w2);
    known.iter().enumerate().map(|(p, &v)| if v.is_finite() { v } else { bilinear(&filled, w2, h2, p % width, p / width) }).collect()
}

/// The value of a half-size grid at a full-size pixel.
fn bilinear(grid: &[f32], w: usize, h: usize, x: usize, y: usize) -> f32 {
    let axis = |i: usize, n: usize| {
        let c = ((i as f32 + 0.5) / 2.0 - 0.5).clamp(0.0, n as f32 - 1.0);
        let first = c as usize;
        (first, (first + 1).min(n - 1), c - c.floor())
    };
    let ((x0, x1, a), (y0, y1, b)) = (axis(x, w), axis(y, h));
    let row = |y: usize| grid[y * w + x0] * (1.0 - a) + grid[y * w + x1] * a;
    row(y0) * (1.0 - b) + row(y1) * b
}

#[cfg(test)]
mod tests {
    use super::interpolate;

    #[test]
    fn gaps_are_bridged() {
        let mut known = vec![f32::NAN; 15];
        known[0] = 1.0;
        known[14] = 1.0;
        assert!(interpolate(&known, 5).iter().all(|v| (v - 1.0).abs() < 1e-6));
        known[14] = 3.0;
        assert!(interpolate(&known, 5).iter().all(|v| (1.0..=3.0).contains(v)));
        assert!(interpolate(&[f32::NAN; 6], 3).iter().all(|v| v.is_nan()));
    }
}
