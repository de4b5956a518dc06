//! Points of several key frames, each with a life and a velocity (FreeTimeGS starts so): what moves is found where it is at each of them, instead of being
//! followed from the first frame.
//!
//! Where several cameras see each frame, the images of a key frame give points as those of the first frame do. How long a point is there is judged by its
//! colour: it is alive at another key frame while most of the images that show it have the same colour there. What the median images over time show stands
//! still: it is alive where something passes before it, too. The velocity is the one with which a point is found again at the neighbouring key frames, searched
//! at random and handed on between neighbours as in PatchMatch (Barnes et al. 2009).

mod images;
mod motion;

use super::choose::{Arrangement, Choice};
use super::views::WorkSet;
use super::{Candidate, fuse, sweep, thin};
use cc4dgs_core::{Result, Scene, Seed, Split, View};
use glam::Vec3;
use images::{KeySet, KeyView, most_pixels};
use rayon::prelude::*;
use std::collections::HashMap;

/// Mean difference of the channels, 0..1, up to which a pixel shows a point.
const SIMILAR: f32 = 0.1;
/// The same of one camera at two times, where its pixel shows the same and the images have little noise.
const UNCHANGED: f32 = 0.06;
/// Images that must show a point at its own frame.
const LEAST_IMAGES: usize = 2;
/// Share of those images that must still show it at another.
const ALIVE: f32 = 0.5;
/// Fewest key frames whose median images say what stands still, and the share of them for which something may hide it at a time.
const LEAST_FRAMES: usize = 5;
const HIDDEN: f32 = 0.25;

/// The most matched points of all key frames that are kept at once, of 32 bytes each.
const MOST_FOUND: usize = 8 << 20;
/// Least time from one key frame to the next, as a share of the sequence: frames may claim to be simultaneous.
pub(crate) const LEAST_INTERVAL: f64 = 1e-4;

/// What was looked for, or the reason why there is none and what to do, in sentences.
pub(crate) type Found<T> = std::result::Result<T, String>;

/// What a point is and when it is there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct KeyPoint {
    /// In the scene's units.
    pub position: Vec3,
    pub color: [f32; 3],
    /// Index of the key frame at which it is at `position`.
    pub key: usize,
    /// The first and the last key frame at which it is there without moving.
    pub alive: [usize; 2],
    /// Scene units per sequence.
    pub velocity: Vec3,
}

/// The images of all key frames, and the points that match in them.
pub(crate) struct KeyFrames {
    /// The time of each key frame, 0..1, as its views state it, ascending; the first is that of frame 0.
    pub times: Vec<f64>,
    sets: Vec<KeySet>,
    found: Vec<Vec<Candidate>>,
    /// The median over all key frames of each pixel of each view; empty where there are too few of them.
    still: Vec<Vec<[u8; 3]>>,
    /// Mean difference of the channels up to which a pixel of one camera shows the same at two times.
    unchanged: f32,
}

impl KeyFrames {
    /// Every `every`-th frame of `scene` (at least 1), with points of the pixels for which `moves` (camera of the scene, share of the width, share of the
    /// height) says so. Frames that lack an image of a camera are left out. Key frames are in the order of their times. Where the scene has none, the reason
    /// and what to do: cameras do not share times, or fewer than two of these frames, the first among them, have images of all cameras, or frame 0 is not the
    /// earliest. Differences up to `noise`, 0..1, are none. Each thread holds one whole image at a time; those that are kept are small.
    ///
    /// # Errors
    /// Whatever decoding the images meets.
    pub(crate) fn load(scene: &Scene, every: usize, moves: impl Fn(usize, f32, f32) -> bool, noise: f32, seed: Seed) -> Result<Found<Self>> {
        let choice = Choice::new(scene);
        if choice.arrangement != Arrangement::OneTime {
            return Ok(Err("points need several cameras at each time. Set train.key_frames = 0".into()));
        }
        let cameras: Vec<usize> = choice.views.iter().map(|&v| scene.views[v].camera).collect();
        let complete = match complete_frames(&scene.views, &cameras, scene.frame_count, every) {
            Ok(complete) => complete,
            Err(reason) => return Ok(Err(reason)),
        };
        // The medians are as many images as one key frame has.
        let pixels = most_pixels((complete.len() + 1) * cameras.len());
        let most_found = MOST_FOUND / complete.len();
        let mut loaded = Self { times: Vec::new(), sets: Vec::new(), found: Vec::new(), still: Vec::new(), unchanged: UNCHANGED.max(noise) };
        for (frame, views) in complete {
            let time = time_of(&scene.views, &views);
            let mut set = WorkSet::load(scene, Choice { views, ..choice.clone() })?;
            for (view, &camera) in set.views.iter_mut().zip(&cameras) {
                let level = view.fine();
                let (w, h) = (level.width, level.height);
                let drawn = |p: usize| view.opaque.as_ref().is_none_or(|o| o[p]);
                let share = |i: usize, n: usize| (i as f32 + 0.5) / n as f32;
                view.opaque = Some((0..w * h).map(|p| drawn(p) && moves(camera, share(p % w, w), share(p / w, h))).collect());
            }
            let mut found = candidates(&set, seed.index(frame as u64));
            // They come in random order.
            found.truncate(most_found);
            found.shrink_to_fit();
            loaded.found.push(found);
            // From here on nothing but colours is asked.
            loaded.sets.push(KeySet::new(set, pixels));
            loaded.times.push(time);
        }
        loaded.still = medians(&loaded.sets);
        Ok(Ok(loaded))
    }

