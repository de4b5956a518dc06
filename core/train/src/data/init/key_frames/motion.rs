//! The velocities of points of key frames.

use super::super::Candidate;
use super::{KeyFrames, KeyPoint, LEAST_INTERVAL, SIMILAR, Sighting, difference, shown};
use crate::knn::{Neighbour, nearest};
use cc4dgs_core::Seed;
use glam::Vec3;
use rand::Rng;
use rayon::prelude::*;

/// The farthest a point gets between two key frames, as a share of the width of the images.
const FARTHEST: f32 = 0.12;
/// Velocities tried at first, rounds in which neighbours hand theirs on, neighbours asked, and how much better another one must fit.
const TRIES: usize = 12;
const ROUNDS: usize = 4;
const NEIGHBOURS: usize = 6;
const BETTER: f32 = 0.02;

impl KeyFrames {
    /// Finds the velocities of `points`, which are of one key frame, from those that are there at this one only.
    pub(super) fn set_in_motion(&self, points: &mut [KeyPoint], seed: Seed) {
        let Some(key) = points.first().map(|p| p.key) else { return };
        let around = self.adjacent(key);
        let set = &self.sets[key];
        // To the nearer of the neighbouring key frames: the other is farther away in time where key frames between were left out.
        let interval = around.iter().map(|next| next.time.abs()).fold(f32::INFINITY, f32::min);
        let fastest = FARTHEST * set.width * 0.5 * set.cell / interval;
        let sightings: Vec<Vec<Sighting>> = points.par_iter().map(|p| self.sightings(p.position, p.color, key)).collect();
        // The mean similarity over the images that show the point at its own frame.
        let fit = |i: usize, point: &KeyPoint, velocity: Vec3| {
            let at = |next: &Next| {
                let position = point.position + velocity * next.time;
                let similar = |s: &Sighting| {
                    let difference = shown(&self.sets[next.key].views[s.view], position, point.color);
                    difference.map_or(0.0, |d| (1.0 - d / (2.0 * SIMILAR)).max(0.0))
                };
                sightings[i].iter().map(similar).sum::<f32>() / sightings[i].len().max(1) as f32
            };
            around.iter().map(at).sum::<f32>() / around.len().max(1) as f32
        };
        let neighbours = neighbours_of(points);
        let moving = |p: &KeyPoint| p.alive == [key, key];
        let mut best: Vec<(f32, Vec3)> = points.iter().enumerate().map(|(i, p)| (fit(i, p, Vec3::ZERO), Vec3::ZERO)).collect();
        for round in 0..=ROUNDS {
            let before = best.clone();
            best = (0..points.len())
                .into_par_iter()
                .map(|i| {
                    let (point, mut best) = (&points[i], before[i]);
                    if !moving(point) {
                        return best;
                    }
                    let mut random = seed.index(round as u64).index(i as u64).rng();
                    let mut tries: Vec<Vec3> = neighbours[i].iter().map(|&j| before[j].1).collect();
                    if round == 0 {
                        tries = (0..TRIES).filter_map(|_| jump(point, &around, &self.found, fastest, &mut random)).collect();
                    }
                    let reach = fastest * 0.5f32.powi(round as i32 + 2);
                    tries.extend((0..4).map(|k| best.1 + reach * 0.5f32.powi(k) * (Vec3::from_array(random.random()) * 2.0 - 1.0)));
                    for velocity in tries {
                        let score = fit(i, point, velocity);
                        if velocity.length() <= fastest && score > best.0 + BETTER {
                            best = (score, velocity);
                        }
                    }
                    best
                })
                .collect();
        }
        // A single point fits somewhere by chance: neighbours decide together.
        for (i, point) in points.iter_mut().enumerate() {
            let among: Vec<Vec3> = neighbours[i].iter().chain([&i]).map(|&j| best[j].1).collect();
            point.velocity = if moving(point) { median(&among) } else { Vec3::ZERO };
        }
    }

    /// The key frames before and after `key`.
    fn adjacent(&self, key: usize) -> Vec<Next> {
        let next = |other: usize| {
            let time = self.times[other] - self.times[key];
            let time = if time.abs() < LEAST_INTERVAL { LEAST_INTERVAL.copysign(other as f64 - key as f64) } else { time };
            Next { key: other, time: time as f32 }
        };
        [key.checked_sub(1), Some(key + 1)].into_iter().flatten().filter(|&other| other < self.sets.len()).map(next).collect()
    }
}

/// A neighbouring key frame.
struct Next {
    key: usize,
    /// Time until it as a share of the sequence, negative for an earlier one.
    time: f32,
}

/// The velocity from `point` to a candidate of a neighbouring key frame that looks like it, if one drawn at random does.
fn jump(point: &KeyPoint, around: &[Next], found: &[Vec<Candidate>], fastest: f32, random: &mut impl Rng) -> Option<Vec3> {
    for _ in 0..50 {
        let next = &around[random.random_range(0..around.len())];
        let candidates = &found[next.key];
        if candidates.is_empty() {
            continue;
        }
        let there = &candidates[random.random_range(0..candidates.len())];
        let velocity = (there.position - point.position) / next.time;
        if velocity.length() <= fastest && difference(there.color, point.color) < SIMILAR {
            return Some(velocity);
        }
    }
    None
}

/// The indices of the nearest other points of each.
fn neighbours_of(points: &[KeyPoint]) -> Vec<Vec<usize>> {
    let positions: Vec<[f32; 3]> = points.iter().map(|p| p.position.to_array()).collect();
    let of = |found: [Neighbour; NEIGHBOURS]| found.into_iter().filter(|n| n.squared.is_finite()).map(|n| n.index as usize).collect();
    nearest(&positions).into_iter().map(of).collect()
}

/// The median of each coordinate.
fn median(values: &[Vec3]) -> Vec3 {
    let of = |k: usize| {
        let mut sorted: Vec<f32> = values.iter().map(|v| v[k]).collect();
        sorted.sort_unstable_by(f32::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
    };
    Vec3::new(of(0), of(1), of(2))
}
