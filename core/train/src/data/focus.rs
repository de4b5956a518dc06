//! Where a rig of cameras looks, and how far away that is.

use glam::{DMat3, DVec3};

/// A pull towards the expected distance, as a share of the number of cameras: axes that converge by less than about two degrees leave the distance open.
const PULL: f64 = 1e-3;
/// Cameras whose positions differ by less than this share of their coordinates, or of 1, stand at one point: that is what rounding leaves of products of
/// rotations and translations.
const ONE_POINT: f64 = 1e-12;
/// Cameras whose positions differ by less than this share of the distance of what they see stand at one point: a thousandth of a pixel at a focal length of
/// 10,000 pixels, and what float32 leaves of positions.
const NO_PARALLAX: f64 = 1e-7;
/// How many times the rig's width a rig of parallel axes is expected to look ahead, where nothing else is known.
const AHEAD: f64 = 3.0;

/// What a rig looks at. Lengths are in the units of the cameras.
#[derive(Clone, Copy, Debug)]
pub(super) struct Focus {
    /// The point the cameras look at; their middle if they look outwards.
    pub point: DVec3,
    /// Median distance of the cameras from what they see; `None` where neither positions nor the hint say anything of lengths.
    pub distance: Option<f64>,
    /// Half-width of a cube around the point that holds what the cameras see.
    pub half: f64,
}

