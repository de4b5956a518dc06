//! Where the user looks from: orbiting a point, or flying.

pub(crate) mod pose;

use cc4dgs_format::Camera;
use cc4dgs_format::archive::Presentation;
use glam::{DMat3, DVec3};
pub use pose::Pose;

/// Full horizontal angle where no camera says another, in radians.
const FOV_X: f64 = 0.9;
/// Width over height where no camera says another.
const ASPECT: f64 = 4.0 / 3.0;
/// Nearest to a pole that orbiting comes, in radians.
const POLE: f64 = 0.03;
/// Nearest to the target that zooming comes, as a share of [`Navigator::unit`]: much nearer, rounding would turn the view, and stop zooming out.
const NEAREST: f64 = 1e-6;

/// A free camera with a point that it orbits.
#[derive(Clone, Debug, PartialEq)]
pub struct Navigator {
    /// Camera centre.
    pub eye: DVec3,
    /// The point that is orbited.
    pub target: DVec3,
    /// Unit vector that points up.
    pub up: DVec3,
    /// Full vertical angle in radians, of images at least as wide as `aspect` says; narrower ones show as much to the sides, and more above and below.
    pub fov_y: f64,
    /// Width over height of the camera or the pose that was taken last.
    aspect: f64,
    /// Rotation of the camera around its viewing direction that captured cameras may have, in radians; 0 after the user orbits.
    roll: f64,
    /// Half the diagonal of the box at the start, 1 at most: lengths that are small in this scene are shares of it.
    unit: f64,
    /// Eye, target, vertical angle, aspect and roll at the start.
    first: (DVec3, DVec3, f64, f64, f64),
}

