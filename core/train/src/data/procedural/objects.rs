//! Analytic objects and how they move.

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
        matches!(self, Self::Still { .. })
    }
}

/// A solid around its local origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A ball.
    Sphere {
        /// Radius in world units.
        radius: f64,
    },
    /// A box.
    Cuboid {
        /// Half of each edge, in world units.
        half: DVec3,
    },
}

impl Shape {
    /// The nearest hit of a local ray (unit direction) beyond a hair's breadth: distance and outward normal.
    pub fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
        const NEAREST: f64 = 1e-6;
        match *self {
            Self::Sphere { radius } => {
                let b = origin.dot(direction);
                let disc = b * b - (origin.length_squared() - radius * radius);
                if disc < 0.0 {
                    return None;
                }
                let root = disc.sqrt();
                let t = if -b - root > NEAREST { -b - root } else { -b + root };
                (t > NEAREST).then(|| (t, (origin + direction * t) / radius))
            }
            Self::Cuboid { half } => {
                let (mut near, mut far, mut normal) = (f64::NEG_INFINITY, f64::INFINITY, DVec3::ZERO);
                for k in 0..3 {
                    if direction[k].abs() < 1e-12 {
                        if origin[k].abs() > half[k] {
                            return None;
                        }
                        continue;
                    }
                    let (a, b) = ((-half[k] - origin[k]) / direction[k], (half[k] - origin[k]) / direction[k]);
                    let (enter, leave) = (a.min(b), a.max(b));
                    if enter > near {
                        near = enter;
                        normal = DVec3::ZERO;
                        normal[k] = -direction[k].signum();
                    }
                    far = far.min(leave);
                }
                // From within a box nothing is drawn: no camera of the scene is in one.
                (near <= far && near > NEAREST).then_some((near, normal))
            }
        }
    }
}

/// Colour over the surface, a function of the local position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Texture {
    /// One colour.
    Plain([f64; 3]),
    /// Two colours in cubes of the given edge.
    Checker([f64; 3], [f64; 3], f64),
    /// Two colours in bands around the local z axis' meridians (first) and heights (second): number of bands per turn and per unit.
    Bands([f64; 3], [f64; 3], f64, f64),
}

impl Texture {
    /// The colour at a local point.
    pub fn color(&self, p: DVec3) -> [f64; 3] {
        match *self {
            Self::Plain(c) => c,
            Self::Checker(a, b, edge) => {
                // Half an edge off, so that faces through the origin do not flicker between two cubes.
                let cell = (p / edge + DVec3::splat(0.25)).floor();
                if (cell.x + cell.y + cell.z).rem_euclid(2.0) < 0.5 { a } else { b }
            }
            Self::Bands(a, b, per_turn, per_unit) => {
                let phase = p.y.atan2(p.x) / TAU * per_turn + p.z * per_unit;
                if phase.rem_euclid(1.0) < 0.5 { a } else { b }
            }
        }
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
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.30, 0.22, 0.45) },
            material: matte(Texture::Bands([0.85, 0.55, 0.20], [0.45, 0.20, 0.12], 0.0, 5.0)),
            motion: Motion::Still { at: DVec3::new(-0.95, 0.75, 0.45), turn_rad: 0.5 },
        },
        Object {
            shape: Shape::Sphere { radius: 0.34 },
            material: glossy(Texture::Bands([0.15, 0.45, 0.30], [0.75, 0.85, 0.55], 8.0, 0.0)),
            motion: Motion::Still { at: DVec3::new(0.95, 0.95, 0.34), turn_rad: 0.0 },
        },
        Object {
            shape: Shape::Sphere { radius: 0.28 },
            material: glossy(Texture::Checker([0.80, 0.15, 0.15], [0.95, 0.85, 0.80], 0.22)),
            motion: Motion::Arc { center: DVec3::new(0.0, 0.0, 0.28), radius: 1.15, from_to_rad: [-2.2, -1.3], hop: 0.3, hops: 1.0 },
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.26, 0.26, 0.26) },
            material: matte(Texture::Checker([0.20, 0.30, 0.75], [0.90, 0.90, 0.35], 0.26)),
            motion: Motion::Spin { at: DVec3::new(0.05, 0.05, 0.26), turns: 0.4 },
        },
        Object {
            shape: Shape::Cuboid { half: DVec3::new(0.11, 0.11, 0.42) },
            material: matte(Texture::Bands([0.65, 0.25, 0.65], [0.95, 0.90, 0.95], 0.0, 6.0)),
            motion: Motion::Swing { pivot: DVec3::new(0.0, 0.1, 1.95), length: 0.75, amplitude_rad: 0.45, swings: 0.5 },
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
        }
    });
    playground().into_iter().take(1).chain(balls).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solids_are_hit_where_geometry_says() {
        let (t, n) = Shape::Sphere { radius: 0.5 }.intersect(DVec3::new(0.0, 0.0, 3.0), -DVec3::Z).unwrap();
        assert!((t - 2.5).abs() < 1e-12 && (n - DVec3::Z).length() < 1e-12);
        let (t, n) = Shape::Cuboid { half: DVec3::new(1.0, 2.0, 3.0) }.intersect(DVec3::new(-5.0, 0.5, 0.5), DVec3::X).unwrap();
        assert!((t - 4.0).abs() < 1e-12 && n == -DVec3::X);
        assert!(Shape::Cuboid { half: DVec3::ONE }.intersect(DVec3::new(-5.0, 1.5, 0.0), DVec3::X).is_none());
    }

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
