//! How much of what one camera sees others see, from calibration alone. What stands in front of what is not known: a point in an image counts as seen.

use crate::data::camera_box;
use crate::sample::spread_from_first;
use cc4dgs_core::{Camera, Scene};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Most poses that are compared with each other: one bit each in [`Seen`]. With the numbers below, two million projections at most.
const MOST_POSES: usize = 64;
/// Pixels per image whose rays are followed, across and down, and points on each ray.
const GRID: [usize; 2] = [8, 6];
const DEPTHS: usize = 6;
/// Most known points that are projected, and the fewest of them in view that are taken instead of points on rays.
const MOST_POINTS: usize = 4096;
const LEAST_POINTS: usize = 100;
/// Where there are more poses than are compared: the nearest others that one is compared with before it is said to share nothing with any.
const NEIGHBOURS: usize = 20;
/// Difference in position, in the scene's units, and of the axes, below which two poses are one.
const SAME_POSE: f64 = 1e-4;
/// Least depth of what a camera sees.
const NEAREST: f64 = 1e-9;
/// Cameras that a warning names.
const NAMED: usize = 4;

/// How much of what one camera sees others see. A moving camera counts once per position.
#[derive(Clone, Debug, PartialEq)]
pub struct Overlap {
    /// Cameras that were compared: of those with different poses at most 64, evenly chosen.
    pub compared: usize,
    /// Half of what a camera sees is in the images of so many of them or more, itself included.
    pub cameras: usize,
    /// Share of what a camera sees that at least two others see.
    pub by_three: f32,
    /// Share of what a camera sees that no other sees.
    pub alone: f32,
    /// Names of those that share nothing with any other.
    pub apart: Vec<String>,
}

impl Overlap {
    /// Compares the cameras of `views`; `None` where all have one pose.
    pub(super) fn of(scene: &Scene, views: &[usize]) -> Option<Self> {
        let all = distinct(scene, views);
        if all.len() < 2 {
            return None;
        }
        let poses: Vec<Pose> = spread_from_first(&all, MOST_POSES).into_iter().map(Pose::new).collect();
        let within = |(low, high): ([f32; 3], [f32; 3])| -> Vec<Vec<DVec3>> {
            let (low, high) = (DVec3::from(low.map(f64::from)), DVec3::from(high.map(f64::from)));
            poses.par_iter().map(|pose| pose.samples(low, high)).collect()
        };
        // A box that no camera sees is not that of the scene.
        let stated = scene.init_box.map(within).filter(|samples| samples.iter().any(|points| !points.is_empty()));
        let samples = stated.unwrap_or_else(|| within(camera_box(scene)));
        // A pose sees the points on its own rays, whatever rounding says.
        let own = |(k, points): (usize, &Vec<DVec3>)| -> Vec<Seen> { points.iter().map(|&point| seen_by(&poses, point) | (1 << k)).collect() };
        let on_rays = samples.par_iter().enumerate().map(own).collect::<Vec<_>>().concat();
        let known = scene.points.as_ref().map(|points| spread_from_first(&points.positions, MOST_POINTS)).unwrap_or_default();
        let known: Vec<Seen> = known.par_iter().map(|point| seen_by(&poses, DVec3::from(point.map(f64::from)))).filter(|seen| *seen != 0).collect();
        // Items by the number of poses that see them. A known point is part of what each of these sees.
        let mut counts = [0u64; MOST_POSES + 1];
        if known.len() >= LEAST_POINTS {
            known.iter().for_each(|seen| counts[seen.count_ones() as usize] += u64::from(seen.count_ones()));
        } else {
            on_rays.iter().for_each(|seen| counts[seen.count_ones() as usize] += 1);
        }
        let total: u64 = counts.iter().sum();
        let mut below = 0u64;
        let cameras = counts.iter().position(|count| {
            below += *count;
            below > total / 2
        })?;
        let share = |counts: &[u64]| (counts.iter().sum::<u64>() as f64 / total as f64) as f32;
        let shared = on_rays.iter().chain(&known).filter(|seen| seen.count_ones() > 1).fold(0, |all: Seen, seen| all | *seen);
        let sampled = poses.len() < all.len();
        let apart = (0..poses.len()).filter(|&k| shared & (1 << k) == 0 && !(sampled && poses[k].has_company(&samples[k], &all)));
        let apart = apart.map(|k| poses[k].camera.name.clone()).collect();
        Some(Self { compared: poses.len(), cameras, by_three: share(&counts[3..]), alone: share(&counts[..2]), apart })
    }

    /// A line of the plan. `noun` is what cameras are called: `cameras`, or `positions` of one camera.
    pub(super) fn describe(&self, noun: &str) -> String {
        let [three, alone] = [self.by_three, self.alone].map(|share| 100.0 * share);
        format!(
            "overlap: half of what a camera sees is seen by {} or more of {} {noun}; {three:.0} % by at least three, {alone:.0} % by one alone",
            self.cameras, self.compared
        )
    }

