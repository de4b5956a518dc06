//! Poses: a view as numbers, and as the text that links and commands have.

use super::Navigator;
use glam::DVec3;
use std::ops::RangeInclusive;

/// Full vertical angles that a pose may have, in radians: from telescopes to nearly half of all directions.
pub(crate) const POSE_FOV: RangeInclusive<f64> = 1e-9..=3.1;
/// Widths over heights that a pose may have: those of all images.
pub(crate) const POSE_ASPECT: RangeInclusive<f64> = 1e-10..=1e10;
/// Below this angle in radians a link writes more decimals of eye and target: a millionth of their distance would be seen.
const NARROW: f64 = 0.01;

/// Eye, target, full vertical angle, roll and aspect (width over height); angles in radians. An image of any shape shows at least what one of this aspect does.
/// The aspect 0 stands for that of the first view.
pub type Pose = [f64; 9];

impl Navigator {
    /// The pose that leads back to exactly this view, in images of all shapes.
    pub fn pose(&self) -> Pose {
        let (e, t) = (self.eye, self.target);
        [e.x, e.y, e.z, t.x, t.y, t.z, self.fov_y, self.roll, self.aspect]
    }
    /// The pose of all that an image of this size in pixels shows, for links: images of other shapes show at least as much to the sides, above and below. Of
    /// angles over 3.1 it has 3.1.
    pub fn pose_shown(&self, width: u32, height: u32) -> Pose {
        let camera = self.camera(width, height);
        let most = (0.5 * POSE_FOV.end()).tan();
        let half = |side: u32, focal: f64| (0.5 * f64::from(side) / focal).min(most);
        let (across, down) = (half(camera.width, camera.fx), half(camera.height, camera.fy));
        let mut pose = self.pose();
        (pose[6], pose[8]) = ((2.0 * down.atan()).clamp(*POSE_FOV.start(), *POSE_FOV.end()), across / down);
        pose
    }
    /// The pose of seven to nine numbers, `None` for another number of them. Without the eighth there is no roll; without the ninth, as in older links, the
    /// aspect is that of the first view.
    pub fn pose_of(numbers: &[f64]) -> Option<Pose> {
        (7..=9).contains(&numbers.len()).then(|| std::array::from_fn(|k| numbers.get(k).copied().unwrap_or(0.0)))
    }
    /// `pose` as links and commands have it: numbers with commas between, without zeros for roll and aspect at the end. Positions are right to a millionth of
    /// the distance between eye and target, however far from the origin they are, or of views narrower than 0.01 to a ten-thousandth of what is seen at the
    /// target.
    pub fn pose_text(pose: Pose) -> String {
        let distance = (0..3).map(|axis| (pose[axis] - pose[axis + 3]).powi(2)).sum::<f64>().sqrt();
        let decimals = |size: f64, least: f64| (6.0 - size.log10().floor()).clamp(least, 17.0) as usize;
        let (positions, angle) = (decimals(distance * (pose[6] / NARROW).min(1.0), 0.0), decimals(pose[6], 7.0));
        let places = [positions, positions, positions, positions, positions, positions, angle, 7, decimals(pose[8], 0.0)];
        let text: Vec<String> = pose.iter().zip(places).map(|(&v, places)| rounded(v, places)).collect();
        let shown = 7 + text[7..].iter().rposition(|number| number != "0").map_or(0, |last| last + 1);
        text[..shown].join(",")
    }
    /// Takes a pose of [`Navigator::pose`]; poses that are not finite or see nothing are ignored. Returns whether it was taken.
    pub fn set_pose(&mut self, pose: Pose) -> bool {
        let (eye, target) = (DVec3::new(pose[0], pose[1], pose[2]), DVec3::new(pose[3], pose[4], pose[5]));
        let aspect = if pose[8] == 0.0 { self.first.3 } else { pose[8] };
        // In a small model eye and target may be near each other.
        let apart = (target - eye).try_normalize().is_some();
        let sees = pose.iter().all(|v| v.is_finite()) && apart && POSE_FOV.contains(&pose[6]) && POSE_ASPECT.contains(&aspect);
        if sees {
            (self.eye, self.target, self.fov_y, self.roll, self.aspect) = (eye, target, pose[6], pose[7], aspect);
        }
        sees
    }
}

