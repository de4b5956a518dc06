//! From depth maps to points: a depth counts when other views see the same surface there and none sees through it.

use super::Candidate;
use super::sweep::DepthMap;
use super::views::{WorkSet, WorkView};
use rayon::prelude::*;

/// Correlation a depth needs to be believed.
const MIN_SCORE: f32 = 0.5;
/// Correlation at which another view's depth is proof against a point before it.
const PROOF_SCORE: f32 = 0.7;
/// Largest mean colour difference between views, 0..1, for points between matches.
const MAX_COLOR_DIFFERENCE: f32 = 0.10;

/// What the other views say about a point.
#[derive(Default)]
struct Verdict {
    agree: u32,
    through: u32,
}

/// Points matched in several views, and points on depth interpolated between them.
pub(super) fn fuse(set: &WorkSet, maps: &[DepthMap]) -> (Vec<Candidate>, Vec<Candidate>) {
    let pairs: Vec<_> = (0..set.views.len()).into_par_iter().map(|i| fuse_view(set, maps, i)).collect();
    let (mut matched, mut fill) = (Vec::new(), Vec::new());
    for (m, f) in pairs {
        matched.extend(m);
        fill.extend(f);
    }
    (matched, fill)
}

fn fuse_view(set: &WorkSet, maps: &[DepthMap], index: usize) -> (Vec<Candidate>, Vec<Candidate>) {
    let (view, map) = (&set.views[index], &maps[index]);
    let level = view.fine();
    let needed = if set.views.len() >= 6 { 2 } else { 1 };
    let solid = |p: usize| view.opaque.as_ref().is_none_or(|o| o[p]);
    let world = |p: usize, inverse: f32| {
        let (u, v) = ((p % level.width) as f64 + 0.5, (p / level.width) as f64 + 0.5);
        view.unproject(level, u, v, 1.0 / f64::from(inverse.max(1e-9)))
    };
    let mut matched = Vec::new();
    let mut known = vec![f32::NAN; map.inverse.len()];
    for (p, &inverse) in map.inverse.iter().enumerate() {
        if map.score[p] < MIN_SCORE || !solid(p) {
            continue;
        }
        let position = world(p, inverse);
        let verdict = ask(set, maps, view, position);
        if verdict.agree >= needed && verdict.agree > verdict.through {
            known[p] = inverse;
            matched.push(Candidate { position, color: level.rgb[p], confidence: map.score[p] + 0.1 * verdict.agree as f32 });
        }
    }
    let smooth = interpolate(&known, level.width);
    let mut fill = Vec::new();
    // Every third pixel each way is enough between the matches.
    for p in (0..smooth.len()).filter(|p| (p % level.width) % 3 == 1 && (p / level.width) % 3 == 1) {
        if known[p].is_nan() && smooth[p].is_finite() && solid(p) {
            let position = world(p, smooth[p]);
            let difference = color_difference(set, view, position, level.rgb[p]);
            if difference < MAX_COLOR_DIFFERENCE && ask(set, maps, view, position).through == 0 {
                fill.push(Candidate { position, color: level.rgb[p], confidence: -difference });
            }
        }
    }
    (matched, fill)
}

fn ask(set: &WorkSet, maps: &[DepthMap], view: &WorkView, position: glam::Vec3) -> Verdict {
    let mut verdict = Verdict::default();
    for &other in &view.neighbours {
        let (theirs, map) = (&set.views[other], &maps[other]);
        let Some((u, v, z)) = theirs.project(theirs.fine(), position) else { continue };
        let Some(p) = theirs.fine().pixel(u, v) else { continue };
        let (own, seen) = (1.0 / z, map.inverse[p]);
        let tolerance = 2.0 * map.step + 0.01 * own;
        if (own - seen).abs() < tolerance {
            verdict.agree += u32::from(map.score[p] > 0.5 * MIN_SCORE);
        } else if seen < own - 2.0 * tolerance && map.score[p] > PROOF_SCORE {
            verdict.through += 1;
        }
    }
    verdict
}

/// Mean colour difference to the two most similar neighbours that see the point; infinite if fewer do.
fn color_difference(set: &WorkSet, view: &WorkView, position: glam::Vec3, color: [f32; 3]) -> f32 {
    let mut differences: Vec<f32> = view
        .neighbours
        .iter()
        .filter_map(|&other| {
            let theirs = &set.views[other];
            let (u, v, _) = theirs.project(theirs.fine(), position)?;
            let c = theirs.fine().rgb[theirs.fine().pixel(u, v)?];
            Some((0..3).map(|k| (c[k] - color[k]).abs()).sum::<f32>() / 3.0)
        })
        .collect();
    differences.sort_by(f32::total_cmp);
    match differences[..] {
        [a, b, ..] => 0.5 * (a + b),
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