    /// Up to `count` points that are not there at all key frames, or are hidden at the first.
    pub(crate) fn points(&self, count: usize, seed: Seed) -> Vec<KeyPoint> {
        let each = count / self.sets.len();
        let mut points = Vec::new();
        for (key, candidates) in self.found.iter().enumerate() {
            let known = Grid::new(self.sets[key].cell, &points);
            let judged = self.judge(candidates.iter().map(|c| (c.position, c.color)).collect(), key);
            let new = |p: &KeyPoint| (!self.always(p) || !self.shows(0, p)) && !known.has(p);
            let mut own: Vec<KeyPoint> = judged.into_iter().flatten().filter(new).take(each).collect();
            self.set_in_motion(&mut own, seed.index(key as u64));
            points.extend(own);
        }
        points
    }

    /// When each of the given points (position, colour) of key frame `key` is there; `None` for those that hardly an image shows.
    pub(crate) fn judge(&self, points: Vec<(Vec3, [f32; 3])>, key: usize) -> Vec<Option<KeyPoint>> {
        points.into_par_iter().map(|(position, color)| self.judge_one(position, color, key)).collect()
    }

    fn judge_one(&self, position: Vec3, color: [f32; 3], key: usize) -> Option<KeyPoint> {
        let sightings = self.sightings(position, color, key);
        if sightings.len() < LEAST_IMAGES {
            return None;
        }
        let count = self.sets.len();
        let stands = !self.still.is_empty() && self.share(&sightings, None) >= ALIVE;
        let hidden = if stands { (HIDDEN * count as f32) as usize } else { 0 };
        let alive = reach(|other| self.share(&sightings, Some(other)) >= ALIVE, count, key, hidden);
        Some(KeyPoint { position, color, key, alive, velocity: Vec3::ZERO })
    }

    /// Whether a point is there at all key frames.
    pub(crate) fn always(&self, point: &KeyPoint) -> bool {
        point.alive == [0, self.sets.len() - 1]
    }

    /// The pixels of `key` that show a point.
    fn sightings(&self, position: Vec3, color: [f32; 3], key: usize) -> Vec<Sighting> {
        let of = |(view, drawn): (usize, &KeyView)| {
            let pixel = drawn.pixel_of(position)?;
            let seen = images::color(drawn.rgb[pixel]);
            (difference(seen, color) < SIMILAR).then_some(Sighting { view, pixel, color: seen })
        };
        self.sets[key].views.iter().enumerate().filter_map(of).collect()
    }

    /// The share of `sightings` whose pixels are the same at the key frame `other`, or in the medians over time.
    fn share(&self, sightings: &[Sighting], other: Option<usize>) -> f32 {
        let same = |s: &&Sighting| {
            let colors = other.map_or_else(|| &self.still[s.view], |other| &self.sets[other].views[s.view].rgb);
            colors.get(s.pixel).is_some_and(|&other| difference(images::color(other), s.color) < self.unchanged)
        };
        sightings.iter().filter(same).count() as f32 / sightings.len().max(1) as f32
    }

    /// Whether most images that show a point at its own frame do so at `key`, too.
    fn shows(&self, key: usize, point: &KeyPoint) -> bool {
        self.share(&self.sightings(point.position, point.color, point.key), Some(key)) >= ALIVE
    }
}

