//! An articulated figure: where its hips are, and from there every part down to hands and feet, as functions of time in closed form.

use super::objects::Pose;
use super::shapes::Shape;
use glam::{DQuat, DVec3};
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// How a figure travels over the normalised time 0..1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Path {
    /// It stays in one place.
    Stays {
        /// On the ground.
        at: DVec3,
        /// Heading about z in radians; 0 looks along x.
        facing_rad: f64,
    },
    /// It sits in one place.
    Sits {
        /// Below the hips, on the ground.
        at: DVec3,
        /// Heading about z in radians; 0 looks along x.
        facing_rad: f64,
    },
    /// It follows an ellipse and looks ahead.
    Round {
        /// Centre, on the ground.
        center: DVec3,
        /// Half axes along x and y.
        radii: [f64; 2],
        /// Angles in radians at time 0 and 1.
        from_to_rad: [f64; 2],
    },
}

/// What the arms do.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arms {
    /// They swing with the steps.
    Swing,
    /// The right one waves, so many times over the sequence.
    Wave(f64),
    /// Both work on a table, so many times over the sequence.
    Work(f64),
    /// Swinging and waving take turns.
    Alternate {
        /// Waves over the sequence.
        waves: f64,
        /// Changes from swinging to waving and back over the sequence.
        turns: f64,
    },
}

/// A figure and its motion. World axes: z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Figure {
    /// Height in world units.
    pub height: f64,
    /// Where it goes.
    pub path: Path,
    /// Double steps over the sequence; 0 for legs that stand.
    pub steps: f64,
    /// What its arms do.
    pub arms: Arms,
}

/// Left or right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The figure's left, +y when it looks along x.
    Left,
    /// The figure's right.
    Right,
}

impl Side {
    fn sign(self) -> f64 {
        if self == Self::Left { 1.0 } else { -1.0 }
    }
}

/// The parts of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Between the legs.
    Hips,
    /// From the hips to the shoulders.
    Torso,
    /// From shoulder to shoulder.
    Shoulders,
    /// The head.
    Head,
    /// Its hair.
    Hair,
    /// From shoulder to elbow.
    UpperArm(Side),
    /// From elbow to wrist.
    Forearm(Side),
    /// The hand.
    Hand(Side),
    /// From hip to knee.
    Thigh(Side),
    /// From knee to ankle.
    Shin(Side),
    /// The foot.
    Foot(Side),
}

impl Part {
    /// All parts.
    pub const ALL: [Self; 17] = [
        Self::Hips,
        Self::Torso,
        Self::Shoulders,
        Self::Head,
        Self::Hair,
        Self::UpperArm(Side::Left),
        Self::UpperArm(Side::Right),
        Self::Forearm(Side::Left),
        Self::Forearm(Side::Right),
        Self::Hand(Side::Left),
        Self::Hand(Side::Right),
        Self::Thigh(Side::Left),
        Self::Thigh(Side::Right),
        Self::Shin(Side::Left),
        Self::Shin(Side::Right),
        Self::Foot(Side::Left),
        Self::Foot(Side::Right),
    ];
    /// Its solid, for a figure of `height`. Capsules lie along the limb.
    pub fn shape(self, height: f64) -> Shape {
        let capsule = |length: f64, radius: f64| Shape::Capsule { half: 0.5 * length * height, radius: radius * height };
        match self {
            Self::Hips => capsule(0.09, 0.075),
            Self::Torso => capsule(0.17, 0.088),
            Self::Shoulders => capsule(0.19, 0.045),
            Self::Head => Shape::Sphere { radius: 0.066 * height },
            Self::Hair => Shape::Sphere { radius: 0.069 * height },
            Self::UpperArm(_) => capsule(UPPER_ARM, 0.031),
            Self::Forearm(_) => capsule(FOREARM, 0.025),
            Self::Hand(_) => capsule(0.05, 0.026),
            Self::Thigh(_) => capsule(THIGH, 0.048),
            Self::Shin(_) => capsule(SHIN, 0.035),
            Self::Foot(_) => capsule(0.10, 0.028),
        }
    }
}

// Lengths as shares of the height, after Drillis and Contini 1964.
const HIPS: f64 = 0.53;
const SEAT: f64 = 0.31;
const UPPER_ARM: f64 = 0.17;
const FOREARM: f64 = 0.15;
const THIGH: f64 = 0.245;
const SHIN: f64 = 0.235;

impl Path {
    /// Place on the ground and heading at a time.
    pub fn at(&self, time_norm: f64) -> (DVec3, f64) {
        match *self {
            Self::Stays { at, facing_rad } | Self::Sits { at, facing_rad } => (at, facing_rad),
            Self::Round { center, radii, from_to_rad: [from, to] } => {
                let (s, c) = (from + (to - from) * time_norm).sin_cos();
                let ahead = (to - from).signum();
                (center + DVec3::new(radii[0] * c, radii[1] * s, 0.0), (ahead * radii[1] * c).atan2(-ahead * radii[0] * s))
            }
        }
    }
}

