//! Solids around a local origin: rays against them, and distances from their surfaces.

use glam::DVec3;

/// Hits nearer than this are where a ray begins.
const NEAREST: f64 = 1e-6;

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
    /// All points within `radius` of a segment of the z axis.
    Capsule {
        /// Half of the segment's length, in world units.
        half: f64,
        /// Radius in world units.
        radius: f64,
    },
    /// A cylinder around the z axis with flat ends.
    Cylinder {
        /// Half of the height, in world units.
        half: f64,
        /// Radius in world units.
        radius: f64,
    },
}

impl Shape {
    /// The nearest hit of a local ray (unit direction) beyond a hair's breadth: distance and outward normal. From within a box, a capsule or a cylinder
    /// nothing is drawn: no camera of a scene is in one.
    pub fn intersect(&self, origin: DVec3, direction: DVec3) -> Option<(f64, DVec3)> {
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
                (near <= far && near > NEAREST).then_some((near, normal))
            }
            Self::Capsule { half, radius } => capsule(half, radius, origin, direction),
            Self::Cylinder { half, radius } => cylinder(half, radius, origin, direction),
        }
    }
    /// Distance of a local point from the surface, negative inside.
    pub fn distance(&self, p: DVec3) -> f64 {
        let of_box = |q: DVec3| q.max(DVec3::ZERO).length() + q.max_element().min(0.0);
        match *self {
            Self::Sphere { radius } => p.length() - radius,
            Self::Cuboid { half } => of_box(p.abs() - half),
            Self::Capsule { half, radius } => (p - DVec3::Z * p.z.clamp(-half, half)).length() - radius,
            Self::Cylinder { half, radius } => of_box(DVec3::new(p.x.hypot(p.y) - radius, p.z.abs() - half, f64::NEG_INFINITY)),
        }
    }
    /// Radius of the largest ball that fits into it, in world units.
    pub fn inner_radius(&self) -> f64 {
        match *self {
            Self::Sphere { radius } | Self::Capsule { radius, .. } => radius,
            Self::Cuboid { half } => half.min_element(),
            Self::Cylinder { half, radius } => half.min(radius),
        }
    }
    /// Radius of the smallest ball around the origin that holds it, in world units.
    pub fn outer_radius(&self) -> f64 {
        match *self {
            Self::Sphere { radius } => radius,
            Self::Cuboid { half } => half.length(),
            Self::Capsule { half, radius } => half + radius,
            Self::Cylinder { half, radius } => half.hypot(radius),
        }
    }
}

/// Where a ray enters the endless cylinder around z and where it leaves it; `None` if it misses. A ray along z is inside throughout or never.
fn tube(radius: f64, o: DVec3, d: DVec3) -> Option<(f64, f64)> {
    let (a, b, c) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius * radius);
    if a < 1e-18 {
        return (c <= 0.0).then_some((f64::NEG_INFINITY, f64::INFINITY));
    }
    let disc = b * b - a * c;
    (disc >= 0.0).then(|| ((-b - disc.sqrt()) / a, (-b + disc.sqrt()) / a))
}

fn capsule(half: f64, radius: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let (near, _) = tube(radius, o, d)?;
    let side = o + d * near;
    if side.is_finite() && side.z.abs() <= half {
        return (near > NEAREST).then(|| (near, DVec3::new(side.x, side.y, 0.0) / radius));
    }
    // The body is convex: a ray that does not enter through the side enters through an end.
    let ends = [-half, half].map(|z| {
        let from = o - DVec3::Z * z;
        let b = from.dot(d);
        let disc = b * b - (from.length_squared() - radius * radius);
        let t = -b - disc.max(0.0).sqrt();
        let normal = (from + d * t) / radius;
        (disc >= 0.0 && normal.z * z >= 0.0).then_some((t, normal))
    });
    ends.into_iter().flatten().min_by(|a, b| a.0.total_cmp(&b.0)).filter(|hit| hit.0 > NEAREST)
}

