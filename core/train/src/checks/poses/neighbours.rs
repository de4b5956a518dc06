//! Which images should show common content, judged from the cameras and times alone.

use glam::DVec3;

/// The angle between the lines of sight that matches best: wide enough to depend on the pose, narrow enough to look alike.
const BEST_ANGLE_RAD: f64 = 0.2;
/// Images are compared up to this angle between their lines of sight, and between their axes: beyond, surfaces look too different.
const WIDEST_RAD: f64 = 0.6;
const WIDEST_AXES_RAD: f64 = 0.8;
/// What the whole sequence between two times costs, as an angle.
const TIME_COST_RAD: f64 = 2.0;

/// Where and when an image was taken.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stand {
    pub center: DVec3,
    /// Unit viewing direction.
    pub forward: DVec3,
    /// 0..1.
    pub time: f64,
    /// Distance along the axis of what the camera looks at.
    pub depth: f64,
}

impl Stand {
    /// A camera of the normalised frame, in which the cameras look at the origin from about `distance`.
    pub fn new(center: DVec3, forward: DVec3, time: f64, distance: f64) -> Self {
        let ahead = -forward.dot(center);
        Self { center, forward, time, depth: if ahead > 0.25 * distance { ahead } else { distance } }
    }
    /// How badly this image and `other` suit for a comparison; `None` if they cannot be compared.
    fn cost(&self, other: &Stand) -> Option<f64> {
        let seen = self.center + self.forward * self.depth;
        let angle = |a: DVec3, b: DVec3| a.normalize_or_zero().dot(b.normalize_or_zero()).clamp(-1.0, 1.0).acos();
        let parallax = angle(seen - self.center, seen - other.center);
        let axes = angle(self.forward, other.forward);
        let cost = (parallax - BEST_ANGLE_RAD).abs() + 0.5 * axes + TIME_COST_RAD * (self.time - other.time).abs();
        (parallax < WIDEST_RAD && axes < WIDEST_AXES_RAD).then_some(cost)
    }
}

/// The `count` images that suit image `index` best, best first; fewer where there are not as many.
pub(super) fn neighbours(stands: &[Stand], index: usize, count: usize) -> Vec<usize> {
    let mut others: Vec<(f64, usize)> = (0..stands.len()).filter(|&j| j != index).filter_map(|j| Some((stands[index].cost(&stands[j])?, j))).collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.into_iter().take(count).map(|o| o.1).collect()
}
