//! Arrangements of cameras: where they stand, where they look, and which frames they take. Lengths are metres, z is up.

use cc4dgs_core::{Camera, Seed, Split};
use glam::DVec3;
use rand::Rng;
use std::f64::consts::TAU;

/// A moving camera holds out one frame of so many.
const HELD_OUT_EVERY: usize = 6;
/// The share of photos that is held out, as is usual for static scenes.
const HELD_OUT_PHOTOS: usize = 8;

/// One position of a camera, and what it takes there.
#[derive(Clone, Debug, PartialEq)]
pub struct Viewpoint {
    /// Where it stands and looks.
    pub camera: Camera,
    /// The frame it takes; `None` for a camera that takes all.
    pub frame: Option<usize>,
    /// Train or test.
    pub split: Split,
}

/// An arrangement of cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rig {
    /// Two rings around the playground, and held-out cameras between.
    Rings {
        /// Training cameras.
        train: usize,
        /// Held-out cameras.
        test: usize,
    },
    /// On a dome over a room, looking inwards.
    Dome {
        /// Training cameras.
        train: usize,
        /// Held-out cameras, between the training cameras.
        test: usize,
        /// The share of the full circle that the cameras are spread over.
        turns: f64,
    },
    /// A grid of cameras on one side that look forward, their axes converging a little; two cameras between them are held out.
    Grid {
        /// Training cameras side by side.
        columns: usize,
        /// Training cameras above each other.
        rows: usize,
        /// Distance between neighbours.
        spacing: f64,
    },
    /// One camera in a hand that walks around the middle; a sixth of the frames is taken from beside its path and held out.
    Handheld {
        /// The share of the full circle it walks.
        turns: f64,
    },
    /// Photos from all around at one time; every eighth is held out.
    Photos {
        /// All photos.
        count: usize,
    },
    /// One camera per time anywhere on the upper half of a sphere; a sixth is held out.
    Hemisphere,
}

/// A camera that looks at a target.
struct Stand {
    name: String,
    eye: DVec3,
    target: DVec3,
    fov_x_rad: f64,
    split: Split,
    frame: Option<usize>,
}

impl Rig {
    /// Its cameras for images of `size` pixels and a sequence of `frames`, in metres. `seed` is for what is irregular.
    pub fn viewpoints(&self, size: (u32, u32), frames: usize, seed: Seed) -> Vec<Viewpoint> {
        let stands = match *self {
            Self::Rings { train, test } => rings(train, test),
            Self::Dome { train, test, turns } => dome(train, test, turns, seed),
            Self::Grid { columns, rows, spacing } => grid(columns, rows, spacing),
            Self::Handheld { turns } => (0..frames).map(|frame| hand(frame, frames, turns, seed)).collect(),
            Self::Photos { count } => (0..count).map(|i| photo(i, count, seed)).collect(),
            Self::Hemisphere => (0..frames).map(|frame| hemisphere(frame, seed)).collect(),
        };
        let viewpoint = |s: Stand| {
            let camera = Camera::look_at(&s.name, size, s.fov_x_rad, s.eye.to_array(), s.target.to_array(), [0.0, 0.0, 1.0]);
            Viewpoint { camera, frame: s.frame, split: s.split }
        };
        stands.into_iter().map(viewpoint).collect()
    }
}

fn polar(turns: f64, radius: f64, height: f64) -> DVec3 {
    let (s, c) = (turns * TAU).sin_cos();
    DVec3::new(radius * c, radius * s, height)
}

fn rings(train: usize, test: usize) -> Vec<Stand> {
    let target = DVec3::new(0.0, 0.0, 0.55);
    let training = (0..train).map(|i| {
        let (height, radius) = if i % 2 == 0 { (1.3, 4.2) } else { (2.5, 3.8) };
        let eye = polar(i as f64 / train as f64, radius, height);
        Stand { name: format!("train{i:02}"), eye, target, fov_x_rad: 0.85, split: Split::Train, frame: None }
    });
    let held_out = (0..test).map(|i| {
        let turns = (i as f64 + 0.5) / test as f64 + 0.5 / train.max(1) as f64;
        Stand { name: format!("test{i:02}"), eye: polar(turns, 4.0, 1.9), target, fov_x_rad: 0.85, split: Split::Test, frame: None }
    });
    training.chain(held_out).collect()
}

fn dome(train: usize, test: usize, turns: f64, seed: Seed) -> Vec<Stand> {
    let mut rng = seed.rng();
    // A full circle has no ends; an arc has cameras at both.
    let spread = |i: usize, count: usize| if turns < 1.0 { turns * (i as f64 / count.max(2).saturating_sub(1) as f64 - 0.5) } else { i as f64 / count as f64 };
    let mut stands: Vec<Stand> = (0..train)
        .map(|i| {
            let (height, radius) = [(1.25, 2.95), (2.05, 2.8), (1.55, 2.9), (2.6, 2.45)][i % 4];
            let mut jitter = || rng.random_range(-0.5..0.5f64);
            let eye = polar(spread(i, train) + 0.15 * jitter() * turns / train as f64, radius, height + 0.15 * jitter());
            let target = DVec3::new(0.25 * jitter(), 0.25 * jitter(), 0.95 + 0.15 * jitter());
            Stand { name: format!("cam{i:02}"), eye, target, fov_x_rad: 1.1, split: Split::Train, frame: None }
        })
        .collect();
    stands.extend((0..test).map(|i| {
        let middle = (i as f64 + 0.5) / test as f64;
        let at = if turns < 1.0 { turns * (middle - 0.5) } else { middle + 0.5 / train.max(1) as f64 };
        Stand { name: format!("held{i:02}"), eye: polar(at, 2.8, 1.7), target: DVec3::Z * 0.95, fov_x_rad: 1.1, split: Split::Test, frame: None }
    }));
    stands
}

