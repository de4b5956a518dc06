//! Which training views depth is judged from, and which of them are compared with each other.

use super::super::focus::{Focus, focus};
use super::super::normalise::CAMERA_DISTANCE;
use crate::sample::spread_from_first;
use cc4dgs_core::{Camera, Scene, Split};
use glam::{DMat3, DVec3};
use std::collections::BTreeSet;

/// The most images that get a depth map.
const MAX_KEYS: usize = 40;
/// Images a depth map is matched with.
const PARTNERS: usize = 4;
/// Depth maps a depth is compared with, where those are not the partners'.
const WITNESSES: usize = 6;
/// The angle between viewing rays that matches best: wide enough for depth, narrow enough to look alike.
const BEST_ANGLE_RAD: f64 = 0.25;
/// Difference in time, as a share of the sequence, that weighs as much as no angle at all.
const TIME_SHARE: f64 = 0.15;
/// Training cameras at one time that need no other times.
const ENOUGH_AT_ONE_TIME: usize = 4;
/// The most cameras whose positions are compared with each other.
const MAX_POSES: usize = 300;

/// How the training cameras are arranged in space and time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Arrangement {
    /// Several cameras see one time.
    OneTime,
    /// The cameras move: views of different times differ in position, and no time has enough of them.
    AcrossTimes,
    /// All images are from one position, so that nothing says how far anything is.
    OnePose,
}

/// The views to load: first the keys, which get depth maps, then those that are only matched with.
#[derive(Clone)]
pub(super) struct Choice {
    pub arrangement: Arrangement,
    /// Indices into the scene's views.
    pub views: Vec<usize>,
    /// How many of them are keys.
    pub keys: usize,
    /// Per key, positions in `views` of the images it is matched with.
    pub partners: Vec<Vec<usize>>,
    /// Per key, positions in `views` of the keys whose depth maps it is compared with.
    pub witnesses: Vec<Vec<usize>>,
    /// What the training cameras look at.
    pub rig: Focus,
}

impl Choice {
    /// Judges the arrangement of the training cameras and chooses among them.
    pub fn new(scene: &Scene) -> Self {
        let all = scene.split(Split::Train);
        let rig = rig(scene, &all);
        let mut by_frame: Vec<Vec<usize>> = vec![Vec::new(); scene.frame_count];
        all.iter().for_each(|&v| by_frame[scene.views[v].frame].push(v));
        let most = by_frame.iter().map(Vec::len).max().unwrap_or(0);
        let size = rig.distance.unwrap_or(1.0);
        let positions = |views: &[usize]| count_positions(scene, views, 1e-3 * size);
        let wanted = most.min(ENOUGH_AT_ONE_TIME);
        let first = by_frame.into_iter().find(|v| v.len() >= wanted).unwrap_or_default();
        let at_one_time = positions(&first);
        if at_one_time >= ENOUGH_AT_ONE_TIME || (at_one_time >= 2 && positions(&all) < 2 * at_one_time) {
            return Self::matched(scene, Arrangement::OneTime, &first, rig);
        }
        if positions(&all) >= 2 {
            return Self::matched(scene, Arrangement::AcrossTimes, &all, rig);
        }
        let views = spread_from_first(&all, 4);
        let none = vec![Vec::new(); views.len()];
        Self { arrangement: Arrangement::OnePose, keys: views.len(), views, partners: none.clone(), witnesses: none, rig }
    }

    /// Keys evenly spread over `pool`, with partners from all of it.
    fn matched(scene: &Scene, arrangement: Arrangement, pool: &[usize], rig: Focus) -> Self {
        let keys = spread_from_first(pool, MAX_KEYS);
        let across = arrangement == Arrangement::AcrossTimes;
        let pose = |&v: &usize| Pose::new(scene.camera(v), f64::from(scene.views[v].time_norm), &rig);
        let own: Vec<Pose> = keys.iter().map(pose).collect();
        let poses: Vec<Pose> = pool.iter().map(pose).collect();
        let (mut views, count) = (keys.clone(), keys.len());
        let (mut partners, mut witnesses) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for (&key, pose) in keys.iter().zip(&own) {
            let near = nearest(pose, &poses, PARTNERS, |j| pool[j] == key);
            let near = near.into_iter().map(|j| {
                views.iter().position(|&v| v == pool[j]).unwrap_or_else(|| {
                    views.push(pool[j]);
                    views.len() - 1
                })
            });
            partners.push(near.collect::<Vec<_>>());
            let asked = if across { WITNESSES } else { PARTNERS };
            witnesses.push(nearest(pose, &own, asked, |j| keys[j] == key));
        }
        Self { arrangement, views, keys: count, partners, witnesses, rig }
    }
}

/// What the training cameras look at, in the scene's units.
fn rig(scene: &Scene, views: &[usize]) -> Focus {
    let mut used: Vec<usize> = views.iter().map(|&v| scene.views[v].camera).collect();
    used.sort_unstable();
    used.dedup();
    let ray = |&c: &usize| (DVec3::from(scene.cameras[c].center_world()), DVec3::from(scene.cameras[c].forward_world()).normalize_or_zero());
    // Scenes come in the normalised frame: that is how far ahead parallel cameras look.
    focus(&used.iter().map(ray).collect::<Vec<_>>(), Some(CAMERA_DISTANCE))
}

