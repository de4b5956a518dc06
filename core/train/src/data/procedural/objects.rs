//! Analytic objects and how they move.

use super::figure::{Figure, Part};
use super::shapes::Shape;
use super::textures::Texture;
use glam::{DQuat, DVec3};
use std::f64::consts::{PI, TAU};

/// A rigid placement: world = rotation * local + translation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Local to world.
    pub rotation: DQuat,
    /// World units.
    pub translation: DVec3,
}

impl Pose {
    /// At `translation`, not turned.
    pub fn at(translation: DVec3) -> Self {
        Self { rotation: DQuat::IDENTITY, translation }
    }
    /// About the origin.
    pub fn turned(rotation: DQuat) -> Self {
        Self { rotation, translation: DVec3::ZERO }
    }
    /// The placement in the world of something that is placed at `inner` in this frame.
    pub fn then(&self, inner: Self) -> Self {
        Self { rotation: self.rotation * inner.rotation, translation: self.apply(inner.translation) }
    }
    /// World position of a local point.
    pub fn apply(&self, local: DVec3) -> DVec3 {
        self.rotation * local + self.translation
    }
    /// Local position of a world point.
    pub fn inverse_apply(&self, world: DVec3) -> DVec3 {
        self.rotation.conjugate() * (world - self.translation)
    }
}

/// How an object moves over the normalised time 0..1. Closed forms, smooth, defined for all times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Motion {
    /// It stands.
    Still {
        /// Where.
        at: DVec3,
        /// Turn about z in radians.
        turn_rad: f64,
    },
    /// It stands, turned about any axis.
    Placed(Pose),
    /// It is a part of an articulated figure.
    Part {
        /// The figure, which says how all parts move.
        figure: Figure,
        /// Which part.
        part: Part,
    },
    /// It travels an arc of a horizontal circle and hops on the way.
    Arc {
        /// Centre of the circle.
        center: DVec3,
        /// Radius in world units.
        radius: f64,
        /// Angles in radians at time 0 and 1.
        from_to_rad: [f64; 2],
        /// Height of the hops in world units.
        hop: f64,
        /// Number of hops.
        hops: f64,
    },
    /// It spins about z where it stands.
    Spin {
        /// Where.
        at: DVec3,
        /// Full turns over the sequence.
        turns: f64,
    },
    /// It hangs from a pivot and swings in the plane of x and z.
    Swing {
        /// The pivot.
        pivot: DVec3,
        /// Distance from the pivot to the object's origin.
        length: f64,
        /// Largest angle in radians.
        amplitude_rad: f64,
        /// Full swings over the sequence.
        swings: f64,
    },
    /// It goes to and fro on a line.
    Sway {
        /// The middle of the line.
        at: DVec3,
        /// From the middle to an end.
        reach: DVec3,
        /// Full cycles over the sequence.
        cycles: f64,
    },
}

impl Motion {
    /// The placement at `time_norm`.
    pub fn pose(&self, time_norm: f64) -> Pose {
        match *self {
            Self::Still { at, turn_rad } => Pose { rotation: DQuat::from_rotation_z(turn_rad), translation: at },
            Self::Placed(pose) => pose,
            Self::Part { figure, part } => figure.pose(part, time_norm),
            Self::Arc { center, radius, from_to_rad, hop, hops } => {
                let angle = from_to_rad[0] + (from_to_rad[1] - from_to_rad[0]) * time_norm;
                let rise = hop * (PI * hops * time_norm).sin().powi(2);
                let travelled = DQuat::from_rotation_z(angle);
                Pose { rotation: travelled, translation: center + travelled * DVec3::new(radius, 0.0, 0.0) + DVec3::Z * rise }
            }
            Self::Spin { at, turns } => Pose { rotation: DQuat::from_rotation_z(TAU * turns * time_norm), translation: at },
            Self::Swing { pivot, length, amplitude_rad, swings } => {
                let rotation = DQuat::from_rotation_y(amplitude_rad * (TAU * swings * time_norm).cos());
                Pose { rotation, translation: pivot + rotation * DVec3::new(0.0, 0.0, -length) }
            }
            Self::Sway { at, reach, cycles } => Pose { rotation: DQuat::IDENTITY, translation: at + reach * (TAU * cycles * time_norm).sin() },
        }
    }
    /// Whether it never moves.
    pub fn is_still(&self) -> bool {
        matches!(self, Self::Still { .. } | Self::Placed(_))
    }
}

/// How a surface answers light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// Its colour.
    pub texture: Texture,
    /// Strength of the highlight, 0..1.
    pub specular: f64,
}

/// One object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Object {
    /// Its solid.
    pub shape: Shape,
    /// Its surface.
    pub material: Material,
    /// Its motion.
    pub motion: Motion,
    /// It is there from the first of these times (included) to the second (excluded); [`ALWAYS`] for most.
    pub visible: [f64; 2],
}