/// The frames with an image of each of `cameras` for training, of every `every`-th of `count` frames, and these images in the order of `cameras`. Ordered by
/// time: a dataset may number its frames otherwise. A reason for fewer than two, or if frame 0 is not the first: nothing says what moves on from there.
fn complete_frames(views: &[View], cameras: &[usize], count: usize, every: usize) -> Found<Vec<(usize, Vec<usize>)>> {
    let mut at: HashMap<(usize, usize), usize> = HashMap::new();
    for (index, view) in views.iter().enumerate().filter(|(_, view)| view.split == Split::Train) {
        at.entry((view.frame, view.camera)).or_insert(index);
    }
    let views_of = |frame: usize| cameras.iter().map(|&camera| at.get(&(frame, camera)).copied()).collect::<Option<Vec<usize>>>();
    let mut complete: Vec<(usize, Vec<usize>)> = (0..count).step_by(every).filter_map(|frame| Some((frame, views_of(frame)?))).collect();
    complete.sort_by(|(_, a), (_, b)| time_of(views, a).total_cmp(&time_of(views, b)));
    match complete.iter().position(|(frame, _)| *frame == 0) {
        None => Err("frame 0 lacks an image of a camera for training. Complete it, or begin with another frame (scene.frames)".into()),
        Some(_) if complete.len() < 2 => {
            let asked = count.div_ceil(every);
            Err(format!("of {asked} key frames, only frame 0 has images of all cameras for training. Choose another train.key_frames than {every}"))
        }
        Some(0) => Ok(complete),
        Some(_) => Err("frame 0 is not the earliest. Number the frames of the dataset by their times".into()),
    }
}

/// The time of a key frame: that of the first of its images, whose indices in `views` are `own`.
fn time_of(views: &[View], own: &[usize]) -> f64 {
    own.first().map_or(0.0, |&view| f64::from(views[view].time_norm))
}

/// Points by the cube that they are in.
struct Grid {
    cell: f32,
    points: HashMap<[i32; 3], Vec<KeyPoint>>,
}

impl Grid {
    fn new(cell: f32, points: &[KeyPoint]) -> Self {
        let mut grid = Self { cell, points: HashMap::new() };
        for point in points {
            grid.points.entry(grid.cube(point.position)).or_default().push(*point);
        }
        grid
    }
    fn cube(&self, position: Vec3) -> [i32; 3] {
        (position / self.cell).floor().to_array().map(|v| v as i32)
    }
    /// Whether a point of an earlier key frame is `point` as well: within a cell of it, there at its time, and of its colour.
    fn has(&self, point: &KeyPoint) -> bool {
        let near = |other: &KeyPoint| other.position.distance(point.position) < self.cell;
        let same = |other: &KeyPoint| near(other) && (other.alive[0]..=other.alive[1]).contains(&point.key) && difference(other.color, point.color) < SIMILAR;
        let home = self.cube(point.position);
        let around = (0..27).map(|k| [home[0].saturating_add(k % 3 - 1), home[1].saturating_add(k / 3 % 3 - 1), home[2].saturating_add(k / 9 - 1)]);
        around.flat_map(|cube| self.points.get(&cube).into_iter().flatten()).any(same)
    }
}

/// A pixel that shows a point at its own key frame.
struct Sighting {
    view: usize,
    pixel: usize,
    /// RGB in 0..1.
    color: [f32; 3],
}

/// The points that match at one key frame.
fn candidates(set: &WorkSet, seed: Seed) -> Vec<Candidate> {
    let mut fused = fuse::fuse(set, &sweep::depth_maps(set), seed.child("guess"));
    fused.matched.append(&mut fused.between);
    let far = set.rig.distance.unwrap_or(f64::INFINITY) as f32;
    thin(fused.matched, set.cell_size(), far, seed.child("matched"))
}

/// The first and the last of `count` indices up to which `there` reaches from `from`, over gaps of up to `hidden` each; a gap at either end is one, too.
/// Nothing is asked beyond a longer gap.
fn reach(there: impl Fn(usize) -> bool, count: usize, from: usize, hidden: usize) -> [usize; 2] {
    let along = |indices: &mut dyn Iterator<Item = usize>| {
        let (mut end, mut last) = (from, from);
        for i in indices {
            last = i;
            if there(i) {
                end = i;
            } else if i.abs_diff(end) > hidden {
                return end;
            }
        }
        last
    };
    [along(&mut (0..from).rev()), along(&mut (from + 1..count))]
}

/// The median over all sets of each pixel of each view; none of too few sets.
fn medians(sets: &[KeySet]) -> Vec<Vec<[u8; 3]>> {
    let views = if sets.len() < LEAST_FRAMES { 0 } else { sets[0].views.len() };
    let of = |v: usize| {
        let pixels = sets.iter().map(|set| set.views[v].rgb.len()).min().unwrap_or(0);
        let median = |p: usize| {
            [0, 1, 2].map(|k| {
                let mut values: Vec<u8> = sets.iter().map(|set| set.views[v].rgb[p][k]).collect();
                *values.select_nth_unstable(sets.len() / 2).1
            })
        };
        (0..pixels).into_par_iter().map(median).collect()
    };
    (0..views).map(of).collect()
}

/// How much a view differs from a point where it would show it; `None` outside the image.
fn shown(view: &KeyView, position: Vec3, color: [f32; 3]) -> Option<f32> {
    view.pixel_of(position).map(|p| difference(images::color(view.rgb[p]), color))
}

fn difference(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]).abs()).sum::<f32>() / 3.0
}

#[cfg(test)]
mod tests;