fn cylinder(half: f64, radius: f64, o: DVec3, d: DVec3) -> Option<(f64, DVec3)> {
    let (near, far) = tube(radius, o, d)?;
    let (low, high) = if d.z.abs() < 1e-12 {
        if o.z.abs() > half {
            return None;
        }
        (f64::NEG_INFINITY, f64::INFINITY)
    } else {
        let (a, b) = ((-half - o.z) / d.z, (half - o.z) / d.z);
        (a.min(b), a.max(b))
    };
    let t = near.max(low);
    if t > far.min(high) || t <= NEAREST {
        return None;
    }
    let p = o + d * t;
    Some((t, if near >= low { DVec3::new(p.x, p.y, 0.0) / radius } else { DVec3::Z * -d.z.signum() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [Shape; 4] = [
        Shape::Sphere { radius: 0.5 },
        Shape::Cuboid { half: DVec3::new(0.4, 0.3, 0.6) },
        Shape::Capsule { half: 0.5, radius: 0.2 },
        Shape::Cylinder { half: 0.3, radius: 0.4 },
    ];

    #[test]
    fn solids_are_hit_where_geometry_says() {
        let (t, n) = Shape::Sphere { radius: 0.5 }.intersect(DVec3::new(0.0, 0.0, 3.0), -DVec3::Z).unwrap();
        assert!((t - 2.5).abs() < 1e-12 && (n - DVec3::Z).length() < 1e-12);
        let (t, n) = Shape::Cuboid { half: DVec3::new(1.0, 2.0, 3.0) }.intersect(DVec3::new(-5.0, 0.5, 0.5), DVec3::X).unwrap();
        assert!((t - 4.0).abs() < 1e-12 && n == -DVec3::X);
        assert!(Shape::Cuboid { half: DVec3::ONE }.intersect(DVec3::new(-5.0, 1.5, 0.0), DVec3::X).is_none());
        let rod = Shape::Capsule { half: 0.5, radius: 0.2 };
        let (t, n) = rod.intersect(DVec3::new(0.0, 0.0, 3.0), -DVec3::Z).unwrap();
        assert!((t - 2.3).abs() < 1e-12 && (n - DVec3::Z).length() < 1e-12);
        assert!(rod.intersect(DVec3::new(0.0, -2.0, 0.75), DVec3::Y).is_none());
        let drum = Shape::Cylinder { half: 0.3, radius: 0.4 };
        let (t, n) = drum.intersect(DVec3::new(0.1, 0.0, -3.0), DVec3::Z).unwrap();
        assert!((t - 2.7).abs() < 1e-12 && n == -DVec3::Z);
        assert!(drum.intersect(DVec3::new(-2.0, 0.0, 0.35), DVec3::X).is_none());
    }

    /// Rays from around: a hit lies on the surface, its normal is the gradient of the distance, and nothing lies before it. A miss stays outside.
    #[test]
    fn hits_agree_with_distances() {
        for shape in SHAPES {
            let mut hits = 0;
            for i in 0..400 {
                let spread = |k: u32| (f64::from(i) * [0.618_034, 0.414_214, 0.732_051, 0.236_068][k as usize]).fract() * 2.0 - 1.0;
                let from = DVec3::new(spread(0), spread(1), 0.1 + spread(2)).normalize() * 3.0;
                let direction = (DVec3::new(spread(3), spread(1), spread(0)) * 0.6 - from).normalize();
                let found = shape.intersect(from, direction);
                let reach = found.map_or(6.0, |hit| hit.0 - 1e-3);
                for step in 0..200 {
                    assert!(shape.distance(from + direction * (reach * f64::from(step) / 200.0)) > -1e-3, "{shape:?} ray {i}");
                }
                if let Some((t, normal)) = found {
                    hits += 1;
                    let p = from + direction * t;
                    assert!(shape.distance(p).abs() < 1e-9 && (normal.length() - 1.0).abs() < 1e-9, "{shape:?} ray {i}");
                    assert!((shape.distance(p + normal * 1e-3) - 1e-3).abs() < 1e-5 && normal.dot(direction) < 1e-9, "{shape:?} ray {i}");
                    assert!(p.length() <= shape.outer_radius() + 1e-9);
                }
            }
            assert!(hits > 50, "{shape:?}: {hits}");
            assert!((shape.distance(DVec3::ZERO) + shape.inner_radius()).abs() < 1e-12);
        }
    }
}
