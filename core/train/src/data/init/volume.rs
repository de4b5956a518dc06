//! Random points in the volume that the cameras see, with the colours they see there.

use super::Candidate;
use super::choose::focus_depth;
use super::views::{Foreground, WorkSet, WorkView};
use cc4dgs_core::Seed;
use glam::{DVec3, Vec3};
use rand::Rng;
use rayon::prelude::*;

/// Attempts per point to find one that enough cameras see.
const ATTEMPTS: usize = 32;
/// Cameras that must see a point, where there are that many.
const SEEN_BY: usize = 2;
/// Share of the cameras that must see foreground at a point to give it a colour.
const MIN_FOREGROUND: f32 = 0.2;
/// The nearest point, as a share of the distance of what the cameras look at: uniform in inverse depth, half of the points would be before twice the near end.
const NEAREST: f64 = 0.5;

/// `count` points: in the box where there is nothing but the foreground, else behind random pixels, uniform in inverse depth.
pub(super) fn random_points(set: &WorkSet, count: usize, seed: Seed) -> Vec<Candidate> {
    // One generator per point: the result does not depend on which thread takes it.
    (0..count).into_par_iter().map(|i| random_point(set, seed.index(i as u64))).collect()
}

fn random_point(set: &WorkSet, seed: Seed) -> Candidate {
    let mut rng = seed.rng();
    let mut position = set.rig.point.as_vec3();
    for _ in 0..ATTEMPTS {
        position = if set.foreground == Foreground::Whole {
            set.box_low + (set.box_high - set.box_low) * Vec3::new(rng.random(), rng.random(), rng.random())
        } else {
            let view = &set.views[rng.random_range(0..set.keys)];
            behind_pixel(set, view, [rng.random(), rng.random(), rng.random()])
        };
        if set.views.iter().filter(|v| v.pixel_of(position).is_some()).take(SEEN_BY).count() >= SEEN_BY.min(set.views.len()) {
            break;
        }
    }
    Candidate { position, color: mean_color(set, position), confidence: 0.0, depth: 0.0 }
}

/// The point at the shares `at` of width, height and range of inverse depths of `view`.
fn behind_pixel(set: &WorkSet, view: &WorkView, at: [f64; 3]) -> Vec3 {
    let level = view.fine();
    let focus = focus_depth(view.center, view.rotation.transpose() * DVec3::Z, &set.rig);
    let (most, least) = (1.0 / (NEAREST * focus), 1.0 / view.depth_range[1].max(focus));
    view.unproject(level, at[0] * level.width as f64, at[1] * level.height as f64, 1.0 / (least + (most - least) * at[2]))
}

/// Mean colour of the scene where the images see `p`; grey where hardly any of them shows something.
fn mean_color(set: &WorkSet, p: Vec3) -> [f32; 3] {
    let seen: Vec<Option<[f32; 3]>> =
        set.views.iter().filter_map(|v| v.pixel_of(p).map(|pixel| v.solid(set.foreground, pixel).then(|| v.fine().rgb[pixel]))).collect();
    let solid: Vec<[f32; 3]> = seen.iter().flatten().copied().collect();
    if solid.is_empty() || (solid.len() as f32) < MIN_FOREGROUND * seen.len() as f32 {
        return [0.5; 3];
    }
    std::array::from_fn(|k| solid.iter().map(|c| c[k]).sum::<f32>() / solid.len() as f32)
}