impl Navigator {
    /// Starts at the home camera of `shown`; without one, beside the box from `lower` to `upper`.
    pub fn new(shown: &Presentation, lower: [f32; 3], upper: [f32; 3]) -> Self {
        let of = |v: [f32; 3]| DVec3::from(v.map(f64::from));
        let (middle, radius) = (0.5 * (of(lower) + of(upper)), 0.5 * (of(upper) - of(lower)).length());
        let radius = if radius > 1e-9 { radius } else { 1e-3 };
        let up = shown.up.map_or(DVec3::Z, of).try_normalize().unwrap_or(DVec3::Z);
        let side = up.any_orthonormal_vector();
        let target = shown.target.map_or(middle, of);
        let eye = target + 1.8 * radius * (side + 0.35 * up).normalize();
        let first = (eye, target, FOV_X, ASPECT, 0.0);
        let mut out = Self { eye, target, up, fov_y: FOV_X, aspect: ASPECT, roll: 0.0, unit: radius.min(1.0), first };
        if let Some(home) = &shown.home {
            out.go_to(home);
            out.first = (out.eye, out.target, out.fov_y, out.aspect, out.roll);
        }
        out
    }
    /// Back to the start, with the point that was orbited there.
    pub fn reset(&mut self) {
        (self.eye, self.target, self.fov_y, self.aspect, self.roll) = self.first;
    }
    /// Takes the place of `camera`; the orbited point becomes the one on its axis that is nearest to the old one.
    pub fn go_to(&mut self, camera: &Camera) {
        let eye = DVec3::from(camera.center_world());
        let forward = DVec3::from(camera.forward_world());
        let along = (self.target - eye).dot(forward);
        let distance = if along > 1e-3 * self.unit { along } else { (self.target - eye).length().max(1e-2 * self.unit) };
        self.eye = eye;
        self.target = eye + distance * forward;
        self.fov_y = 2.0 * (0.5 * f64::from(camera.height) / camera.fy).atan();
        self.aspect = f64::from(camera.width.max(1)) / f64::from(camera.height.max(1));
        let (right, down) = self.axes();
        let m = camera.world_to_camera;
        let row = DVec3::new(m[0][0], m[0][1], m[0][2]);
        self.roll = row.dot(down).atan2(row.dot(right));
    }
    fn forward(&self) -> DVec3 {
        (self.target - self.eye).try_normalize().unwrap_or(DVec3::X)
    }
    /// Right and down of a camera without roll.
    fn axes(&self) -> (DVec3, DVec3) {
        let forward = self.forward();
        let right = forward.cross(self.up).try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
        (right, forward.cross(right))
    }
    /// Right and down of the image.
    fn image_axes(&self) -> (DVec3, DVec3) {
        let (right, down) = self.axes();
        let (s, c) = self.roll.sin_cos();
        (c * right + s * down, c * down - s * right)
    }
    /// Orbits by angles in radians: to the right, and upwards.
    pub fn orbit(&mut self, right: f64, upwards: f64) {
        self.roll = 0.0;
        let arm = self.eye - self.target;
        let distance = arm.length();
        let height = (arm.dot(self.up) / distance.max(1e-9)).clamp(-1.0, 1.0).asin();
        let raised = (height + upwards).clamp(-std::f64::consts::FRAC_PI_2 + POLE, std::f64::consts::FRAC_PI_2 - POLE);
        let flat = (arm - arm.dot(self.up) * self.up).try_normalize().unwrap_or_else(|| self.up.any_orthonormal_vector());
        let turned = DMat3::from_axis_angle(self.up, right) * flat;
        self.eye = self.target + distance * (raised.cos() * turned + raised.sin() * self.up);
    }
    /// Turns in place by angles in radians: to the right, and upwards.
    pub fn look(&mut self, right: f64, upwards: f64) {
        let (eye, target) = (self.eye, self.target);
        // Looking around is orbiting of the target around the eye.
        (self.eye, self.target) = (target, eye);
        self.orbit(-right, upwards);
        (self.eye, self.target) = (eye, self.eye);
    }
    /// Moves eye and target along the image: shares of its height, for an image of this size in pixels.
    pub fn pan(&mut self, right: f64, down: f64, (width, height): (u32, u32)) {
        // Narrow images show more above and below.
        let taller = (self.aspect * f64::from(height.max(1)) / f64::from(width.max(1))).max(1.0);
        let height = 2.0 * (0.5 * self.fov_y).tan() * taller * (self.target - self.eye).length();
        let (r, d) = self.image_axes();
        let by = height * (right * r + down * d);
        self.eye += by;
        self.target += by;
    }
    /// Divides the distance to the target by `factor`, down to a least distance.
    pub fn zoom(&mut self, factor: f64) {
        if factor.is_finite() && factor > 0.0 {
            let arm = self.eye - self.target;
            // A pose of a link may be nearer already; it comes no nearer.
            let nearest = arm.length().min(NEAREST * self.unit);
            self.eye = self.target + arm / factor.clamp(0.01, 100.0).min(arm.length() / nearest);
        }
    }
    /// Flies: shares of the distance to the target, to the right, up and forward.
    pub fn fly(&mut self, right: f64, up: f64, forward: f64) {
        let distance = (self.target - self.eye).length();
        let (r, d) = self.image_axes();
        let by = distance * (right * r - up * d + forward * self.forward());
        self.eye += by;
        self.target += by;
    }
    /// The camera for an image of this size in pixels.
    pub fn camera(&self, width: u32, height: u32) -> Camera {
        let (width, height) = (width.max(1), height.max(1));
        let (right, down) = self.image_axes();
        let row = |a: DVec3| [a.x, a.y, a.z, -a.dot(self.eye)];
        let focal = 0.5 * f64::from(height).min(f64::from(width) / self.aspect) / (0.5 * self.fov_y).tan();
        Camera {
            name: "view".into(),
            width,
            height,
            fx: focal,
            fy: focal,
            cx: 0.5 * f64::from(width),
            cy: 0.5 * f64::from(height),
            world_to_camera: [row(right), row(down), row(self.forward()), [0.0, 0.0, 0.0, 1.0]],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec4;

    pub(super) fn home() -> Camera {
        Camera::look_at("home", (640, 480), 0.8, [3.0, 1.0, 2.0], [0.2, 0.1, 0.3], [0.0, 0.0, 1.0])
    }

    #[test]
    fn home_is_the_camera_it_was_told_of() {
        let shown = Presentation { home: Some(home()), up: Some([0.0, 0.0, 1.0]), target: Some([0.2, 0.1, 0.3]), ..Default::default() };
        let mut navigator = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
        let close = |a: &Camera, b: &Camera| {
            let pairs = a.world_to_camera.iter().flatten().zip(b.world_to_camera.iter().flatten());
            pairs.fold(0.0f64, |worst, (x, y)| worst.max((x - y).abs())) + (a.fx - b.fx).abs()
        };
        assert!(close(&navigator.camera(640, 480), &home()) < 1e-9);
        navigator.orbit(0.3, 0.2);
        navigator.camera(640, 480).validate().unwrap();
        assert!(close(&navigator.camera(640, 480), &home()) > 0.1);
        assert!(((navigator.eye - navigator.target).length() - (DVec3::new(2.8, 0.9, 1.7)).length()).abs() < 1e-6);
        navigator.reset();
        assert!(close(&navigator.camera(640, 480), &home()) < 1e-9);
        // A phone shows all of its width, and no less above and below.
        let tall = navigator.camera(320, 960);
        assert!((tall.fx - 0.5 * home().fx).abs() < 1e-9 && tall.cy == 480.0);
        // Rolled cameras keep their roll.
        let rolled = Camera::look_at("rolled", (640, 480), 0.8, [3.0, 1.0, 2.0], [0.2, 0.1, 0.3], [0.3, 0.1, 1.0]);
        navigator.go_to(&rolled);
        assert!(close(&navigator.camera(640, 480), &rolled) < 1e-9);
    }

    #[test]
    fn the_scene_moves_with_the_image_of_any_shape_and_roll() {
        let rolled = Camera::look_at("rolled", (640, 480), 0.8, [3.0, 1.0, 2.0], [0.2, 0.1, 0.3], [0.3, 0.9, -0.4]);
        let cases = [(home(), 640, 480), (home(), 1280, 320), (home(), 390, 844), (rolled.clone(), 640, 480), (rolled, 390, 844)];
        for (camera, width, height) in cases {
            let shown = Presentation { home: Some(camera), up: Some([0.0, 0.0, 1.0]), target: Some([0.2, 0.1, 0.3]), ..Default::default() };
            let start = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
            // Where the middle of the first image is, in pixels from the middle and in depth.
            let seen = |navigator: &Navigator| {
                let (camera, point) = (navigator.camera(width, height), start.target.extend(1.0));
                let [x, y, z] = [0, 1, 2].map(|row| DVec4::from(camera.world_to_camera[row]).dot(point));
                [camera.fx * x / z, camera.fy * y / z, z]
            };
            let (mut panned, mut flown, depth) = (start.clone(), start.clone(), seen(&start)[2]);
            panned.pan(0.25, -0.125, (width, height));
            flown.fly(0.5, 0.0, 0.0);
            let [x, y, _] = seen(&panned);
            let wanted = [-0.25, 0.125].map(|share| share * f64::from(height));
            assert!((x - wanted[0]).abs() < 1e-6 && (y - wanted[1]).abs() < 1e-6, "{width}x{height}: {x}, {y} instead of {wanted:?}");
            let [x, y, z] = seen(&flown);
            assert!(x < 0.0 && y.abs() < 1e-6 && (z - depth).abs() < 1e-9, "flying to the right leads to {x}, {y}");
        }
    }

    #[test]
    fn reset_leads_back_to_the_start_with_and_without_a_home_camera() {
        let shown = Presentation { home: Some(home()), up: Some([0.0, 0.0, 1.0]), target: Some([0.2, 0.1, 0.3]), ..Default::default() };
        for shown in [Presentation::default(), shown] {
            let start = Navigator::new(&shown, [-1.0; 3], [1.0; 3]);
            let mut moved = start.clone();
            moved.go_to(&Camera::look_at("rolled", (320, 640), 0.5, [1.0, 5.0, 2.0], [0.0; 3], [0.3, 0.1, 1.0]));
            moved.fly(0.3, 0.1, 1.5);
            assert_ne!(moved.pose(), start.pose());
            moved.reset();
            assert_eq!(moved, start);
        }
    }

    #[test]
    fn small_scenes_are_orbited_in_their_middle() {
        let home = Camera::look_at("home", (640, 480), 0.8, [3e-5, 1e-5, 2e-5], [2e-6, 1e-6, 3e-6], [0.0, 0.0, 1.0]);
        let shown = Presentation { home: Some(home), up: Some([0.0, 0.0, 1.0]), target: Some([2e-6, 1e-6, 3e-6]), ..Default::default() };
        let off = (Navigator::new(&shown, [-1e-5; 3], [1e-5; 3]).target - DVec3::new(2e-6, 1e-6, 3e-6)).length();
        assert!(off < 1e-9, "{off} away from it");
    }

    #[test]
    fn zooming_in_for_long_turns_nothing_and_can_be_undone() {
        for (lower, upper) in [([1.0, 2.0, 3.0], [2.0, 3.0, 4.0]), ([-1e-5; 3], [1e-5; 3])] {
            let mut navigator = Navigator::new(&Presentation::default(), lower, upper);
            let (forward, distance) = (navigator.forward(), (navigator.eye - navigator.target).length());
            (0..400).for_each(|_| navigator.zoom(1.2));
            let near = navigator.pose();
            assert!((navigator.forward() - forward).length() < 1e-6, "{near:?}");
            // Links and reloads lead back to it.
            assert!(navigator.set_pose(near), "{near:?}");
            (0..100).for_each(|_| navigator.zoom(1.0 / 1.2));
            assert!((navigator.forward() - forward).length() < 1e-6 && (navigator.eye - navigator.target).length() > distance, "{:?}", navigator.pose());
        }
    }

    #[test]
    fn no_gesture_loses_the_scene() {
        let mut navigator = Navigator::new(&Presentation::default(), [-1.0; 3], [1.0; 3]);
        for _ in 0..50 {
            navigator.orbit(0.4, 0.7);
            navigator.look(0.1, -0.9);
            navigator.pan(0.1, -0.2, (10, 10));
            navigator.zoom(1.1);
            navigator.fly(0.0, 0.1, 0.1);
            navigator.camera(10, 10).validate().unwrap();
        }
        let pose = navigator.pose();
        assert!(!navigator.set_pose([f64::NAN; 9]));
        assert!(!navigator.set_pose(std::array::from_fn(|k| if k == 8 { -1.0 } else { pose[k] })));
        assert_eq!(navigator.pose(), pose);
        assert!(navigator.set_pose(pose));
        navigator.zoom(f64::NAN);
        assert_eq!(navigator.pose(), pose);
    }
}
