//! Furniture: each piece is a few boxes, rods and cylinders. In a piece's own frame the floor is at z = 0, its back is towards +y, and its front towards -y.

use crate::data::procedural::{Motion, Object, Pose, Rgb, Shape, Texture};
use cc4dgs_core::Seed;
use glam::{DQuat, DVec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Furniture that is being put up. What is irregular comes from one generator, in the order of the calls.
pub(super) struct Props {
    pub objects: Vec<Object>,
    rng: ChaCha8Rng,
}

fn v(x: f64, y: f64, z: f64) -> DVec3 {
    DVec3::new(x, y, z)
}

fn shaded(color: Rgb, by: f64) -> Rgb {
    color.map(|c| (c * by).min(1.0))
}

/// A placement on the floor, turned about z.
pub(super) fn pose_at(x: f64, y: f64, turn_rad: f64) -> Pose {
    Pose { rotation: DQuat::from_rotation_z(turn_rad), translation: v(x, y, 0.0) }
}

impl Props {
    pub fn new(seed: Seed) -> Self {
        Self { objects: Vec::new(), rng: seed.rng() }
    }
    /// A random number in a range.
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        self.rng.random_range(low..high)
    }
    /// A random order of 0..count.
    pub fn order(&mut self, count: usize) -> Vec<usize> {
        use rand::seq::SliceRandom;
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(&mut self.rng);
        order
    }
    /// One of some colours, a little changed.
    pub fn color(&mut self, palette: &[Rgb]) -> Rgb {
        let color = palette[self.rng.random_range(0..palette.len())];
        let by = self.range(0.85, 1.1);
        color.map(|c| (c * by + self.range(-0.03, 0.03)).clamp(0.02, 0.95))
    }
    fn texture_seed(&mut self) -> u32 {
        self.rng.random()
    }
    /// Cloth, plaster, foliage: noise around a colour.
    pub fn rough(&mut self, color: Rgb, cell: f64) -> Texture {
        Texture::Noise { colors: [shaded(color, 0.66), shaded(color, 1.22)], cell: DVec3::splat(cell), seed: self.texture_seed() }
    }
    /// Wood with its grain along x.
    pub fn wood(&mut self) -> Texture {
        let color = self.color(&[[0.52, 0.35, 0.20], [0.66, 0.50, 0.32], [0.36, 0.23, 0.15], [0.74, 0.62, 0.46]]);
        Texture::Noise { colors: [shaded(color, 0.6), shaded(color, 1.2)], cell: v(0.7, 0.13, 0.13), seed: self.texture_seed() }
    }
    pub fn print(&mut self, line: f64) -> Texture {
        let paper = self.color(&[[0.90, 0.88, 0.80], [0.85, 0.78, 0.55], [0.62, 0.76, 0.80], [0.88, 0.66, 0.58]]);
        let accent = self.color(&[[0.75, 0.16, 0.12], [0.12, 0.32, 0.62], [0.10, 0.45, 0.28], [0.80, 0.50, 0.08]]);
        Texture::Print { colors: [paper, [0.10, 0.10, 0.14], accent], line, seed: self.texture_seed() }
    }
    pub fn patches(&mut self, cell: DVec3) -> Texture {
        let mut one = || self.color(&[[0.62, 0.16, 0.14], [0.16, 0.30, 0.52], [0.80, 0.68, 0.36], [0.22, 0.42, 0.28], [0.86, 0.84, 0.78], [0.42, 0.24, 0.44]]);
        Texture::Patches { colors: [one(), one(), one()], cell, seed: self.texture_seed() }
    }
    /// A floor of boards.
    pub fn planks(&mut self) -> Texture {
        let color = self.color(&[[0.56, 0.40, 0.26], [0.66, 0.54, 0.40], [0.44, 0.32, 0.24]]);
        Texture::Planks { colors: [shaded(color, 0.62), shaded(color, 1.2)], board: [1.1, 0.19], seed: self.texture_seed() }
    }
    /// The pattern of one wall: paper, bricks or plaster.
    pub fn wall(&mut self, kind: usize) -> Texture {
        let color = self.color(&[[0.84, 0.78, 0.66], [0.68, 0.78, 0.80], [0.82, 0.70, 0.62], [0.74, 0.80, 0.64]]);
        let seed = self.texture_seed();
        match kind % 3 {
            0 => Texture::Stripes { colors: [shaded(color, 0.80), shaded(color, 1.12)], width: 0.28, seed },
            1 => Texture::Bricks { colors: [[0.48, 0.27, 0.20], [0.76, 0.48, 0.36], [0.80, 0.76, 0.70]], brick: [0.46, 0.20], seed },
            _ => self.rough(color, 0.5),
        }
    }
    /// A solid of a piece of furniture at `base`.
    pub fn solid(&mut self, base: &Pose, shape: Shape, at: DVec3, texture: Texture) {
        self.objects.push(Object::matte(shape, texture, Motion::Placed(base.then(Pose::at(at)))));
    }
    fn cuboid(&mut self, base: &Pose, half: DVec3, at: DVec3, texture: Texture) {
        self.solid(base, Shape::Cuboid { half }, at, texture);
    }
    /// A thin round rod from one point to another.
    pub fn rod(&mut self, base: &Pose, from: DVec3, to: DVec3, radius: f64, texture: Texture) {
        let along = to - from;
        let pose = Pose { rotation: DQuat::from_rotation_arc(DVec3::Z, along.normalize_or(DVec3::Z)), translation: 0.5 * (from + to) };
        self.objects.push(Object::matte(Shape::Capsule { half: 0.5 * along.length(), radius }, texture, Motion::Placed(base.then(pose))));
    }
    fn legs(&mut self, base: &Pose, half: [f64; 2], height: f64, texture: Texture) {
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            self.rod(base, v(x * half[0], y * half[1], 0.02), v(x * half[0], y * half[1], height), 0.022, texture);
        }
    }
    pub fn table(&mut self, base: &Pose, half: [f64; 2], height: f64) {
        let wood = self.wood();
        self.cuboid(base, v(half[0], half[1], 0.025), v(0.0, 0.0, height - 0.025), wood);
        self.legs(base, [half[0] - 0.06, half[1] - 0.06], height - 0.05, wood);
    }
    pub fn chair(&mut self, base: &Pose) {
        let (wood, cloth) = (self.wood(), self.color(&[[0.62, 0.20, 0.16], [0.20, 0.34, 0.50], [0.70, 0.62, 0.42]]));
        let cloth = self.rough(cloth, 0.15);
        self.cuboid(base, v(0.22, 0.22, 0.03), v(0.0, 0.0, 0.45), cloth);
        self.legs(base, [0.19, 0.19], 0.44, wood);
        for x in [-0.19, 0.0, 0.19] {
            self.rod(base, v(x, 0.2, 0.46), v(x, 0.25, 0.92), 0.018, wood);
        }
        self.rod(base, v(-0.19, 0.25, 0.92), v(0.19, 0.25, 0.92), 0.025, wood);
        self.rod(base, v(-0.19, 0.23, 0.72), v(0.19, 0.23, 0.72), 0.018, wood);
    }
    pub fn sofa(&mut self, base: &Pose) {
        let color = self.color(&[[0.30, 0.42, 0.40], [0.55, 0.32, 0.26], [0.46, 0.44, 0.52]]);
        let cloth = self.rough(color, 0.22);
        let cushion = self.patches(DVec3::splat(0.13));
        self.cuboid(base, v(0.85, 0.35, 0.21), v(0.0, 0.0, 0.21), cloth);
        self.cuboid(base, v(0.85, 0.10, 0.22), v(0.0, 0.25, 0.62), cloth);
        for x in [-0.8, 0.8] {
            self.cuboid(base, v(0.10, 0.35, 0.12), v(x, 0.0, 0.53), cloth);
        }
        self.cuboid(base, v(0.17, 0.06, 0.17), v(-0.45, 0.08, 0.58), cushion);
    }
    pub fn shelf(&mut self, base: &Pose) {
        let wood = self.wood();
        self.cuboid(base, v(0.6, 0.02, 0.95), v(0.0, 0.16, 0.95), wood);
        for x in [-0.6, 0.6] {
            self.cuboid(base, v(0.02, 0.18, 0.95), v(x, 0.0, 0.95), wood);
        }
        for level in 0..4 {
            let z = 0.08 + 0.5 * f64::from(level);
            self.cuboid(base, v(0.6, 0.18, 0.02), v(0.0, 0.0, z), wood);
            let (height, from, to) = (self.range(0.13, 0.18), self.range(-0.55, -0.35), self.range(0.0, 0.5));
            let books = self.patches(v(0.075, 1.0, 0.5));
            self.cuboid(base, v(0.5 * (to - from), 0.12, height), v(0.5 * (from + to), 0.02, z + 0.02 + height), books);
        }
    }
    pub fn chest(&mut self, base: &Pose) {
        let wood = self.wood();
        let front = self.patches(v(0.42, 1.0, 0.27));
        self.cuboid(base, v(0.45, 0.22, 0.42), v(0.0, 0.0, 0.42), wood);
        self.cuboid(base, v(0.42, 0.02, 0.38), v(0.0, -0.22, 0.43), front);
        self.vase(&base.then(Pose::at(v(0.2, 0.0, 0.84))));
    }
    pub fn crates(&mut self, base: &Pose) {
        for (half, x, y, z, turn) in [(0.30, -0.2, 0.0, 0.30, 0.15), (0.24, 0.42, -0.05, 0.24, -0.3), (0.21, -0.12, 0.02, 0.81, 0.5)] {
            let print = self.print(0.10);
            let at = base.then(Pose { rotation: DQuat::from_rotation_z(turn), translation: v(x, y, z) });
            self.cuboid(&at, DVec3::splat(half), DVec3::ZERO, print);
        }
    }
    pub fn lamp(&mut self, base: &Pose) {
        let metal = Texture::Bands([0.16, 0.16, 0.18], [0.38, 0.36, 0.34], 0.0, 3.0);
        let shade = self.color(&[[0.88, 0.80, 0.58], [0.80, 0.46, 0.32], [0.55, 0.68, 0.62]]);
        self.solid(base, Shape::Cylinder { half: 0.02, radius: 0.16 }, v(0.0, 0.0, 0.02), metal);
        self.rod(base, v(0.0, 0.0, 0.04), v(0.0, 0.0, 1.45), 0.017, metal);
        self.solid(base, Shape::Cylinder { half: 0.15, radius: 0.19 }, v(0.0, 0.0, 1.50), Texture::Bands(shade, shaded(shade, 0.6), 12.0, 0.0));
    }
    pub fn plant(&mut self, base: &Pose) {
        let pot = self.color(&[[0.66, 0.36, 0.24], [0.30, 0.40, 0.55]]);
        let green = self.color(&[[0.20, 0.42, 0.16], [0.30, 0.48, 0.22]]);
        let (pot, stem, leaf) = (self.rough(pot, 0.12), self.rough([0.34, 0.26, 0.16], 0.1), self.rough(green, 0.12));
        self.solid(base, Shape::Cylinder { half: 0.17, radius: 0.17 }, v(0.0, 0.0, 0.17), pot);
        self.rod(base, v(0.0, 0.0, 0.34), v(0.02, 0.0, 0.9), 0.022, stem);
        for i in 0..9 {
            let (s, c) = (2.4 * f64::from(i) + self.range(-0.3, 0.3)).sin_cos();
            let (z, reach, rise) = (0.5 + 0.06 * f64::from(i), self.range(0.22, 0.36), self.range(0.10, 0.35));
            self.rod(base, v(0.02 * c, 0.02 * s, z), v(reach * c, reach * s, z + rise), 0.032, leaf);
        }
    }
    pub fn vase(&mut self, base: &Pose) {
        let color = self.color(&[[0.20, 0.38, 0.60], [0.74, 0.30, 0.20], [0.82, 0.78, 0.66]]);
        self.solid(base, Shape::Cylinder { half: 0.11, radius: 0.065 }, v(0.0, 0.0, 0.11), Texture::Bands(color, shaded(color, 0.55), 5.0, 14.0));
        let leaf = self.rough([0.34, 0.46, 0.20], 0.1);
        for i in 0..4 {
            let (s, c) = (1.7 * f64::from(i) + self.range(-0.3, 0.3)).sin_cos();
            self.rod(base, v(0.0, 0.0, 0.2), v(0.13 * c, 0.13 * s, 0.46), 0.013, leaf);
        }
    }
    /// Flat on a wall, around `at` in the wall's frame.
    pub fn poster(&mut self, base: &Pose, at: DVec3) {
        let (half, line) = (v(self.range(0.28, 0.5), 0.012, self.range(0.32, 0.5)), self.range(0.085, 0.12));
        let print = self.print(line);
        self.cuboid(base, half, at, print);
        self.cuboid(base, half * 1.06 - DVec3::Y * 0.006, at + DVec3::Y * 0.012, Texture::Plain([0.16, 0.13, 0.11]));
    }
    pub fn window(&mut self, base: &Pose, at: DVec3) {
        let view = Texture::Noise { colors: [[0.50, 0.66, 0.48], [0.80, 0.90, 0.98]], cell: v(0.5, 0.5, 0.3), seed: self.texture_seed() };
        let wood = self.rough([0.82, 0.80, 0.76], 0.2);
        self.cuboid(base, v(0.62, 0.01, 0.55), at, view);
        for x in [-0.62, 0.0, 0.62] {
            self.rod(base, at + v(x, -0.02, -0.55), at + v(x, -0.02, 0.55), 0.03, wood);
        }
        for z in [-0.55, 0.0, 0.55] {
            self.rod(base, at + v(-0.62, -0.02, z), at + v(0.62, -0.02, z), 0.03, wood);
        }
    }
    pub fn rug(&mut self, base: &Pose, half: [f64; 2]) {
        let warm = self.color(&[[0.58, 0.22, 0.18], [0.28, 0.36, 0.50], [0.36, 0.46, 0.34]]);
        let colors = [warm, [0.80, 0.74, 0.62], shaded(warm, 0.6)];
        let weave = Texture::Patches { colors, cell: DVec3::splat(0.19), seed: self.texture_seed() };
        let border = self.color(&[[0.46, 0.14, 0.14], [0.16, 0.22, 0.38]]);
        let border = self.rough(border, 0.2);
        self.cuboid(base, v(half[0], half[1], 0.008), v(0.0, 0.0, 0.008), weave);
        self.cuboid(base, v(half[0] + 0.14, half[1] + 0.14, 0.005), v(0.0, 0.0, 0.005), border);
    }
    /// A rope that sags between two points, in straight pieces.
    pub fn rope(&mut self, from: DVec3, to: DVec3, sag: f64) {
        let point = |t: f64| from + (to - from) * t - DVec3::Z * sag * (PI * t).sin();
        let hemp = Texture::Bands([0.72, 0.62, 0.42], [0.40, 0.32, 0.20], 0.0, 8.0);
        for i in 0..7 {
            self.rod(&Pose::at(DVec3::ZERO), point(f64::from(i) / 7.0), point(f64::from(i + 1) / 7.0), 0.016, hemp);
        }
    }
    /// Things on a table whose top is `base`.
    pub fn still_life(&mut self, base: &Pose) {
        self.vase(&base.then(Pose::at(v(0.05, 0.1, 0.0))));
        for (i, (half, turn)) in [(v(0.17, 0.12, 0.03), 0.3), (v(0.14, 0.11, 0.025), 0.9)].into_iter().enumerate() {
            let print = self.patches(v(0.08, 0.06, 0.2));
            let at = Pose { rotation: DQuat::from_rotation_z(turn), translation: v(-0.4, -0.05, 0.03 + 0.055 * i as f64) };
            self.cuboid(&base.then(at), half, DVec3::ZERO, print);
        }
        for i in 0..3 {
            let (s, c) = (TAU * f64::from(i) / 3.0 + 0.4).sin_cos();
            let color = self.color(&[[0.80, 0.18, 0.12], [0.86, 0.60, 0.14], [0.45, 0.60, 0.18]]);
            let fruit = self.rough(color, 0.06);
            self.solid(base, Shape::Sphere { radius: 0.055 }, v(0.42 + 0.065 * c, -0.08 + 0.065 * s, 0.055), fruit);
        }
        let mug = self.color(&[[0.84, 0.82, 0.78], [0.24, 0.42, 0.52]]);
        self.solid(base, Shape::Cylinder { half: 0.055, radius: 0.045 }, v(0.1, -0.25, 0.055), Texture::Bands(mug, shaded(mug, 0.6), 0.0, 16.0));
    }
}
