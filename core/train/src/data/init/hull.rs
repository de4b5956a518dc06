//! The surface of the visual hull: points that all foreground masks contain, next to points that some do not.

use super::Candidate;
use super::views::{WorkSet, WorkView};
use cc4dgs_core::Seed;
use glam::Vec3;
use rand::Rng;
use rayon::prelude::*;

/// Cells per axis of the first look.
const GRID: usize = 64;
/// Random points per cell that may hold surface.
const PER_CELL: usize = 48;
/// The fewest cameras that must see a point before their masks decide.
const MIN_SEEING: usize = 4;
/// The share of seeing cameras whose mask may be wrong.
const MAX_MISSES: f32 = 0.08;

/// Points on the hull with the colours of the cameras that face them; none if fewer than four views have masks.
pub(super) fn hull_points(set: &WorkSet, seed: Seed) -> Vec<Candidate> {
    let masked: Vec<&WorkView> = set.views.iter().filter(|v| v.mask.is_some()).collect();
    if masked.len() < MIN_SEEING {
        return Vec::new();
    }
    let size = (set.box_high - set.box_low) / GRID as f32;
    let index = |i: usize, j: usize, k: usize| (k * GRID + j) * GRID + i;
    let center = |c: usize| set.box_low + size * Vec3::new((c % GRID) as f32 + 0.5, (c / GRID % GRID) as f32 + 0.5, (c / GRID / GRID) as f32 + 0.5);
    // A cell's centre may miss a limb that crosses the cell; being nearly inside is enough for the first look.
    let full: Vec<bool> = (0..GRID * GRID * GRID).into_par_iter().map(|c| inside(&masked, center(c), 0.3)).collect();
    let mut near = vec![false; full.len()];
    for k in 0..GRID {
        for j in 0..GRID {
            for i in 0..GRID {
                let around = |v: usize| v.saturating_sub(1)..(v + 2).min(GRID);
                near[index(i, j, k)] = around(k).any(|c| around(j).any(|b| around(i).any(|a| full[index(a, b, c)])));
            }
        }
    }
    let cells: Vec<usize> = (0..near.len()).filter(|&c| near[c]).collect();
    let shell = 0.5 * size.max_element();
    let found: Vec<Vec<Candidate>> = cells
        .par_iter()
        .map(|&cell| {
            // One generator per cell: the result does not depend on which thread takes it.
            let mut rng = seed.index(cell as u64).rng();
            let mut points = Vec::new();
            for _ in 0..PER_CELL {
                let jitter = Vec3::new(rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5, rng.random::<f32>() - 0.5);
                let position = center(cell) + jitter * size;
                if inside(&masked, position, MAX_MISSES)
                    && let Some(normal) = normal(&masked, position, shell)
                {
                    points.push(Candidate { position, color: color(&masked, position, normal), confidence: 0.0 });
                }
            }
            points
        })
        .collect();
    found.into_iter().flatten().collect()
}

fn inside(views: &[&WorkView], p: Vec3, max_misses: f32) -> bool {
    let (mut seeing, mut missing) = (0usize, 0usize);
    for view in views {
        let level = view.fine();
        let Some(pixel) = view.project(level, p).and_then(|(u, v, _)| level.pixel(u, v)) else { continue };
        seeing += 1;
        missing += usize::from(!view.mask.as_ref().is_some_and(|m| m[pixel]));
    }
    // What only a corner of the rig sees is not carved, and so not known to be full.
    seeing >= MIN_SEEING.max(views.len() / 3) && missing as f32 <= max_misses * seeing as f32
}

/// The outward direction if the hull ends within `reach`.
fn normal(views: &[&WorkView], p: Vec3, reach: f32) -> Option<Vec3> {
    let axes = [Vec3::X, -Vec3::X, Vec3::Y, -Vec3::Y, Vec3::Z, -Vec3::Z];
    let sum: Vec3 = axes.into_iter().filter(|a| !inside(views, p + *a * reach, MAX_MISSES)).sum();
    sum.try_normalize()
}

/// Mean colour of the three cameras that look at the surface most squarely.
fn color(views: &[&WorkView], p: Vec3, normal: Vec3) -> [f32; 3] {
    let mut seen: Vec<(f32, [f32; 3])> = views
        .iter()
        .filter_map(|view| {
            let level = view.fine();
            let (u, v, _) = view.project(level, p)?;
            let facing = (view.center.as_vec3() - p).normalize_or_zero().dot(normal);
            Some((facing, level.rgb[level.pixel(u, v)?]))
        })
        .collect();
    seen.sort_by(|a, b| b.0.total_cmp(&a.0));
    seen.truncate(3);
    let n = seen.len().max(1) as f32;
    std::array::from_fn(|k| seen.iter().map(|s| s.1[k]).sum::<f32>() / n)
}
