//! Views all round a model, for models whose scene is not there.

use crate::orbit::{FOV_X, checked, middle_and_distance};
use cc4dgs_core::{Camera, Error, HostGaussians, Image8, Result, TrainingViews};
use std::ops::RangeInclusive;

/// The golden angle in radians, by which points of a spiral are spread evenly over a sphere.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
/// Up to the share `u` of the views, time runs from 0 to 1 `RUNS[0] * u + RUNS[1] * u²` times: ever faster. At an even pace, some numbers of evenly spaced
/// views would meet the same few times again and again. With these values, 8 views or more are in three quarters of the time at least, mostly in all.
const RUNS: [f64; 2] = [4.6, 4.9];

/// Views all round a model, each of a camera and a time of its own. Nothing was recorded there: they have no images.
///
/// Directions are evenly spread over a sphere, and times over 0..1, which count where the model moves. Every so many views, where that leaves 8 or more, are
/// from all sides and of nearly all of the time.
#[derive(Clone, Debug, PartialEq)]
pub struct OrbitViews {
    views: Vec<(Camera, f32)>,
}

impl OrbitViews {
    /// How many views there may be: fewer leave sides of a model unseen, and codecs look at less than the most.
    pub const COUNTS: RangeInclusive<usize> = 12..=512;
    /// The usual width and height of the images in pixels.
    pub const SIZE: (u32, u32) = (800, 600);

    /// `count` views with images of `size`. The cameras look at the middle of what `gaussians` show, far enough to see most of it, as those of
    /// [`Orbit`](crate::Orbit) do.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a number that is not in [`OrbitViews::COUNTS`] and for empty images, [`Error::Data`] for Gaussians so far away that no camera
    /// can look at them.
    pub fn around(gaussians: &HostGaussians, size: (u32, u32), count: usize) -> Result<Self> {
        if !Self::COUNTS.contains(&count) {
            let remedy = format!("Choose {} to {} views", Self::COUNTS.start(), Self::COUNTS.end());
            return Err(Error::parameter("orbit", format!("{count} views round a model"), remedy));
        }
        let (middle, distance) = middle_and_distance(gaussians, size)?;
        let camera = |(index, direction): (usize, [f64; 3])| {
            let eye: [f64; 3] = std::array::from_fn(|k| middle[k] + distance * direction[k]);
            Camera::look_at(&format!("orbit{index:05}"), size, FOV_X, eye, middle, across(direction))
        };
        let cameras = checked(directions(count).into_iter().enumerate().map(camera).collect(), middle, distance)?;
        Ok(Self { views: cameras.into_iter().zip(times(count)).collect() })
    }
}

impl TrainingViews for OrbitViews {
    fn len(&self) -> usize {
        self.views.len()
    }
    fn kind(&self) -> &'static str {
        "orbit"
    }
    fn has_images(&self) -> bool {
        false
    }
    fn view(&self, index: usize) -> (&Camera, f32) {
        let (camera, time_norm) = &self.views[index];
        (camera, *time_norm)
    }
    fn image(&self, index: usize) -> Result<Image8> {
        let problem = format!("view {index} of {} has no image: nothing was recorded there", self.len());
        Err(Error::parameter("orbit", problem, "Give the scene that the model was trained on (--scene)"))
    }
}

/// `count` directions, a Fibonacci lattice, in the order of [`halve`].
fn directions(count: usize) -> Vec<[f64; 3]> {
    let direction = |k: usize| {
        let z = 1.0 - (2.0 * k as f64 + 1.0) / count as f64;
        let (sin, cos) = (GOLDEN_ANGLE * k as f64).sin_cos();
        let flat = (1.0 - z * z).sqrt();
        [flat * cos, flat * sin, z]
    };
    let mut directions: Vec<[f64; 3]> = (0..count).map(direction).collect();
    halve(&mut directions);
    directions
}

