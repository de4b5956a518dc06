//! Who and what moves in a capture.

use crate::data::procedural::{Arms, Body, Figure, Material, Motion, Object, Part, Path, Shape, Texture};
use glam::DVec3;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Moving objects, and which of them belong together.
#[derive(Clone, Debug, Default)]
pub(super) struct Cast {
    pub objects: Vec<Object>,
    pub bodies: Vec<Body>,
}

const SKIN: [f64; 3] = [0.80, 0.58, 0.46];

/// What a figure wears.
struct Clothes {
    shirt: [[f64; 3]; 2],
    trousers: [[f64; 3]; 2],
    shoes: [f64; 3],
    hair: [f64; 3],
}

const RED: Clothes = Clothes {
    shirt: [[0.78, 0.18, 0.14], [0.92, 0.86, 0.76]],
    trousers: [[0.14, 0.18, 0.34], [0.26, 0.32, 0.52]],
    shoes: [0.85, 0.85, 0.82],
    hair: [0.20, 0.12, 0.07],
};
const GREEN: Clothes = Clothes {
    shirt: [[0.12, 0.42, 0.30], [0.80, 0.74, 0.30]],
    trousers: [[0.42, 0.34, 0.24], [0.56, 0.48, 0.36]],
    shoes: [0.15, 0.13, 0.12],
    hair: [0.55, 0.38, 0.16],
};

impl Cast {
    fn add(&mut self, name: &str, cycles: Option<f64>, objects: impl IntoIterator<Item = Object>) {
        let first = self.objects.len();
        self.objects.extend(objects);
        self.bodies.push(Body { name: name.into(), objects: first..self.objects.len(), cycles });
    }
    fn figure(&mut self, name: &str, figure: Figure, clothes: &Clothes) {
        let noise = |colors: [[f64; 3]; 2], seed: u32| Texture::Noise { colors, cell: DVec3::splat(0.16), seed };
        let texture = |part: Part| match part {
            Part::Torso | Part::Shoulders | Part::UpperArm(_) => Texture::Bands(clothes.shirt[0], clothes.shirt[1], 0.0, 9.0),
            Part::Hips | Part::Thigh(_) | Part::Shin(_) => noise(clothes.trousers, 5),
            Part::Foot(_) => noise([clothes.shoes, clothes.shoes.map(|c| 0.6 * c)], 6),
            Part::Hair => noise([clothes.hair, clothes.hair.map(|c| 1.7 * c)], 7),
            Part::Head | Part::Forearm(_) | Part::Hand(_) => noise([SKIN, SKIN.map(|c| 0.78 * c)], 8),
        };
        let parts = Part::ALL.map(|part| Object::matte(part.shape(figure.height), texture(part), Motion::Part { figure, part }));
        self.add(name, None, parts);
    }
    fn ball(&mut self, name: &str, radius: f64, colors: [[f64; 3]; 2], motion: Motion) {
        let material = Material { texture: Texture::Checker(colors[0], colors[1], 1.1 * radius), specular: 0.2 };
        self.add(name, None, [Object { material, ..Object::matte(Shape::Sphere { radius }, Texture::Plain(colors[0]), motion) }]);
    }
    /// A lantern that hangs from the ceiling and swings, with its cord.
    fn lantern(&mut self, pivot: DVec3, swings: f64) {
        let hang = |length: f64| Motion::Swing { pivot, length, amplitude_rad: 0.3, swings };
        let shade = Texture::Bands([0.92, 0.62, 0.15], [0.45, 0.12, 0.30], 6.0, 4.0);
        self.add(
            "lantern",
            Some(swings),
            [
                Object::matte(Shape::Cylinder { half: 0.15, radius: 0.16 }, shade, hang(0.75)),
                Object::matte(Shape::Capsule { half: 0.29, radius: 0.012 }, Texture::Plain([0.12, 0.12, 0.12]), hang(0.3)),
            ],
        );
    }
}

/// A figure that walks around and waves now and then, a hopping ball and a swinging lantern. `rounds` of the shortest sequence.
pub(super) fn walkers(rounds: f64) -> Cast {
    let mut cast = Cast::default();
    let path = Path::Round { center: DVec3::new(0.1, 0.0, 0.0), radii: [0.75, 0.6], from_to_rad: [-0.6, -0.6 + 2.4 * rounds] };
    cast.figure("figure", Figure { height: 1.7, path, steps: 2.0 * rounds, arms: Arms::Alternate { waves: 3.0 * rounds, turns: rounds } }, &RED);
    let arc = [2.2, 2.2 - 1.9 * rounds];
    let motion = Motion::Arc { center: DVec3::new(0.0, 0.1, 0.17), radius: 1.25, from_to_rad: arc, hop: 0.45, hops: 2.0 * rounds };
    cast.ball("ball", 0.17, [[0.15, 0.40, 0.75], [0.95, 0.80, 0.25]], motion);
    cast.lantern(DVec3::new(-0.9, -0.7, 2.75), 1.5 * rounds);
    cast
}

