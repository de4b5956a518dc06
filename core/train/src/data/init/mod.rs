//! Initial points from the images alone, for scenes that come without any.
//!
//! Multi-view stereo on small images: plane-swept depth with normalised cross-correlation, refined coarse to fine, kept where several views agree. The views
//! are of one time where that has enough cameras; else of neighbouring times, because most of a scene stands still. Added to those are points on depth
//! interpolated between matches, the visual hull where foreground masks are known, points at the depth whose colours differ least where nothing matches, and,
//! last, random points in the volume that the cameras see.

mod choose;
mod foreground;
mod fuse;
mod hull;
mod key_frames;
mod revealed;
mod size;
mod sweep;
mod views;
mod volume;

pub(crate) use key_frames::{KeyFrames, KeyPoint, LEAST_INTERVAL};
pub(crate) use size::limit_sizes_to;
pub use size::{limit_opacities, limit_sizes};

use crate::config::InitSource;
use cc4dgs_core::{Error, PointCloud, Result, Scene, Seed, plural};
use choose::{Arrangement, Choice};
use fuse::Fused;
use glam::Vec3;
use hull::Hull;
use rand::seq::SliceRandom;
use std::collections::HashMap;
use views::{Foreground, WorkSet};

/// Shares of the wanted points for hull, points between matches, and guesses. What one kind lacks goes to the others.
const SHARE_HULL: f64 = 0.25;
const SHARE_BETWEEN: f64 = 0.25;
const SHARE_GUESSED: f64 = 0.05;
/// Share of the wanted points that are random where there is nothing but foreground and no time has several cameras: what moves is in no hull.
const SHARE_RANDOM: f64 = 0.25;
/// The shares where there is nothing but foreground: then the hull is the best guess of all that moves.
const SHARE_HULL_WHOLE: f64 = 0.7;
const SHARE_BETWEEN_WHOLE: f64 = 0.1;
/// Share of the wanted points that there are at least; random ones make up for the rest.
const SHARE_AT_LEAST: f64 = 0.25;
/// The fewest points that make a reconstruction.
const FEWEST: usize = 100;

/// A proposed point.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    position: Vec3,
    color: [f32; 3],
    /// Higher is better; comparable within one group only.
    confidence: f32,
    /// Depth in the view that proposed it; 0 for points that no single view did.
    depth: f32,
}

/// Points, one kind after the other in the order of the counts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FoundPoints {
    /// Positions in the scene's units, colours in 0..1.
    pub cloud: PointCloud,
    /// Whether views of different times were matched with each other.
    pub across_times: bool,
    /// Points matched in several views.
    pub matched: usize,
    /// Points on depth interpolated between matches.
    pub between: usize,
    /// Points on and in the visual hull of the foreground.
    pub hull: usize,
    /// Points at the depth whose colours differ least, where nothing matched.
    pub guessed: usize,
    /// Random points in the volume that the cameras see.
    pub random: usize,
}

impl FoundPoints {
    /// The counts in words.
    pub fn describe(&self) -> String {
        let matched = if self.across_times { "matched across times" } else { "matched at one time" };
        let kinds = [
            (self.matched, matched),
            (self.between, "between matches"),
            (self.hull, "on the hull of the foreground"),
            (self.guessed, "at the most similar depth where nothing matched"),
            (self.random, "random in what the cameras see"),
        ];
        let list: Vec<String> = kinds.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
        let count = self.cloud.positions.len();
        format!("{count} {}: {}", plural(count, "point", "points"), list.join(", "))
    }
    fn add(&mut self, points: &[Candidate]) -> usize {
        self.cloud.positions.extend(points.iter().map(|c| c.position.to_array()));
        self.cloud.colors.extend(points.iter().map(|c| c.color));
        points.len()
    }
}

/// Up to `count` coloured points on the surfaces of `scene` that match in several views, in world units; see [`find_points`].
pub fn photo_points(scene: &Scene, count: usize, seed: Seed) -> Result<PointCloud> {
    Ok(find_points(scene, InitSource::Photo, count, seed)?.cloud)
}

