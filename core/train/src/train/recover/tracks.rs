//! Straight tracks through sightings from several cameras at several times: where a compact thing was, and how fast.
//!
//! A sighting says that the thing is somewhere on a ray at a time. For a point p with velocity v, the distance to each ray is linear in (p, v), so that three
//! rays from different positions give a track, and more of them give the one of least squares.

use cc4dgs_core::Seed;
use glam::{DMat3, DVec3};
use rand::Rng;
use std::collections::BTreeSet;

/// Tracks that are tried.
const TRIALS: usize = 2000;
/// Fewest images that must agree; the share of the images of the window that show anything; and how many are enough in any case.
const LEAST_IMAGES: usize = 4;
const LEAST_SHARE: f64 = 0.5;
const ENOUGH_IMAGES: usize = 8;
/// A ray agrees when it passes within this share of the radius, plus so many pixels.
const WITHIN_RADIUS: f64 = 0.5;
const WITHIN_PIXELS: f64 = 1.0;
/// Radii of one thing differ by at most this factor.
const SIZE_FACTOR: f64 = 1.6;
/// Least [`parallax`] in radians: else its distance is a guess.
const LEAST_PARALLAX: f64 = 0.1;
/// Steps of the inverse iteration for it.
const STEPS: usize = 24;
/// Least depth of a thing in front of a camera.
const LEAST_DEPTH: f64 = 0.05;

/// A compact region in an image, as a ray.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sighting {
    /// Index of the view among those that were looked at.
    pub image: usize,
    /// Time of the view, 0..1.
    pub time: f64,
    /// The camera centre.
    pub origin: DVec3,
    /// Unit vector through the centre of the region.
    pub direction: DVec3,
    /// Radius of the region over the focal length, both in pixels.
    pub size: f64,
    /// A pixel over the focal length.
    pub pixel: f64,
}

/// A point that moves along a line for a while.
#[derive(Clone, Debug)]
pub(super) struct Track {
    /// The time at which it is at `position`, 0..1.
    pub time: f64,
    pub position: DVec3,
    /// World units per sequence.
    pub velocity: DVec3,
    /// Radius of the thing in world units.
    pub radius: f64,
    /// Indices of the sightings that agree.
    pub sightings: Vec<usize>,
}

impl Track {
    /// Where it is at `time`.
    pub fn at(&self, time: f64) -> DVec3 {
        self.position + self.velocity * (time - self.time)
    }
}

/// The track around `time` that most images agree on, of the sightings with the indices `among`.
pub(super) fn best_track(sightings: &[Sighting], among: &[usize], time: f64, seed: Seed) -> Option<Track> {
    let images: BTreeSet<usize> = among.iter().map(|&i| sightings[i].image).collect();
    let needed = ((LEAST_SHARE * images.len() as f64).ceil() as usize).clamp(LEAST_IMAGES, ENOUGH_IMAGES);
    if images.len() < needed {
        return None;
    }
    let mut random = seed.rng();
    let mut best: Option<Track> = None;
    for _ in 0..TRIALS {
        let three: Vec<usize> = (0..3).map(|_| among[random.random_range(0..among.len())]).collect();
        let distinct: BTreeSet<usize> = three.iter().map(|&i| sightings[i].image).collect();
        if distinct.len() < 3 {
            continue;
        }
        let Some(track) = fit(sightings, three, time).and_then(|track| agreeing(sightings, among, track)) else { continue };
        if best.as_ref().is_none_or(|b| track.sightings.len() > b.sightings.len()) {
            best = Some(track);
        }
    }
    // Twice from all that agree: the first fit is of three rays.
    for _ in 0..2 {
        best = best.and_then(|track| fit(sightings, track.sightings, time)).and_then(|track| agreeing(sightings, among, track));
    }
    best.filter(|track| track.sightings.len() >= needed && parallax(sightings, &track.sightings) >= LEAST_PARALLAX)
}

/// The track of least squares through the rays of `chosen`.
fn fit(sightings: &[Sighting], chosen: Vec<usize>, time: f64) -> Option<Track> {
    let [x, y, z, u, v, w] = solve(normal_equations(sightings, &chosen, |s| s.time - time))?;
    let (position, velocity) = (DVec3::new(x, y, z), DVec3::new(u, v, w));
    let mut track = Track { time, position, velocity, radius: 0.0, sightings: chosen };
    let mut radii: Vec<f64> = track.sightings.iter().map(|&i| sightings[i].size * depth(&sightings[i], &track)).collect();
    radii.sort_unstable_by(f64::total_cmp);
    track.radius = radii[radii.len() / 2];
    (track.radius.is_finite() && track.radius > 0.0).then_some(track)
}