/// The least-squares intersection of the optical axes `(centre, unit direction)`. `hint` is how far ahead of the cameras the scene is expected; without one it
/// is a few rig widths. Everything scales and moves with the cameras, where their positions differ by more than [`ONE_POINT`].
pub(super) fn focus(rays: &[(DVec3, DVec3)], hint: Option<f64>) -> Focus {
    let n = rays.len().max(1) as f64;
    // Relative to a camera, so that large coordinates do not cost digits.
    let origin = rays.first().map_or(DVec3::ZERO, |r| r.0);
    let mean = rays.iter().map(|r| r.0 - origin).sum::<DVec3>() / n;
    let forward = rays.iter().map(|r| r.1).sum::<DVec3>() / n;
    let spread = (rays.iter().map(|r| (r.0 - origin - mean).length_squared()).sum::<f64>() / n).sqrt();
    let least = (ONE_POINT * origin.abs().max_element().max(1.0)).max(NO_PARALLAX * hint.unwrap_or(0.0));
    let spread = (spread > least).then_some(spread);
    let ahead = hint.or(spread.map(|s| AHEAD * s));
    let expected = ahead.unwrap_or(AHEAD);
    let outer = |d: DVec3| DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    let weight = PULL * n;
    let (mut a, mut b) = (DMat3::IDENTITY * weight, (mean + forward * expected) * weight);
    for &(c, d) in rays {
        let m = DMat3::IDENTITY - outer(d);
        a += m;
        b += m * (c - origin);
    }
    // From one point, directions say nothing of distances.
    let point = if spread.is_some() { a.inverse() * b } else { mean + forward * expected };
    let behind = rays.iter().filter(|(c, d)| (point - (*c - origin)).dot(*d) < 0.0).count();
    if !point.is_finite() || 2 * behind > rays.len() || (spread.is_none() && forward.length() < 0.7) {
        return Focus { point: origin + mean, distance: ahead, half: expected };
    }
    let mut distances: Vec<f64> = rays.iter().map(|r| (r.0 - origin - point).length()).collect();
    distances.sort_by(f64::total_cmp);
    let farthest = distances.last().copied().unwrap_or(expected);
    let half = if forward.length() < 0.7 { 1.1 * farthest } else { farthest };
    let distance = if spread.is_some() { distances.get(distances.len() / 2).copied() } else { ahead };
    Focus { point: origin + point, distance: distance.filter(|d| *d > 0.0), half: if half > 0.0 { half } else { expected } }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(target: DVec3, size: f64) -> Vec<(DVec3, DVec3)> {
        (0..8)
            .map(|i| {
                let (s, c) = (f64::from(i) * 0.785).sin_cos();
                let eye = target + size * DVec3::new(4.0 * c, 4.0 * s, 1.2);
                (eye, (target - eye).normalize())
            })
            .collect()
    }

    #[test]
    fn a_ring_is_centred_wherever_it_stands() {
        let still = focus(&ring(DVec3::ZERO, 1.0), None);
        assert!(still.point.length() < 0.02, "{still:?}");
        for (target, size) in [(DVec3::new(1.0, 2.0, 3.0), 1.0), (DVec3::new(1e5, -1e5, 3e4), 1.0), (DVec3::new(1e5, 0.0, 0.0), 1e-4), (DVec3::ZERO, 1e4)] {
            let found = focus(&ring(target, size), None);
            let moved = (found.point - target) / size - still.point;
            assert!(moved.length() < 1e-5, "{target} {size}: {moved}");
            assert!((found.distance.unwrap() / size / still.distance.unwrap() - 1.0).abs() < 1e-6);
            assert!((found.half / size / still.half - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn cameras_that_differ_by_rounding_stand_at_one_point() {
        // They turn about one point, so their axes meet there.
        let panning = |jitter: f64, at: DVec3| {
            let directions = [DVec3::new(0.3, 0.0, 1.0), DVec3::new(-0.3, 0.0, 1.0), DVec3::new(0.0, 0.3, 1.0)];
            directions.map(|d| (at + jitter * DVec3::new(d.y, d.x, d.x), d.normalize()))
        };
        for (jitter, at, hint) in
            [(1e-13, DVec3::ZERO, None), (1e-10, DVec3::new(0.0, 3e3, 0.0), None), (1e-13, DVec3::ZERO, Some(10.0)), (1e-7, DVec3::ONE, Some(10.0))]
        {
            let (found, exact) = (focus(&panning(jitter, at), hint), focus(&panning(0.0, at), hint));
            assert_eq!((found.distance, exact.distance), (hint, hint), "{jitter} at {at}");
            assert!((found.point - exact.point).length() < 1e-6 && (found.half - exact.half).abs() < 1e-6, "{found:?} {exact:?}");
        }
        let apart = focus(&panning(0.1, DVec3::ZERO), Some(10.0));
        assert!(apart.distance.is_some_and(|d| d < 5.0), "{apart:?}");
    }

    #[test]
    fn rigs_that_say_little_still_get_an_answer() {
        let parallel: Vec<_> = (0..4).map(|i| (DVec3::new(f64::from(i), 0.0, 0.0), DVec3::Z)).collect();
        let found = focus(&parallel, None);
        assert!(found.point.z > 1.0 && found.half > 0.5, "{found:?}");
        // With a hint, parallel axes look that far ahead.
        let found = focus(&parallel, Some(20.0));
        assert!((found.point.z - 20.0).abs() < 0.1 && (found.distance.unwrap() - 20.0).abs() < 0.5, "{found:?}");
        // One camera, or several at one point, say nothing of lengths.
        let one = (DVec3::new(5.0, 6.0, 7.0), DVec3::X);
        for rays in [vec![one], vec![one; 3]] {
            let found = focus(&rays, None);
            assert!(found.distance.is_none() && found.point.is_finite() && found.point.x > 5.5, "{found:?}");
            assert_eq!(focus(&rays, Some(9.0)).distance, Some(9.0));
        }
        // A panorama, and cameras that look outwards.
        let turning = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y].map(|d| (DVec3::ONE, d));
        assert!(focus(&turning, None).distance.is_none() && focus(&turning, None).point == DVec3::ONE);
        let outwards = [DVec3::X, -DVec3::X, DVec3::Y, -DVec3::Y].map(|d| (DVec3::ONE + d, d));
        let found = focus(&outwards, None);
        assert!(found.point == DVec3::ONE && found.distance == Some(3.0) && found.half > 1.0, "{found:?}");
        let found = focus(&[], None);
        assert!(found.point.is_finite() && found.half.is_finite());
    }
}