    /// What is wrong and what to do, where cameras share nothing with any other.
    pub(super) fn warning(&self) -> Option<String> {
        let (first, rest) = (self.apart.get(..NAMED).unwrap_or(&self.apart), self.apart.len().saturating_sub(NAMED));
        let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
        let [whose, poses] = if self.apart.len() > 1 { ["cameras", "their poses"] } else { ["camera", "its pose"] };
        (!first.is_empty()).then(|| {
            format!(
                "by the poses, nothing that is seen by the {whose} {}{more} is seen by any other, so that its depth cannot be known. Check {poses}, the axes \
                 (OpenGL or OpenCV) and focal lengths, or hold out what does not belong to the scene (scene.test_cameras)",
                first.join(", ")
            )
        })
    }
}

/// Which of the poses see a point, a bit each.
type Seen = u64;

fn seen_by(poses: &[Pose], point: DVec3) -> Seen {
    poses.iter().enumerate().fold(0, |seen, (k, pose)| seen | (Seen::from(pose.sees(point)) << k))
}

/// The cameras of `views` whose poses differ, in order of the views.
fn distinct<'a>(scene: &'a Scene, views: &[usize]) -> Vec<&'a Camera> {
    let (mut indices, mut poses) = (BTreeSet::new(), BTreeSet::new());
    let new = views.iter().map(|&view| scene.views[view].camera).filter(|&index| indices.insert(index));
    new.map(|index| &scene.cameras[index]).filter(|camera| poses.insert(rounded_pose(camera))).collect()
}

/// Position, right and forward axis in steps of [`SAME_POSE`].
fn rounded_pose(camera: &Camera) -> [i64; 9] {
    let ([x, y, z], m) = (camera.center_world(), &camera.world_to_camera);
    [x, y, z, m[0][0], m[0][1], m[0][2], m[2][0], m[2][1], m[2][2]].map(|value| (value / SAME_POSE).round() as i64)
}

/// A camera, with what its projection needs.
struct Pose<'a> {
    camera: &'a Camera,
    rotation: DMat3,
    translation: DVec3,
}

impl<'a> Pose<'a> {
    fn new(camera: &'a Camera) -> Self {
        let (rotation, translation) = camera.rotation_translation();
        Self { camera, rotation, translation }
    }

    /// Whether a point is in front of the camera and inside its image. Readers have undone lenses, so the projection is that of a pinhole.
    fn sees(&self, point: DVec3) -> bool {
        let (camera, p) = (self.camera, self.rotation * point + self.translation);
        let (u, v) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
        p.z > NEAREST && u >= 0.0 && v >= 0.0 && u <= f64::from(camera.width) && v <= f64::from(camera.height)
    }

    /// Points on the rays of a grid of pixels, evenly over the part of a ray that lies in the box.
    fn samples(&self, low: DVec3, high: DVec3) -> Vec<DVec3> {
        let (camera, center, to_world) = (self.camera, DVec3::from(self.camera.center_world()), self.rotation.transpose());
        let middle = |k: usize, parts: usize| (k as f64 + 0.5) / parts as f64;
        let ray = |k: usize| {
            let u = middle(k % GRID[0], GRID[0]) * f64::from(camera.width);
            let v = middle(k / GRID[0], GRID[1]) * f64::from(camera.height);
            to_world * DVec3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0)
        };
        let points = |ray: DVec3| -> Option<Vec<DVec3>> {
            let [near, far] = depths_inside(center, ray, low, high)?;
            Some((0..DEPTHS).map(|k| center + ray * (near + (far - near) * middle(k, DEPTHS))).collect())
        };
        (0..GRID[0] * GRID[1]).filter_map(|k| points(ray(k))).flatten().collect()
    }

    /// Whether one of the nearest other `cameras` sees one of its `points`.
    fn has_company(&self, points: &[DVec3], cameras: &[&Camera]) -> bool {
        let center = DVec3::from(self.camera.center_world());
        let mut others: Vec<(f64, &Camera)> = cameras
            .iter()
            .filter(|camera| !std::ptr::eq(**camera, self.camera))
            .map(|camera| (center.distance_squared(DVec3::from(camera.center_world())), *camera))
            .collect();
        others.sort_by(|a, b| a.0.total_cmp(&b.0));
        others.iter().take(NEIGHBOURS).map(|(_, camera)| Pose::new(camera)).any(|other| points.iter().any(|&point| other.sees(point)))
    }
}

/// Where a ray enters and leaves a box ahead of its start, in lengths of `ray`; these are depths where the ray has depth 1.
fn depths_inside(start: DVec3, ray: DVec3, low: DVec3, high: DVec3) -> Option<[f64; 2]> {
    let (mut near, mut far) = (0.0f64, f64::INFINITY);
    for k in 0..3 {
        if ray[k].abs() < 1e-12 {
            if start[k] < low[k] || start[k] > high[k] {
                return None;
            }
            continue;
        }
        let (a, b) = ((low[k] - start[k]) / ray[k], (high[k] - start[k]) / ray[k]);
        (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
    }
    (far > near && far.is_finite()).then_some([near, far])
}

#[cfg(test)]
mod tests;