/// The normal equations of the track of least squares through the rays of `chosen`, for position and velocity, with the right side in the last column. `clock`
/// is the time of a sighting that the velocity refers to.
fn normal_equations(sightings: &[Sighting], chosen: &[usize], clock: impl Fn(&Sighting) -> f64) -> [[f64; 7]; 6] {
    let mut system = [[0.0f64; 7]; 6];
    for &i in chosen {
        let s = &sightings[i];
        let across = DMat3::IDENTITY - DMat3::from_cols(s.direction * s.direction.x, s.direction * s.direction.y, s.direction * s.direction.z);
        let (target, tau) = (across * s.origin, clock(s));
        for row in 0..3 {
            for column in 0..3 {
                let value = across.col(column)[row];
                system[row][column] += value;
                system[row][column + 3] += tau * value;
                system[row + 3][column] += tau * value;
                system[row + 3][column + 3] += tau * tau * value;
            }
            system[row][6] += target[row];
            system[row + 3][6] += tau * target[row];
        }
    }
    system
}

/// `track` with the sightings that agree with it, at most one of each image; `None` where fewer than three do.
fn agreeing(sightings: &[Sighting], among: &[usize], mut track: Track) -> Option<Track> {
    let mut best: std::collections::BTreeMap<usize, (f64, usize)> = std::collections::BTreeMap::new();
    for &i in among {
        let s = &sightings[i];
        let (depth, size) = (depth(s, &track), s.size);
        if depth < LEAST_DEPTH {
            continue;
        }
        let towards = track.at(s.time) - s.origin;
        let miss = (towards - s.direction * towards.dot(s.direction)).length() / depth;
        let ratio = size * depth / track.radius;
        if miss <= WITHIN_RADIUS * size + WITHIN_PIXELS * s.pixel && (SIZE_FACTOR.recip()..=SIZE_FACTOR).contains(&ratio) {
            let entry = best.entry(s.image).or_insert((miss, i));
            if miss < entry.0 {
                *entry = (miss, i);
            }
        }
    }
    track.sightings = best.into_values().map(|(_, i)| i).collect();
    (track.sightings.len() >= 3).then_some(track)
}

/// Distance along the ray.
fn depth(sighting: &Sighting, track: &Track) -> f64 {
    (track.at(sighting.time) - sighting.origin).dot(sighting.direction)
}

/// How well the rays of `chosen` fix a track: the angle in radians between the rays of two standing cameras that see it at all times and fix it as well.
///
/// A change of position and velocity shifts the thing at each time. Of all changes, take the one that the rays show least: its part across the rays is a share
/// of the whole (root mean squares), and the angle is twice the arc sine of that share. The angle between the rays themselves says nothing where camera and
/// thing both move: a camera that goes along a line at constant speed sees the same rays of things at any distance, each on a straight track of its own.
fn parallax(sightings: &[Sighting], chosen: &[usize]) -> f64 {
    let n = chosen.len().max(1) as f64;
    let mean = chosen.iter().map(|&i| sightings[i].time).sum::<f64>() / n;
    let spread = (chosen.iter().map(|&i| (sightings[i].time - mean).powi(2)).sum::<f64>() / n).sqrt();
    if spread.is_nan() || spread <= 0.0 {
        return 0.0;
    }
    // With times of mean 0 and variance 1, the mean square of a shift is the squared length of its six numbers.
    let mut system = normal_equations(sightings, chosen, |s| (s.time - mean) / spread);
    // Inverse iteration: `change` becomes the eigenvector of the least eigenvalue.
    let (mut change, mut eigenvalue) = ([1.0, 0.9, 0.8, 0.7, 0.6, 0.5], 0.0f64);
    for _ in 0..STEPS {
        let length = change.iter().map(|v| v * v).sum::<f64>().sqrt();
        system.iter_mut().zip(change).for_each(|(row, value)| row[6] = value / length);
        let Some(solution) = solve(system) else { return 0.0 };
        change = solution;
        eigenvalue = change.iter().map(|v| v * v).sum::<f64>().sqrt().recip();
    }
    2.0 * (eigenvalue / n).sqrt().min(1.0).asin()
}