fn grid(columns: usize, rows: usize, spacing: f64) -> Vec<Stand> {
    let middle = DVec3::new(0.0, -1.6, 1.4);
    let stand = |name: String, column: f64, row: f64, split: Split| {
        let offset = spacing * DVec3::new(column - 0.5 * (columns.max(1) - 1) as f64, 0.0, 0.5 * (rows.max(1) - 1) as f64 - row);
        // The outer ones look a third of their offset inwards, and all a little down.
        let target = middle + DVec3::new(0.65 * offset.x, 3.0, 0.65 * offset.z - 0.65);
        Stand { name, eye: middle + offset, target, fov_x_rad: 1.1, split, frame: None }
    };
    let mut stands: Vec<Stand> = (0..columns * rows).map(|i| stand(format!("cam{i:02}"), (i % columns) as f64, (i / columns) as f64, Split::Train)).collect();
    for (i, share) in [0.3, 0.7].into_iter().enumerate() {
        // In the middle of four neighbours.
        let between = |count: usize| (share * (count.max(1) - 1) as f64).floor() + 0.5;
        stands.push(stand(format!("held{i:02}"), between(columns), between(rows).min((rows.max(1) - 1) as f64), Split::Test));
    }
    stands
}

fn is_held_out(frame: usize) -> bool {
    frame % HELD_OUT_EVERY == HELD_OUT_EVERY / 2
}

fn hand(frame: usize, frames: usize, turns: f64, seed: Seed) -> Stand {
    let t = frame as f64 / (frames.max(2) - 1) as f64;
    let phases: [f64; 8] = std::array::from_fn(|k| (seed.child("shake").index(k as u64).value() >> 11) as f64 / (1u64 << 53) as f64 * TAU);
    // Breath, steps and tremor.
    let shake =
        |k: usize| [(5.0, 0.6), (13.0, 0.3), (31.0, 0.1)].iter().enumerate().map(|(j, (f, a))| a * (TAU * f * t + phases[(k + 3 * j) % 8]).sin()).sum::<f64>();
    let held_out = is_held_out(frame);
    // Held-out poses are beside the path, left and right in turn.
    let aside = if !held_out {
        0.0
    } else if (frame / HELD_OUT_EVERY).is_multiple_of(2) {
        0.03
    } else {
        -0.03
    };
    let radius = 2.2 + 0.15 * (TAU * 1.5 * t).sin() + 0.03 * shake(0) - if held_out { 0.1 } else { 0.0 };
    let height = 1.45 + 0.15 * (TAU * 0.8 * t).sin() + 0.03 * shake(1) + if held_out { 0.12 } else { 0.0 };
    let eye = polar(turns * (t - 0.5) + aside + 0.004 * shake(2), radius, height);
    let target = DVec3::new(0.06 * shake(3), 0.06 * shake(4), 1.0 + 0.05 * shake(5));
    let split = if held_out { Split::Test } else { Split::Train };
    Stand { name: format!("{frame:04}"), eye, target, fov_x_rad: 1.1, split, frame: Some(frame) }
}

fn photo(i: usize, count: usize, seed: Seed) -> Stand {
    let mut rng = seed.index(i as u64).rng();
    let mut jitter = || rng.random_range(-0.5..0.5f64);
    // Twice around, first low, then high.
    let share = i as f64 / count as f64;
    let (radius, height) = if 2 * i < count { (2.4, 1.15) } else { (2.7, 1.85) };
    let eye = polar(2.0 * share + 0.02 * jitter(), radius + 0.5 * jitter(), height + 0.35 * jitter());
    let target = DVec3::new(0.4 * jitter(), 0.4 * jitter(), 0.75 + 0.2 * jitter());
    let split = if i.is_multiple_of(HELD_OUT_PHOTOS) { Split::Test } else { Split::Train };
    Stand { name: format!("photo{i:02}"), eye, target, fov_x_rad: 1.1, split, frame: Some(0) }
}

fn hemisphere(frame: usize, seed: Seed) -> Stand {
    let mut rng = seed.index(frame as u64).rng();
    // Uniform heights are uniform on the sphere.
    let (turns, up): (f64, f64) = (rng.random(), rng.random_range(0.03..0.9));
    let target = DVec3::Z * 0.85;
    let eye = target + 4.0 * polar(turns, (1.0 - up * up).sqrt(), up);
    let split = if is_held_out(frame) { Split::Test } else { Split::Train };
    Stand { name: format!("r_{frame:03}"), eye, target, fov_x_rad: 0.58, split, frame: Some(frame) }
}