/// Puts `points` into an order in which every so many are from all sides: one half of them after the other, cut where they extend farthest, and so each half in
/// itself. The second half is in reverse, so that no side comes first in both.
fn halve(points: &mut [[f64; 3]]) {
    let middle = points.len() / 2;
    if middle == 0 {
        return;
    }
    let extent = |axis: usize| {
        let (least, most) = points.iter().fold((f64::MAX, f64::MIN), |(least, most), p| (least.min(p[axis]), most.max(p[axis])));
        most - least
    };
    let axis = (0..3).max_by(|&a, &b| extent(a).total_cmp(&extent(b))).unwrap_or(0);
    points.sort_by(|a, b| a[axis].total_cmp(&b[axis]));
    let (first, second) = points.split_at_mut(middle);
    halve(first);
    halve(second);
    second.reverse();
}

/// Times of `count` views in their order, two at least: 0, 1 and evenly spaced ones between them, shuffled by [`RUNS`].
fn times(count: usize) -> Vec<f32> {
    let place = |view: usize| {
        let share = view as f64 / count as f64;
        ((RUNS[0] + RUNS[1] * share) * share).fract()
    };
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|&a, &b| place(a).total_cmp(&place(b)));
    let mut times = vec![0.0; count];
    for (rank, view) in order.into_iter().enumerate() {
        times[view] = rank as f32 / (count - 1) as f32;
    }
    times
}