/// `value` with at most so many decimals, and no zeros at their end.
fn rounded(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    let short = if decimals > 0 { text.trim_end_matches('0').trim_end_matches('.') } else { text.as_str() };
    if short == "-0" { "0".into() } else { short.into() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::navigator::tests::home;
    use cc4dgs_format::Camera;
    use cc4dgs_format::archive::Presentation;
    use glam::DVec4;

    #[test]
    fn the_text_of_a_pose_leads_back_to_the_same_view() {
        // Beside the origin, in UTM coordinates, near a point, and in a scene as large as a city.
        let utm = [500_012.345_678_9, 5_200_034.567_891_2, 431.25, 500_009.1, 5_200_030.2, 429.875, 0.9];
        let near = [0.2, 0.1, 0.300_001_234_567, 0.2, 0.1, 0.3, 0.012_345_678];
        let city = [-12_345.678_9, 1e-9, 0.0, 54_321.0, -1e-9, 250.0, 3.0];
        let read = |text: &str| Navigator::pose_of(&text.split(',').map(|v| v.parse().unwrap()).collect::<Vec<f64>>()).unwrap();
        for pose in [[1.0, -2.5, 1.0 / 3.0, 0.0, 0.0, 1e-7, 0.927_295_218], utm, near, city] {
            let text = Navigator::pose_text(Navigator::pose_of(&pose).unwrap());
            let read = read(&text);
            let [eye, target] = [0, 3].map(|k| DVec3::new(read[k] - pose[k], read[k + 1] - pose[k + 1], read[k + 2] - pose[k + 2]).length());
            let distance = DVec3::new(pose[0] - pose[3], pose[1] - pose[4], pose[2] - pose[5]).length();
            assert!(eye.max(target) <= 1e-6 * distance && (read[6] - pose[6]).abs() <= 1e-7, "{text}: {eye} and {target} off, at a distance of {distance}");
            assert!(Navigator::new(&Presentation::default(), [-1.0; 3], [1.0; 3]).set_pose(read), "{text}");
            assert_eq!(Navigator::pose_text(read), text, "a link of a link is another");
        }
        assert_eq!(Navigator::pose_text([1.0, -2.5, 1.0 / 3.0, 0.0, 0.0, -1e-7, 0.927_295_218, 1e-9, 0.0]), "1,-2.5,0.333333,0,0,0,0.9272952");
        assert_eq!(Navigator::pose_text([1000.0, 0.0, 2e7, -300.0, -0.4, 0.0, 0.9, -0.25, 0.0]), "1000,0,20000000,-300,0,0,0.9,-0.25");
        assert_eq!(Navigator::pose_text([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.9, 0.0, 16.0 / 9.0]), "1,0,0,0,0,0,0.9,0,1.777778");
        assert!(Navigator::pose_of(&[1.0; 6]).is_none() && Navigator::pose_of(&[1.0; 10]).is_none());
        // A captured camera that was held at an angle stays so.
        let rolled = Camera::look_at("rolled", (640, 480), 0.8, [3.0, 1.0, 2.0], [0.2, 0.1, 0.3], [0.3, 0.1, 1.0]);
        let shown = Presentation { home: Some(rolled), up: Some([0.0, 0.0, 1.0]), ..Default::default() };
        let start = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
        let mut linked = start.clone();
        linked.orbit(0.3, 0.2);
        assert!(linked.set_pose(read(&Navigator::pose_text(start.pose()))));
        let (wanted, found) = (start.camera(640, 480).world_to_camera, linked.camera(640, 480).world_to_camera);
        let far = wanted.iter().flatten().zip(found.iter().flatten()).fold(0.0f64, |worst, (a, b)| worst.max((a - b).abs()));
        assert!(far < 1e-4, "the link turns the view by {far}");
    }

    #[test]
    fn links_show_all_that_the_sender_saw_in_windows_of_any_shape() {
        let shown = Presentation { home: Some(home()), up: Some([0.0, 0.0, 1.0]), target: Some([0.2, 0.1, 0.3]), ..Default::default() };
        let start = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
        // Half of what an image shows at distance 1, across and down.
        let half = |navigator: &Navigator, (width, height): (u32, u32)| {
            let camera = navigator.camera(width, height);
            [0.5 * f64::from(width) / camera.fx, 0.5 * f64::from(height) / camera.fy]
        };
        let shapes = [(1920, 1080), (390, 844), (640, 480), (2560, 400), (300, 16_000)];
        for sender in shapes {
            let sent = half(&start, sender);
            let text = Navigator::pose_text(start.pose_shown(sender.0, sender.1));
            let numbers: Vec<f64> = text.split(',').map(|v| v.parse().unwrap()).collect();
            for window in shapes {
                let mut linked = start.clone();
                linked.orbit(0.3, 0.2);
                assert!(linked.set_pose(Navigator::pose_of(&numbers).unwrap()), "{text}");
                let seen = half(&linked, window);
                let shares = [seen[0] / sent[0], seen[1] / sent[1]];
                assert!((shares[0].min(shares[1]) - 1.0).abs() < 1e-5, "{window:?} shows {shares:?} of what {sender:?} showed: {text}");
            }
        }
        // A window of one column of pixels shows more than a pose may have.
        let mut linked = start.clone();
        assert!(linked.set_pose(start.pose_shown(1, 16_000)), "{:?}", start.pose_shown(1, 16_000));
        // A pose of another camera has its shape, and one of an older link that of the first view.
        linked.go_to(&Camera::look_at("tall", (100, 400), 0.3, [1.0, 5.0, 2.0], [0.0; 3], [0.3, 0.1, 1.0]));
        let (tall, pose) = (linked.clone(), linked.pose());
        assert!(linked.set_pose(Navigator::pose_of(&start.pose()[..8]).unwrap()));
        assert_eq!(linked, start);
        assert!(linked.set_pose(pose));
        assert_eq!(linked, tall);
    }

    #[test]
    fn links_keep_the_views_of_very_long_focal_lengths() {
        for fov_x in [0.012, 1e-3, 2e-6] {
            let home = Camera::look_at("far", (640, 480), fov_x, [3000.0, 1000.0, 2000.0], [0.2, 0.1, 0.3], [0.0, 0.0, 1.0]);
            let shown = Presentation { home: Some(home), up: Some([0.0, 0.0, 1.0]), target: Some([0.2, 0.1, 0.3]), ..Default::default() };
            let start = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
            let text = Navigator::pose_text(start.pose());
            let read: Vec<f64> = text.split(',').map(|v| v.parse().unwrap()).collect();
            let mut linked = start.clone();
            linked.orbit(0.3, 0.2);
            assert!(linked.set_pose(Navigator::pose_of(&read).unwrap()), "a field of view of {fov_x} is refused: {text}");
            let (wanted, found) = (start.camera(640, 480), linked.camera(640, 480));
            let [x, y, z] = [0, 1, 2].map(|row| DVec4::from(found.world_to_camera[row]).dot(start.target.extend(1.0)));
            let off_px = (found.fx * x / z).hypot(found.fy * y / z);
            assert!(off_px < 0.2 && (found.fx / wanted.fx - 1.0).abs() < 1e-5, "{text}: {off_px} pixels off, focal length {} of {}", found.fx, wanted.fx);
        }
    }
}
