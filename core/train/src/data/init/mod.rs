//! Initial points from the images alone, for scenes that come without any.
//!
//! Multi-view stereo on small images: plane-swept depth with normalised cross-correlation, refined coarse to fine, kept where several views agree;
//! a share of points for texture-poor surfaces between them; and, where the dataset has foreground masks, the surface of the visual hull.

mod fuse;
mod hull;
mod sweep;
mod views;

use cc4dgs_core::{Error, PointCloud, Result, Scene, Seed};
use glam::Vec3;
use rand::seq::SliceRandom;
use std::collections::HashMap;
use views::WorkSet;

/// The fewest training cameras at one instant that depth can be judged from.
const MIN_VIEWS: usize = 4;
/// Shares of the wanted points: matched in several views, visual hull, in between. What one group lacks goes to the next.
const SHARE_HULL: f64 = 0.25;
const SHARE_FILL: f64 = 0.25;

/// A proposed point.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    position: Vec3,
    color: [f32; 3],
    /// Higher is better; comparable within one group only.
    confidence: f32,
}

/// Up to `count` coloured points on the surfaces of `scene` at its first instant with enough training cameras, in world units.
///
/// Deterministic in the scene and `seed`, whatever the number of threads. Errors: [`Error::Unsupported`] for scenes with fewer than four training
/// cameras at every instant (a single moving camera), [`Error::Data`] if hardly anything matches, and whatever decoding the images meets.
pub fn photo_points(scene: &Scene, count: usize, seed: Seed) -> Result<PointCloud> {
    let set = WorkSet::load(scene, MIN_VIEWS)?;
    let maps = sweep::depth_maps(&set);
    let (matched, fill) = fuse::fuse(&set, &maps);
    let hull = hull::hull_points(&set, seed.child("hull"));
    let cell = set.cell_size();
    let matched = thin(matched, cell, seed.child("matched"));
    let hull = thin(hull, cell, seed.child("thin-hull"));
    let fill = thin(fill, 2.0 * cell, seed.child("fill"));
    if matched.len() + hull.len() < 100.min(count) {
        return Err(Error::data(
            format!("scene {}", scene.name),
            format!("only {} points match in several views", matched.len()),
            "Check the calibration and the order of the cameras, or start from random points",
        ));
    }
    let want = |share: f64| (count as f64 * share) as usize;
    let n_hull = hull.len().min(want(SHARE_HULL));
    let n_fill = fill.len().min(want(SHARE_FILL).max((count - n_hull).saturating_sub(matched.len())));
    let n_matched = matched.len().min(count - n_hull - n_fill);
    let mut cloud = PointCloud::default();
    for c in matched[..n_matched].iter().chain(&hull[..n_hull]).chain(&fill[..n_fill]) {
        cloud.positions.push(c.position.to_array());
        cloud.colors.push(c.color);
    }
    Ok(cloud)
}

/// One candidate, the most confident, per cube of edge `cell`; in random order.
fn thin(candidates: Vec<Candidate>, cell: f32, seed: Seed) -> Vec<Candidate> {
    let mut best: HashMap<[i32; 3], usize> = HashMap::new();
    for (i, c) in candidates.iter().enumerate() {
        let key = (c.position / cell).floor().to_array().map(|v| v as i32);
        let slot = best.entry(key).or_insert(i);
        if candidates[*slot].confidence < c.confidence {
            *slot = i;
        }
    }
    let mut kept: Vec<usize> = best.into_values().collect();
    // The map's order differs from run to run.
    kept.sort_unstable();
    kept.shuffle(&mut seed.rng());
    kept.into_iter().map(|i| candidates[i]).collect()
}