/// The times of an object that never comes or goes.
pub const ALWAYS: [f64; 2] = [f64::NEG_INFINITY, f64::INFINITY];

impl Object {
    /// A matte object that is always there.
    pub fn matte(shape: Shape, texture: Texture, motion: Motion) -> Self {
        Self { shape, material: Material { texture, specular: 0.0 }, motion, visible: ALWAYS }
    }
    /// Whether it is there at `time_norm`.
    pub fn is_there(&self, time_norm: f64) -> bool {
        (self.visible[0]..self.visible[1]).contains(&time_norm)
    }
}

/// The objects of the built-in scenes: a checkered floor, a standing box and ball, and three that move.
pub(super) fn playground() -> Vec<Object> {
    let matte = |texture| Material { texture, specular: 0.0 };
    let glossy = |texture| Material { texture, specular: 0.25 };
    vec![
        Object {
            shape: Shape::Cuboid { half: DVec3::new(1.8, 1.8, 0.05) },
            material: matte(Texture::Checker([0.82, 0.80, 0.75], [0.30, 0.34, 0.38], 0.45)),
            motion: Motion::Still { at: DVec3::new(0.0, 0.0, -0.05), turn_rad: 0.0 },
            visible: ALWAYS,
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.30, 0.22, 0.45) },
            material: matte(Texture::Bands([0.85, 0.55, 0.20], [0.45, 0.20, 0.12], 0.0, 5.0)),
            motion: Motion::Still { at: DVec3::new(-0.95, 0.75, 0.45), turn_rad: 0.5 },
            visible: ALWAYS,
        },
        Object {
            shape: Shape::Sphere { radius: 0.34 },
            material: glossy(Texture::Bands([0.15, 0.45, 0.30], [0.75, 0.85, 0.55], 8.0, 0.0)),
            motion: Motion::Still { at: DVec3::new(0.95, 0.95, 0.34), turn_rad: 0.0 },
            visible: ALWAYS,
        },
        Object {
            shape: Shape::Sphere { radius: 0.28 },
            material: glossy(Texture::Checker([0.80, 0.15, 0.15], [0.95, 0.85, 0.80], 0.22)),
            motion: Motion::Arc { center: DVec3::new(0.0, 0.0, 0.28), radius: 1.15, from_to_rad: [-2.2, -1.3], hop: 0.3, hops: 1.0 },
            visible: ALWAYS,
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.26, 0.26, 0.26) },
            material: matte(Texture::Checker([0.20, 0.30, 0.75], [0.90, 0.90, 0.35], 0.26)),
            motion: Motion::Spin { at: DVec3::new(0.05, 0.05, 0.26), turns: 0.4 },
            visible: ALWAYS,
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.11, 0.11, 0.42) },
            material: matte(Texture::Bands([0.65, 0.25, 0.65], [0.95, 0.90, 0.95], 0.0, 6.0)),
            motion: Motion::Swing { pivot: DVec3::new(0.0, 0.1, 1.95), length: 0.75, amplitude_rad: 0.45, swings: 0.5 },
            visible: ALWAYS,
        },
    ]
}

/// Five balls on a circle over the floor that sway up and down, 1, 2, 4, 8 and 16 times over the sequence.
pub(super) fn frequencies() -> Vec<Object> {
    let colors = [[0.80, 0.20, 0.15], [0.15, 0.50, 0.75], [0.20, 0.60, 0.25], [0.75, 0.55, 0.10], [0.55, 0.25, 0.65]];
    let balls = colors.into_iter().enumerate().map(|(k, color)| {
        let (s, c) = (TAU * k as f64 / 5.0).sin_cos();
        Object {
            shape: Shape::Sphere { radius: 0.26 },
            material: Material { texture: Texture::Checker(color, [0.95, 0.92, 0.85], 0.18), specular: 0.0 },
            motion: Motion::Sway { at: DVec3::new(1.05 * c, 1.05 * s, 0.70), reach: DVec3::Z * 0.25, cycles: f64::from(1 << k) },
            visible: ALWAYS,
        }
    });
    playground().into_iter().take(1).chain(balls).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_rigid_and_invert() {
        for object in playground().into_iter().chain(frequencies()) {
            for t in [0.0, 0.3, 1.0] {
                let (pose, p) = (object.motion.pose(t), DVec3::new(0.3, -0.7, 1.1));
                assert!((pose.inverse_apply(pose.apply(p)) - p).length() < 1e-12);
                assert!((pose.rotation.length() - 1.0).abs() < 1e-12);
            }
            assert_eq!(object.motion.is_still(), object.motion.pose(0.0) == object.motion.pose(0.37));
        }
    }
}