/// The axis of the world that is farthest from `direction`: cameras that look along any direction can have it above.
fn across(direction: [f64; 3]) -> [f64; 3] {
    let farthest = (0..3).min_by(|&a, &b| direction[a].abs().total_cmp(&direction[b].abs())).unwrap_or(0);
    let mut axis = [0.0; 3];
    axis[farthest] = 1.0;
    axis
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Orbit;
    use std::collections::BTreeSet;

    fn gaussians(means: Vec<f32>) -> HostGaussians {
        HostGaussians { opacity_logits: vec![2.0; means.len() / 3], means, ..Default::default() }
    }

    /// From the origin to the camera, of length 1, and the time.
    fn seen(views: &OrbitViews, index: usize) -> ([f64; 3], f32) {
        let (camera, time_norm) = views.view(index);
        let eye = camera.center_world();
        let length = eye.iter().map(|v| v * v).sum::<f64>().sqrt();
        (eye.map(|v| v / length), time_norm)
    }

    fn quarter(time_norm: f32) -> usize {
        ((4.0 * time_norm) as usize).min(3)
    }

    #[test]
    fn directions_and_times_are_evenly_spread() {
        for count in [12, 13, 100, 512] {
            let views = OrbitViews::around(&gaussians(vec![0.0; 3]), OrbitViews::SIZE, count).unwrap();
            let (directions, mut times): (Vec<[f64; 3]>, Vec<f32>) = (0..views.len()).map(|k| seen(&views, k)).unzip();
            assert_eq!(directions.len(), count);
            for axis in 0..3 {
                let sum: f64 = directions.iter().map(|d| d[axis]).sum();
                assert!(sum.abs() < 2.5, "{count} views: {sum} along axis {axis}");
            }
            let apart = |a: &[f64; 3], b: &[f64; 3]| (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f64>().sqrt();
            let nearest = (0..count).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| apart(&directions[i], &directions[j])).fold(f64::MAX, f64::min);
            assert!(nearest > 2.5 / (count as f64).sqrt(), "{count} views: two are {nearest} apart");
            times.sort_by(f32::total_cmp);
            let even: Vec<f32> = (0..count).map(|rank| rank as f32 / (count - 1) as f32).collect();
            assert_eq!(times, even);
        }
    }

    #[test]
    fn every_so_many_views_are_from_all_sides_and_of_all_of_the_time() {
        for (count, chosen) in [16, 64, 96, 240, 512].into_iter().flat_map(|count| [8, 12, 16, 33, 160].map(|chosen| (count, chosen))) {
            if chosen > count {
                continue;
            }
            let views = OrbitViews::around(&gaussians(vec![0.0; 3]), OrbitViews::SIZE, count).unwrap();
            // As codecs choose them.
            let (directions, times): (Vec<[f64; 3]>, Vec<f32>) = (0..chosen).map(|k| seen(&views, k * count / chosen)).unzip();
            for axis in 0..3 {
                let above = directions.iter().filter(|d| d[axis] > 0.0).count();
                assert!((chosen / 4..=chosen - chosen / 4).contains(&above), "{chosen} of {count} views: {above} are above the middle along axis {axis}");
            }
            let quarters: BTreeSet<usize> = times.into_iter().map(quarter).collect();
            assert!(quarters.len() >= 3, "{chosen} of {count} views: quarters {quarters:?} of the time");
        }
    }

    #[test]
    fn every_side_is_seen_at_many_times() {
        let views = OrbitViews::around(&gaussians(vec![0.0; 3]), OrbitViews::SIZE, 512).unwrap();
        let of_octants: BTreeSet<([bool; 3], usize)> =
            (0..views.len()).map(|k| seen(&views, k)).map(|(direction, time)| (direction.map(|v| v > 0.0), quarter(time))).collect();
        for octant in 0..8 {
            let signs = [1, 2, 4].map(|bit| octant & bit != 0);
            let quarters = of_octants.iter().filter(|(of, _)| *of == signs).count();
            assert!(quarters >= 3, "octant {signs:?} is seen in {quarters} quarters of the time");
        }
    }

    #[test]
    fn cameras_are_as_far_as_those_of_an_orbit_and_look_at_the_middle() {
        let corners = |size: f32| gaussians((0..8).flat_map(|i| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|b| 5.0 + size * b as f32)).collect());
        // Tiny, usual and huge models, one Gaussian, and none.
        for model in [corners(1e-4), corners(1.0), corners(1e37), gaussians(vec![3.0; 3]), HostGaussians::default()] {
            let size = (40, 30);
            let views = OrbitViews::around(&model, size, 16).unwrap();
            let like = Orbit { size, frames: 1, ..Orbit::default() }.around(&model).unwrap().remove(0);
            let (middle, distance) = middle_and_distance(&model, size).unwrap();
            for (camera, time_norm) in (0..views.len()).map(|k| views.view(k)).chain([(&like, 0.0)]) {
                camera.validate().unwrap();
                assert!((camera.width, camera.height) == size && camera.fx == like.fx && (0.0..=1.0).contains(&time_norm));
                let m = &camera.world_to_camera;
                let at: [f64; 3] = std::array::from_fn(|r| (0..3).map(|c| m[r][c] * middle[c]).sum::<f64>() + m[r][3]);
                let off = (at[2] / distance - 1.0).abs() + (at[0] / distance).abs() + (at[1] / distance).abs();
                assert!(off < 1e-6, "{}: the middle is at {at:?}, {distance} was expected", camera.name);
            }
        }
    }

    #[test]
    fn what_has_no_views_is_an_error() {
        let model = gaussians(vec![0.0; 3]);
        for count in [0, 11, 513] {
            let refused = OrbitViews::around(&model, OrbitViews::SIZE, count).unwrap_err().to_string();
            assert!(refused.contains(&format!("{count} views")) && refused.contains("12 to 512"), "{refused}");
        }
        assert!(OrbitViews::around(&model, (0, 8), 12).is_err());
        let far = OrbitViews::around(&gaussians(vec![1e30; 3]), OrbitViews::SIZE, 12).unwrap_err().to_string();
        assert!(far.contains("no camera can look"), "{far}");
        let views = OrbitViews::around(&model, OrbitViews::SIZE, 12).unwrap();
        let absent = views.image(3).unwrap_err().to_string();
        assert!((views.kind(), views.has_images()) == ("orbit", false) && absent.contains("view 3 of 12 has no image"), "{absent}");
    }
}