/// Up to `count` coloured points for `scene`, in world units, of the kinds that `source` names: photo-consistent ones, those of the visual hull, random ones,
/// or whatever the scene allows ([`InitSource::Auto`]). The scene's own points are not looked at.
///
/// Deterministic in the scene and `seed`, whatever the number of threads. Errors: [`Error::Unsupported`] for photo-consistent points of images from one
/// position and hulls without foreground, [`Error::Data`] if hardly anything matches, and whatever decoding the images meets.
pub fn find_points(scene: &Scene, source: InitSource, count: usize, seed: Seed) -> Result<FoundPoints> {
    let choice = Choice::new(scene);
    let photo = matches!(source, InitSource::Photo | InitSource::Auto);
    if source == InitSource::Photo && choice.arrangement == Arrangement::OnePose {
        return Err(Error::unsupported(
            format!("points from the images of {}", scene.name),
            "all training images are from one position, which says nothing of depth",
            "Use init.source = \"random\"",
        ));
    }
    let mut set = WorkSet::load(scene, choice)?;
    let mut hull_points = Vec::new();
    if source != InitSource::Random {
        let found = Hull::find(&set).map(|hull| (hull.points(seed.child("hull")), hull.bounds()));
        if let Some((points, (low, high))) = found {
            hull_points = points;
            if set.foreground == Foreground::Whole {
                set.narrow(low, high);
            }
        }
    }
    if source == InitSource::Hull && hull_points.is_empty() {
        return Err(Error::unsupported(
            format!("the visual hull of {}", scene.name),
            "its images have no foreground masks, no transparency and no plain background that at least three views share",
            "Use init.source = \"photo\" or \"random\"",
        ));
    }
    let mut fused = Fused::default();
    if photo && set.arrangement != Arrangement::OnePose {
        fused = reconstruct(scene, &set, seed);
    }
    let cell = set.cell_size();
    let far = set.rig.distance.unwrap_or(f64::INFINITY) as f32;
    let groups = [
        thin(fused.matched, cell, far, seed.child("matched")),
        thin(fused.between, 2.0 * cell, far, seed.child("fill")),
        thin(hull_points, cell, far, seed.child("thin-hull")),
        thin(fused.guessed, 2.0 * cell, far, seed.child("guessed")),
    ];
    if source == InitSource::Photo && groups[0].len() + groups[2].len() < FEWEST.min(count) {
        return Err(Error::data(
            format!("scene {}", scene.name),
            format!("only {} {} in several views", groups[0].len(), plural(groups[0].len(), "point matches", "points match")),
            "Check the calibration and the order of the cameras, or start from random points",
        ));
    }
    let whole = set.foreground == Foreground::Whole;
    let [hull, between] = if whole { [SHARE_HULL_WHOLE, SHARE_BETWEEN_WHOLE] } else { [SHARE_HULL, SHARE_BETWEEN] };
    let wanted = [1.0, between, hull, SHARE_GUESSED.min(fused.unexplained)];
    let across_times = set.arrangement == Arrangement::AcrossTimes;
    let moves_alone = source == InitSource::Auto && across_times && scene.frame_count > 1 && whole;
    let reserved = if moves_alone { (SHARE_RANDOM * count as f64) as usize } else { 0 };
    let shares = share_out(groups.each_ref().map(Vec::len), wanted, count - reserved);
    let mut found = FoundPoints { across_times, ..Default::default() };
    found.matched = found.add(&groups[0][..shares[0]]);
    found.between = found.add(&groups[1][..shares[1]]);
    found.hull = found.add(&groups[2][..shares[2]]);
    found.guessed = found.add(&groups[3][..shares[3]]);
    let least = match source {
        InitSource::Random => count,
        InitSource::Auto => ((count as f64 * SHARE_AT_LEAST) as usize).max(1),
        _ => 0,
    };
    let missing = least.saturating_sub(found.cloud.positions.len()).max(reserved);
    found.random = found.add(&volume::random_points(&set, missing, seed.child("random")));
    Ok(found)
}

/// Points from depth maps; of a rig of cameras that stand still, with those that later frames reveal.
fn reconstruct(scene: &Scene, set: &WorkSet, seed: Seed) -> Fused {
    let fused = |set: &WorkSet, seed: Seed| {
        let maps = sweep::depth_maps(set);
        fuse::fuse(set, &maps, seed)
    };
    let mut all = fused(set, seed.child("guess"));
    // What cannot be loaded is met again in training; without it the first frame has to do.
    if let Some(later) = revealed::later_frame(scene, set) {
        all.matched.extend(fused(&later, seed.child("guess-later")).matched);
    }
    if set.foreground == Foreground::Whole
        && let Some(hull) = Hull::find(set)
    {
        for group in [&mut all.matched, &mut all.between, &mut all.guessed] {
            group.retain(|c| hull.may_hold(c.position));
        }
    }
    all
}

/// How many of the `available` points of each kind are taken: its share of `count`, the first kind what the others leave, and whatever is left over to those
/// that have more.
fn share_out(available: [usize; 4], wanted: [f64; 4], count: usize) -> [usize; 4] {
    let mut taken = [0; 4];
    for kind in [2, 1, 3, 0] {
        let left = count - taken.iter().sum::<usize>();
        taken[kind] = available[kind].min((count as f64 * wanted[kind]) as usize).min(left);
    }
    for kind in [0, 1, 2] {
        let left = count - taken.iter().sum::<usize>();
        taken[kind] = available[kind].min(taken[kind] + left);
    }
    taken
}

/// One candidate, the most confident, per cube, in random order. Cubes have the edge `cell` up to the distance `far`, and twice that from every doubling of it
/// on: images resolve no more there.
fn thin(candidates: Vec<Candidate>, cell: f32, far: f32, seed: Seed) -> Vec<Candidate> {
    let mut best: HashMap<(i32, [i32; 3]), usize> = HashMap::new();
    for (i, c) in candidates.iter().enumerate() {
        let level = (c.depth / far).max(1.0).log2().min(20.0).floor();
        let key = (c.position / (cell * level.exp2())).floor().to_array().map(|v| v as i32);
        let slot = best.entry((level as i32, key)).or_insert(i);
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

#[cfg(test)]
mod tests {
    use super::share_out;

    #[test]
    fn shares_use_what_there_is() {
        let wanted = [1.0, 0.25, 0.25, 0.2];
        assert_eq!(share_out([1000; 4], wanted, 100), [30, 25, 25, 20]);
        assert_eq!(share_out([10, 1000, 0, 0], wanted, 100), [10, 90, 0, 0]);
        assert_eq!(share_out([10, 10, 1000, 10], wanted, 100), [10, 10, 70, 10]);
        assert_eq!(share_out([3, 2, 1, 4], wanted, 100), [3, 2, 1, 4]);
        assert_eq!(share_out([0; 4], wanted, 100), [0; 4]);
    }
}