/// Along y, the way limbs hang: a negative angle swings them forward.
fn about_y(angle: f64) -> DQuat {
    DQuat::from_rotation_y(angle)
}

/// The middle of a limb of `length` that hangs from `joint`.
fn hanging(joint: Pose, length: f64) -> Pose {
    joint.then(Pose::at(-DVec3::Z * 0.5 * length))
}

impl Figure {
    /// Where a part is at `time_norm`.
    pub fn pose(&self, part: Part, time_norm: f64) -> Pose {
        let (h, phase) = (self.height, TAU * self.steps * time_norm);
        let (ground, heading) = self.path.at(time_norm);
        let sits = matches!(self.path, Path::Sits { .. });
        let stride = if self.steps > 0.0 && !sits { 1.0 } else { 0.0 };
        let hip_height = if sits { SEAT * h } else { HIPS * h - stride * 0.012 * h * (1.0 - (2.0 * phase).cos()) };
        let hips = Pose { rotation: DQuat::from_rotation_z(heading), translation: ground + DVec3::Z * hip_height };
        let across = DQuat::from_rotation_x(FRAC_PI_2);
        match part {
            Part::Hips => hips.then(Pose::turned(across)),
            Part::Thigh(side) => hanging(self.hip(hips, side, phase, stride, sits), THIGH * h),
            Part::Shin(side) => hanging(self.knee(hips, side, phase, stride, sits), SHIN * h),
            Part::Foot(side) => {
                let ankle = self.knee(hips, side, phase, stride, sits).then(Pose::at(-DVec3::Z * SHIN * h));
                ankle.then(Pose { rotation: about_y(FRAC_PI_2), translation: DVec3::new(0.035 * h, 0.0, -0.005 * h) })
            }
            _ => self.upper_body(part, hips, phase, stride, time_norm),
        }
    }
    fn hip(&self, hips: Pose, side: Side, phase: f64, stride: f64, sits: bool) -> Pose {
        let swing = if sits { 1.45 } else { stride * 0.48 * (phase + leg_phase(side)).sin() };
        let joint =
            Pose { rotation: DQuat::from_rotation_z(if sits { 0.12 * side.sign() } else { 0.0 }), translation: DVec3::Y * (0.052 * self.height * side.sign()) };
        hips.then(joint).then(Pose::turned(about_y(-swing)))
    }
    fn knee(&self, hips: Pose, side: Side, phase: f64, stride: f64, sits: bool) -> Pose {
        // It bends most while the leg comes forward.
        let bend = if sits { 1.4 } else { stride * (0.12 + 0.45 * (1.0 + (phase + leg_phase(side)).cos())) };
        self.hip(hips, side, phase, stride, sits).then(Pose { rotation: about_y(bend), translation: -DVec3::Z * THIGH * self.height })
    }
    fn upper_body(&self, part: Part, hips: Pose, phase: f64, stride: f64, time_norm: f64) -> Pose {
        let h = self.height;
        let across = DQuat::from_rotation_x(FRAC_PI_2);
        let (twist, lean) = (-stride * 0.14 * phase.sin(), 0.04 + 0.05 * (TAU * time_norm).sin() + stride * 0.03 * (2.0 * phase).sin());
        let spine = hips.then(Pose::turned(DQuat::from_rotation_z(twist) * about_y(lean)));
        let up = |z: f64| spine.then(Pose::at(DVec3::Z * z * h));
        match part {
            Part::Torso => up(0.15),
            Part::Shoulders => up(0.275).then(Pose::turned(across)),
            Part::Head => up(0.40),
            Part::Hair => up(0.40).then(Pose::at(DVec3::new(-0.014, 0.0, 0.013) * h)),
            Part::UpperArm(side) => hanging(self.shoulder(spine, side, phase, stride, time_norm).0, UPPER_ARM * h),
            Part::Forearm(side) => hanging(self.elbow(spine, side, phase, stride, time_norm), FOREARM * h),
            Part::Hand(side) => hanging(self.elbow(spine, side, phase, stride, time_norm), (2.0 * FOREARM + 0.05) * h),
            _ => hips,
        }
    }
    /// The frame of an upper arm at the shoulder, and the turn of the forearm against it.
    fn shoulder(&self, spine: Pose, side: Side, phase: f64, stride: f64, time_norm: f64) -> (Pose, DQuat) {
        let sign = side.sign();
        let wave = |cycles: f64| {
            let w = TAU * cycles * time_norm;
            (DQuat::from_rotation_x(sign * (2.0 + 0.2 * w.sin())), DQuat::from_rotation_x(sign * (0.55 + 0.55 * (w + 0.6).sin())))
        };
        let swinging = phase + leg_phase(side) + PI;
        let swing = (DQuat::from_rotation_x(sign * 0.14) * about_y(-stride * 0.5 * swinging.sin()), about_y(-0.3 - stride * 0.2 * (1.0 + swinging.sin())));
        let waves = side == Side::Right;
        let (upper, fore) = match self.arms {
            Arms::Wave(cycles) if waves => wave(cycles),
            Arms::Alternate { waves: cycles, turns } if waves => {
                let (a, gate) = (wave(cycles), 0.5 - 0.5 * (TAU * turns * time_norm).cos());
                (swing.0.slerp(a.0, gate), swing.1.slerp(a.1, gate))
            }
            Arms::Work(cycles) => {
                let w = TAU * cycles * time_norm + 1.4 * sign;
                let upper = DQuat::from_rotation_z(sign * (0.1 + 0.25 * w.cos())) * about_y(-(0.75 + 0.3 * w.sin()));
                (upper, DQuat::from_rotation_z(-0.4 * sign) * about_y(-(0.85 - 0.45 * (w + 0.4).sin())))
            }
            _ => swing,
        };
        (spine.then(Pose { rotation: upper, translation: DVec3::new(0.0, 0.118 * sign, 0.275) * self.height }), fore)
    }
    fn elbow(&self, spine: Pose, side: Side, phase: f64, stride: f64, time_norm: f64) -> Pose {
        let (shoulder, fore) = self.shoulder(spine, side, phase, stride, time_norm);
        shoulder.then(Pose { rotation: fore, translation: -DVec3::Z * UPPER_ARM * self.height })
    }
}