/// A figure that works at the table of `Room::Table`, and a ball that rolls on it.
pub(super) fn at_table() -> Cast {
    let mut cast = Cast::default();
    let path = Path::Sits { at: DVec3::new(0.05, 1.62, 0.0), facing_rad: -FRAC_PI_2 };
    cast.figure("figure", Figure { height: 1.75, path, steps: 0.0, arms: Arms::Work(3.0) }, &RED);
    let motion = Motion::Sway { at: DVec3::new(-0.45, 0.72, 0.84), reach: DVec3::new(0.22, 0.10, 0.0), cycles: 2.0 };
    cast.ball("ball", 0.08, [[0.90, 0.45, 0.10], [0.98, 0.92, 0.80]], motion);
    cast
}

/// A figure that turns on the spot and waves, beside a swinging lantern.
pub(super) fn on_the_spot() -> Cast {
    let mut cast = Cast::default();
    let path = Path::Round { center: DVec3::ZERO, radii: [0.28, 0.28], from_to_rad: [0.4, 2.2] };
    cast.figure("figure", Figure { height: 1.7, path, steps: 3.0, arms: Arms::Alternate { waves: 8.0, turns: 2.0 } }, &GREEN);
    cast.lantern(DVec3::new(-0.7, 0.6, 2.75), 3.0);
    cast
}

/// A figure that marches and waves, with a ball around it, and nothing else.
pub(super) fn alone() -> Cast {
    let mut cast = Cast::default();
    let path = Path::Stays { at: DVec3::ZERO, facing_rad: 0.3 };
    cast.figure("figure", Figure { height: 1.7, path, steps: 2.0, arms: Arms::Wave(3.0) }, &RED);
    let motion = Motion::Arc { center: DVec3::new(0.0, 0.0, 0.35), radius: 0.75, from_to_rad: [0.0, TAU], hop: 0.3, hops: 3.0 };
    cast.ball("ball", 0.15, [[0.15, 0.50, 0.30], [0.92, 0.85, 0.35]], motion);
    cast
}

/// A figure that comes in through the door of `Room::Door`, and things that are suddenly there or gone.
pub(super) fn comers_and_goers() -> Cast {
    let mut cast = Cast::default();
    let path = Path::Round { center: DVec3::new(0.35, 3.55, 0.0), radii: [1.5, 2.9], from_to_rad: [1.9, -1.7] };
    cast.figure("figure", Figure { height: 1.7, path, steps: 5.0, arms: Arms::Swing }, &GREEN);
    let seen = |mut object: Object, visible: [f64; 2]| {
        object.visible = visible;
        object
    };
    let crate_of = |half: f64, colors: [[f64; 3]; 2], at: DVec3, turn_rad: f64| {
        let print = Texture::Print { colors: [colors[0], colors[1], [0.7, 0.2, 0.1]], line: 0.09, seed: 21 };
        Object::matte(Shape::Cuboid { half: DVec3::splat(half) }, print, Motion::Still { at, turn_rad })
    };
    cast.add(
        "crate that appears",
        None,
        [seen(crate_of(0.27, [[0.70, 0.52, 0.32], [0.25, 0.15, 0.08]], DVec3::new(-0.9, 0.2, 0.27), 0.4), [0.35, f64::INFINITY])],
    );
    cast.add(
        "crate that vanishes",
        None,
        [seen(crate_of(0.22, [[0.35, 0.50, 0.62], [0.92, 0.92, 0.85]], DVec3::new(0.95, -0.75, 0.22), 1.0), [f64::NEG_INFINITY, 0.6])],
    );
    let ball = Object::matte(
        Shape::Sphere { radius: 0.19 },
        Texture::Checker([0.85, 0.75, 0.15], [0.55, 0.12, 0.45], 0.2),
        Motion::Arc { center: DVec3::new(0.0, -0.2, 0.19), radius: 0.8, from_to_rad: [3.4, 5.4], hop: 0.5, hops: 2.0 },
    );
    cast.add("ball that comes and goes", None, [seen(ball, [0.2, 0.8])]);
    cast
}