/// How many positions of at most [`MAX_POSES`] cameras of `views` differ by more than `apart`.
fn count_positions(scene: &Scene, views: &[usize], apart: f64) -> usize {
    // Each camera once: of views by frame, every so many may be of one camera.
    let mut known = BTreeSet::new();
    let cameras: Vec<usize> = views.iter().map(|&v| scene.views[v].camera).filter(|&camera| known.insert(camera)).collect();
    let mut found: Vec<DVec3> = Vec::new();
    for camera in spread_from_first(&cameras, MAX_POSES) {
        let center = DVec3::from(scene.cameras[camera].center_world());
        if found.iter().all(|f| f.distance(center) > apart) {
            found.push(center);
        }
    }
    found.len()
}

/// A camera at a time, with nine points it sees at the distance of what the rig looks at.
struct Pose<'a> {
    camera: &'a Camera,
    rotation: DMat3,
    translation: DVec3,
    center: DVec3,
    time: f64,
    samples: Vec<DVec3>,
}

impl<'a> Pose<'a> {
    fn new(camera: &'a Camera, time: f64, rig: &Focus) -> Self {
        let (rotation, translation) = camera.rotation_translation();
        let center = DVec3::from(camera.center_world());
        let depth = focus_depth(center, DVec3::from(camera.forward_world()), rig);
        let size = [f64::from(camera.width), f64::from(camera.height)];
        let at = |i: usize| (2 * i + 1) as f64 / 6.0;
        let sample = |i: usize| {
            let local = DVec3::new((at(i % 3) * size[0] - camera.cx) / camera.fx, (at(i / 3) * size[1] - camera.cy) / camera.fy, 1.0);
            rotation.transpose() * (local * depth - translation)
        };
        Self { camera, rotation, translation, center, time, samples: (0..9).map(sample).collect() }
    }
    fn sees(&self, p: DVec3) -> bool {
        let c = self.rotation * p + self.translation;
        let (u, v) = (self.camera.fx * c.x / c.z + self.camera.cx, self.camera.fy * c.y / c.z + self.camera.cy);
        c.z > 0.0 && u >= 0.0 && v >= 0.0 && u <= f64::from(self.camera.width) && v <= f64::from(self.camera.height)
    }
    /// How unsuitable `other` is for matching: by the angle between the rays to the samples, by what it misses of them, and by the time between.
    fn cost(&self, other: &Self) -> f64 {
        let (mut angle, mut missed) = (0.0, 0.0);
        for p in &self.samples {
            let (a, b) = ((self.center - *p).normalize_or_zero(), (other.center - *p).normalize_or_zero());
            angle += a.dot(b).clamp(-1.0, 1.0).acos() / 9.0;
            missed += if other.sees(*p) { 0.0 } else { 1.0 / 9.0 };
        }
        (angle - BEST_ANGLE_RAD).abs() / BEST_ANGLE_RAD + 2.0 * missed + (self.time - other.time).abs() / TIME_SHARE
    }
}

/// Depth of what the rig looks at in a camera at `center`; the rig's usual distance where that point is not ahead.
pub(super) fn focus_depth(center: DVec3, forward: DVec3, rig: &Focus) -> f64 {
    let usual = rig.distance.unwrap_or(rig.half).max(1e-9);
    let ahead = forward.dot(rig.point - center);
    if ahead > 0.25 * usual { ahead } else { usual }
}

/// The `most` poses of the least cost, the best first. A pose at the same position says nothing of depth.
fn nearest(own: &Pose, poses: &[Pose], most: usize, skip: impl Fn(usize) -> bool) -> Vec<usize> {
    let mut found: Vec<(f64, usize)> = (0..poses.len())
        .filter(|&j| !skip(j) && poses[j].center.distance(own.center) > 1e-9)
        .map(|j| (own.cost(&poses[j]), j))
        .filter(|(cost, _)| cost.is_finite())
        .collect();
    found.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    found.into_iter().take(most).map(|f| f.1).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{NoImages, View};
    use std::sync::Arc;

    /// Fixed cameras side by side that look at the origin, of which frame k has an image of camera k modulo `cameras`.
    fn in_turns(cameras: usize, frames: usize) -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (8, 8), 1.0, [k as f64, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |frame: usize| View { camera: frame % cameras, frame, time_norm: frame as f32 / frames as f32, split: Split::Train };
        Scene::new("s", (0..cameras).map(camera).collect(), (0..frames).map(view).collect(), Arc::new(NoImages), 0).unwrap()
    }

    #[test]
    fn cameras_that_take_turns_stand_at_several_positions() {
        // Every second or fourth of these views, which is as many as are compared, is of the first camera.
        for (cameras, frames) in [(2, 10), (2, 2 * MAX_POSES), (4, 4 * MAX_POSES)] {
            assert_eq!(Choice::new(&in_turns(cameras, frames)).arrangement, Arrangement::AcrossTimes, "{cameras} cameras, {frames} frames");
        }
        assert_eq!(Choice::new(&in_turns(1, 2 * MAX_POSES)).arrangement, Arrangement::OnePose);
    }
}