fn leg_phase(side: Side) -> f64 {
    if side == Side::Left { 0.0 } else { PI }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WALKER: Figure = Figure {
        height: 1.7,
        path: Path::Round { center: DVec3::new(0.2, -0.1, 0.0), radii: [0.8, 0.5], from_to_rad: [-1.0, 3.0] },
        steps: 3.0,
        arms: Arms::Alternate { waves: 4.0, turns: 1.0 },
    };

    /// End of a limb, `toward` +1 for the joint it hangs from and -1 for the other.
    fn end(figure: &Figure, part: Part, time: f64, toward: f64) -> DVec3 {
        let Shape::Capsule { half, .. } = part.shape(figure.height) else { panic!("a limb") };
        figure.pose(part, time).apply(DVec3::Z * half * toward)
    }

    #[test]
    fn limbs_stay_joined_and_feet_stay_on_the_ground() {
        for arms in [Arms::Swing, Arms::Wave(2.0), Arms::Work(3.0), WALKER.arms] {
            for path in [WALKER.path, Path::Stays { at: DVec3::X, facing_rad: 1.0 }, Path::Sits { at: DVec3::Y, facing_rad: -1.0 }] {
                let figure = Figure { arms, path, ..WALKER };
                for step in 0..50 {
                    let t = f64::from(step) / 49.0;
                    let mut lowest = f64::INFINITY;
                    for side in [Side::Left, Side::Right] {
                        for (upper, lower) in
                            [(Part::UpperArm(side), Part::Forearm(side)), (Part::Forearm(side), Part::Hand(side)), (Part::Thigh(side), Part::Shin(side))]
                        {
                            assert!((end(&figure, upper, t, -1.0) - end(&figure, lower, t, 1.0)).length() < 1e-9, "{upper:?} at {t}");
                        }
                        let foot = figure.pose(Part::Foot(side), t).translation.z;
                        lowest = lowest.min(foot);
                    }
                    assert!((0.0..0.16).contains(&lowest), "{figure:?} at {t}: {lowest}");
                }
            }
        }
    }

    #[test]
    fn parts_move_smoothly_and_the_head_is_up() {
        for part in Part::ALL {
            let mut travelled = 0.0;
            for step in 0..400 {
                let (a, b) = (WALKER.pose(part, f64::from(step) / 400.0), WALKER.pose(part, f64::from(step + 1) / 400.0));
                let moved = (a.translation - b.translation).length();
                assert!(
                    moved < 0.06 && a.rotation.angle_between(b.rotation).min(TAU - a.rotation.angle_between(b.rotation)) < 0.2,
                    "{part:?} at {step}: {moved}"
                );
                travelled += moved;
            }
            assert!(travelled > 1.0, "{part:?}");
        }
        let head = WALKER.pose(Part::Head, 0.3).translation.z;
        assert!((1.4..1.7).contains(&head), "{head}");
    }

    #[test]
    fn walkers_look_ahead() {
        let (here, heading) = WALKER.path.at(0.4);
        let (there, _) = WALKER.path.at(0.4001);
        let ahead = (there - here).normalize();
        assert!((ahead.x - heading.cos()).abs() < 1e-3 && (ahead.y - heading.sin()).abs() < 1e-3);
    }
}