/// Solves six equations with the right side in the last column, by elimination with pivots; `None` where they are (nearly) singular.
fn solve(mut system: [[f64; 7]; 6]) -> Option<[f64; 6]> {
    for column in 0..6 {
        let pivot = (column..6).max_by(|&a, &b| system[a][column].abs().total_cmp(&system[b][column].abs()))?;
        system.swap(column, pivot);
        let top = system[column];
        if top[column].is_nan() || top[column].abs() <= 1e-9 {
            return None;
        }
        for (row, values) in system.iter_mut().enumerate() {
            if row != column {
                let factor = values[column] / top[column];
                values.iter_mut().zip(top).for_each(|(value, above)| *value -= factor * above);
            }
        }
    }
    let mut solution = [0.0; 6];
    (0..6).for_each(|row| solution[row] = system[row][6] / system[row][row]);
    Some(solution)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sightings of a ball from cameras around it, one image per time, and one false sighting in every image.
    fn scene() -> Vec<Sighting> {
        let mut random = Seed::root(3).rng();
        let mut sightings = Vec::new();
        for image in 0..8 {
            let time = 0.4 + 0.01 * image as f64;
            let angle = 2.4 * image as f64;
            let origin = DVec3::new(4.0 * angle.cos(), 1.0 + 0.2 * image as f64, 4.0 * angle.sin());
            let ball = DVec3::new(0.5, 0.3, -0.2) + DVec3::new(2.0, -1.0, 0.5) * (time - 0.43);
            let distance = (ball - origin).length();
            let mut add = |direction: DVec3, size: f64| sightings.push(Sighting { image, time, origin, direction, size, pixel: 0.005 });
            add((ball - origin) / distance, 0.25 / distance);
            let elsewhere = DVec3::new(random.random::<f64>() - 0.5, random.random::<f64>() - 0.5, random.random::<f64>() - 0.5) * 2.0;
            add((elsewhere - origin).normalize(), 0.06);
        }
        sightings
    }

    #[test]
    fn a_moving_ball_is_found_among_false_sightings() {
        let sightings = scene();
        let all: Vec<usize> = (0..sightings.len()).collect();
        let track = best_track(&sightings, &all, 0.43, Seed::root(1)).unwrap();
        assert!((track.position - DVec3::new(0.5, 0.3, -0.2)).length() < 1e-3, "{track:?}");
        assert!((track.velocity - DVec3::new(2.0, -1.0, 0.5)).length() < 0.05, "{track:?}");
        assert!((track.radius - 0.25).abs() < 0.01 && track.sightings.len() == 8, "{track:?}");
    }

    #[test]
    fn a_track_needs_places_that_fix_its_distance() {
        let seen = |image: usize, step: usize, origin: DVec3| {
            let time = 0.4 + 0.01 * step as f64;
            let way = DVec3::new(0.1, 0.2, 0.0) + DVec3::new(1.0, -0.5, 0.3) * (time - 0.43) - origin;
            Sighting { image, time, origin, direction: way.normalize(), size: 0.25 / way.length(), pixel: 0.005 }
        };
        let all: Vec<usize> = (0..8).collect();
        let of = |position: &dyn Fn(f64) -> DVec3| (0..8).map(|i| seen(i, i, position(i as f64))).collect::<Vec<Sighting>>();
        let passing = of(&|i: f64| DVec3::new(0.5 * i - 2.0, 0.0, -4.0));
        let slow_orbit = of(&|i: f64| DVec3::new(4.0 * (0.05 * i).sin(), 1.0, -4.0 * (0.05 * i).cos()));
        let turning = of(&|_: f64| DVec3::new(0.0, 0.0, -4.0));
        assert!(passing[0].direction.angle_between(passing[7].direction) > 0.5 && slow_orbit[0].direction.angle_between(slow_orbit[7].direction) > 0.2);
        for sightings in [&passing, &slow_orbit, &turning] {
            assert!(parallax(sightings, &all) < 0.3 * LEAST_PARALLAX, "{}", parallax(sightings, &all));
            assert!(best_track(sightings, &all, 0.43, Seed::root(1)).is_none());
        }
        // Two cameras that stand still, 0.2 rad apart.
        let rig: Vec<Sighting> = (0..8).map(|i| seen(i, i / 2, DVec3::new(if i % 2 == 0 { -0.4 } else { 0.4 }, 0.0, -4.0))).collect();
        assert!((0.17..0.23).contains(&parallax(&rig, &all)), "{}", parallax(&rig, &all));
        // Three rays of two cameras hardly say how fast a thing comes nearer; those of four do.
        let corner = |i: usize| DVec3::new(if i.is_multiple_of(2) { -0.4 } else { 0.4 }, if i % 4 < 2 { -0.4 } else { 0.4 }, -4.0);
        let square: Vec<Sighting> = (0..8).map(|i| seen(i, i, corner(i))).collect();
        assert!(best_track(&square, &all, 0.43, Seed::root(1)).is_some());
        // At one time nothing says how fast it is.
        let once: Vec<Sighting> = (0..8).map(|i| seen(i, 0, DVec3::new(i as f64 - 4.0, 0.0, -4.0))).collect();
        assert_eq!((parallax(&once, &all), parallax(&once, &[])), (0.0, 0.0));
    }

    #[test]
    fn too_few_or_disagreeing_sightings_give_none() {
        let sightings = scene();
        assert!(best_track(&sightings, &[0, 2, 4], 0.43, Seed::root(1)).is_none());
        let wrong: Vec<usize> = (0..sightings.len()).filter(|i| i % 2 == 1).collect();
        assert!(best_track(&sightings, &wrong, 0.43, Seed::root(1)).is_none());
        assert!(best_track(&sightings, &[], 0.43, Seed::root(1)).is_none());
    }
}
