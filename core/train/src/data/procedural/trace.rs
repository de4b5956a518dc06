//! Rays against the objects at one instant, and images made of them.

use super::objects::{Object, Pose};
use super::shapes::Shape;
use cc4dgs_core::{Camera, Image8, Similarity};
use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Edge of the squares of pixels that share a list of the objects they can see.
const TILE: u32 = 8;
/// Slack of the cone around a tile's rays: lenses bend the lines between the rays that it is computed from.
const CONE_SLACK: f64 = 1.1;

/// Slack of bounding balls, for rounding.
const BALL_SLACK: f64 = 1.0 + 1e-6;

/// Where a ray meets the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Index of the object.
    pub object: usize,
    /// Distance along the unit ray.
    pub distance: f64,
    /// World position.
    pub point: DVec3,
    /// Outward unit normal, world.
    pub normal: DVec3,
}

/// One object at the tracer's time, in metres.
struct Placed {
    object: Object,
    pose: Pose,
    /// Index in the scene.
    index: usize,
    outer_radius: f64,
}

impl Placed {
    /// No point of it is nearer to `eye`, except for rounding.
    fn least_distance(&self, eye: DVec3) -> f64 {
        (self.pose.translation - eye).length() - self.outer_radius * BALL_SLACK
    }
}

/// The objects frozen at one time.
pub struct Tracer {
    /// Those that are there.
    placed: Vec<Placed>,
    background: [f32; 3],
    /// From the dataset's coordinates to metres.
    to_metres: Similarity,
    /// From metres to the dataset's coordinates.
    unit: Similarity,
}

/// World origin and unit direction of the ray at pixel coordinates (u, v).
pub type Ray<'a> = dyn Fn(f64, f64) -> (DVec3, DVec3) + Sync + 'a;

/// The rays of a pinhole camera.
pub(super) struct PixelRays<'a> {
    camera: &'a Camera,
    origin: DVec3,
    to_world: DMat3,
}

impl<'a> PixelRays<'a> {
    pub fn new(camera: &'a Camera) -> Self {
        Self { camera, origin: DVec3::from(camera.center_world()), to_world: camera.rotation_translation().0.transpose() }
    }
    /// World origin and unit direction of the ray through pixel coordinates (u, v); pixel centres lie at +0.5.
    pub fn through(&self, u: f64, v: f64) -> (DVec3, DVec3) {
        let local = DVec3::new((u - self.camera.cx) / self.camera.fx, (v - self.camera.cy) / self.camera.fy, 1.0);
        (self.origin, (self.to_world * local).normalize())
    }
}

impl Tracer {
    /// The scene at `time_norm`; `unit` maps the objects' metres to the coordinates of rays and hits.
    pub fn new(objects: &[Object], background: [f32; 3], unit: Similarity, time_norm: f64) -> Self {
        let there = objects.iter().enumerate().filter(|(_, object)| object.is_there(time_norm));
        let placed = there.map(|(index, o)| Placed { object: *o, pose: o.motion.pose(time_norm), index, outer_radius: o.shape.outer_radius() });
        Self { placed: placed.collect(), background, to_metres: unit.inverse(), unit }
    }
    /// The nearest surface along a ray with unit direction.
    pub fn hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let (placed, hit) = self.nearest(self.placed.iter(), self.metres(origin), direction)?;
        Some(Hit { object: placed.index, distance: hit.distance * self.unit.scale, point: DVec3::from(self.unit.apply(hit.point.to_array())), ..hit })
    }
    /// The object at the centre of every pixel, row by row.
    pub fn objects_seen(&self, camera: &Camera) -> Vec<Option<usize>> {
        let rays = PixelRays::new(camera);
        (0..camera.height * camera.width)
            .into_par_iter()
            .map(|i| {
                let (origin, direction) = rays.through(f64::from(i % camera.width) + 0.5, f64::from(i / camera.width) + 0.5);
                self.hit(origin, direction).map(|hit| hit.object)
            })
            .collect()
    }
    /// How far the surface at the centre of every pixel is from the eye along `forward`, a unit vector; 0 where there is none. Row by row, for an image of
    /// `size` pixels.
    pub fn depths(&self, size: [u32; 2], forward: DVec3, ray: &Ray) -> Vec<f32> {
        let [width, height] = size;
        (0..height * width)
            .into_par_iter()
            .map(|i| {
                let (origin, direction) = ray(f64::from(i % width) + 0.5, f64::from(i / width) + 0.5);
                self.hit(origin, direction).map_or(0.0, |hit| (hit.distance * direction.dot(forward)) as f32)
            })
            .collect()
    }
    /// Colour of a hit seen along `direction`: ambient, Lambert and a mild highlight of one distant light. No shadows, so that what stands still looks still.
    pub fn shade(&self, hit: &Hit, direction: DVec3) -> [f64; 3] {
        let metric = Hit { point: self.metres(hit.point), ..*hit };
        self.placed.iter().find(|p| p.index == hit.object).map_or([0.0; 3], |p| shade(p, &metric, direction))
    }
    /// The colours 0..1 of an image of `size` pixels with `supersampling` x `supersampling` rays per pixel on a regular grid, row by row. `ray` gives world
    /// origin and unit direction at pixel coordinates (u, v).
    pub fn trace(&self, size: [u32; 2], supersampling: u32, ray: &Ray) -> Vec<[f64; 3]> {
        let [width, height] = size;
        let n = supersampling.max(1);
        let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(n);
        let ray = |u: f64, v: f64| {
            let (origin, direction) = ray(u, v);
            (self.metres(origin), direction)
        };
        let mut colors = vec![[0.0; 3]; width as usize * height as usize];
        colors.par_chunks_mut((TILE * width).max(1) as usize).enumerate().for_each(|(band, rows)| {
            let top = band as u32 * TILE;
            for left in (0..width).step_by(TILE as usize) {
                let right = (left + TILE).min(width);
                let seen = self.seen_through([left, top, right, (top + TILE).min(height)].map(f64::from), &ray);
                for (y, line) in rows.chunks_exact_mut(width as usize).enumerate() {
                    for x in left..right {
                        let mut sum = [0.0; 3];
                        for sample in 0..n * n {
                            let (origin, direction) = ray(f64::from(x) + offset(sample % n), f64::from(top) + y as f64 + offset(sample / n));
                            let c = match self.nearest(seen.iter().copied(), origin, direction) {
                                Some((placed, hit)) => shade(placed, &hit, direction),
                                None => self.background.map(f64::from),
                            };
                            sum = [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]];
                        }
                        line[x as usize] = sum.map(|s| s / f64::from(n * n));
                    }
                }
            }
        });
        colors
    }
    fn metres(&self, p: DVec3) -> DVec3 {
        DVec3::from(self.to_metres.apply(p.to_array()))
    }
    /// The nearest of some objects along a ray in metres; of two at one distance the first.
    fn nearest<'a>(&self, candidates: impl Iterator<Item = &'a Placed>, origin: DVec3, direction: DVec3) -> Option<(&'a Placed, Hit)> {
        let mut nearest: Option<(&Placed, f64, DVec3)> = None;
        for placed in candidates {
            // Most objects are missed, and their bounding balls too, which is cheaper to find out.
            let to = placed.pose.translation - origin;
            let (along, reach) = (to.dot(direction), placed.outer_radius * BALL_SLACK);
            if to.length_squared() - along * along > reach * reach || nearest.is_some_and(|n| along - reach > n.1) {
                continue;
            }
            let (o, d) = if placed.pose.rotation == DQuat::IDENTITY {
                (origin - placed.pose.translation, direction)
            } else {
                (placed.pose.inverse_apply(origin), placed.pose.rotation.conjugate() * direction)
            };
            if let Some((distance, normal)) = placed.object.shape.intersect(o, d)
                && nearest.is_none_or(|n| distance < n.1 || (distance == n.1 && placed.index < n.0.index))
            {
                nearest = Some((placed, distance, normal));
            }
        }
        nearest.map(|(placed, distance, normal)| {
            (placed, Hit { object: placed.index, distance, point: origin + direction * distance, normal: placed.pose.rotation * normal })
        })
    }
    /// The objects that rays through a rectangle of pixels `[left, top, right, bottom]` can meet: those whose bounding ball meets the cone around the rays.
    fn seen_through(&self, [left, top, right, bottom]: [f64; 4], ray: &dyn Fn(f64, f64) -> (DVec3, DVec3)) -> Vec<&Placed> {
        let (x, y) = (0.5 * (left + right), 0.5 * (top + bottom));
        let (eye, axis) = ray(x, y);
        let rim = [(left, top), (x, top), (right, top), (left, y), (right, y), (left, bottom), (x, bottom), (right, bottom)];
        let cone = CONE_SLACK * rim.iter().map(|&(u, v)| ray(u, v).1.angle_between(axis)).fold(0.0, f64::max) + 1e-6;
        let meets = |placed: &&Placed| {
            let to = placed.pose.translation - eye;
            let distance = to.length();
            let in_cone = distance <= placed.outer_radius || to.angle_between(axis) <= cone + (placed.outer_radius / distance).asin();
            in_cone && !leads_away(placed, eye, axis, cone)
        };
        let mut seen: Vec<&Placed> = self.placed.iter().filter(meets).collect();
        // The nearest first, so that few are asked once something is hit.
        seen.sort_by(|a, b| a.least_distance(eye).total_cmp(&b.least_distance(eye)));
        seen
    }
}

/// Whether all rays of a cone lead away from a box: from beyond one of its faces, further off.
fn leads_away(placed: &Placed, eye: DVec3, axis: DVec3, cone: f64) -> bool {
    let Shape::Cuboid { half } = placed.object.shape else { return false };
    let (o, d) = (placed.pose.inverse_apply(eye), placed.pose.rotation.conjugate() * axis);
    // The angle to the face's normal stays under a quarter turn.
    let least = (0.5 * PI - cone).max(0.0).cos();
    (0..3).any(|k| o[k].abs() > half[k] && d[k] * o[k].signum() > least && cone < 0.5 * PI)
}

fn shade(placed: &Placed, hit: &Hit, direction: DVec3) -> [f64; 3] {
    let light = DVec3::new(0.4, -0.3, 0.87).normalize();
    let base = placed.object.material.texture.color(placed.pose.inverse_apply(hit.point));
    let diffuse = 0.40 + 0.60 * hit.normal.dot(light).max(0.0);
    let half = (light - direction).normalize();
    let highlight = placed.object.material.specular * hit.normal.dot(half).max(0.0).powi(24);
    base.map(|c| (c * diffuse + highlight).min(1.0))
}

/// The colours 0..1, row by row, as an 8-bit image.
pub(super) fn quantised(width: u32, height: u32, colors: &[[f64; 3]]) -> Image8 {
    let data = colors.iter().flatten().map(|c| (c * 255.0 + 0.5).clamp(0.0, 255.0) as u8).collect();
    Image8 { width, height, channels: 3, data }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::procedural::ProceduralScene;
    use cc4dgs_core::Distortion;

    /// Rays that ask only the objects of their tile see what rays that ask all objects see, also through a lens.
    #[test]
    fn tiles_leave_out_nothing_that_is_seen() {
        let lens = Distortion::Brown { radial: [-0.22, 0.05, 0.0, 0.0], tangential: [0.0; 2] };
        for name in ["captures/dome", "captures/appear", "captures/units", "frequencies"] {
            let scene = ProceduralScene { width: 72, height: 52, ..ProceduralScene::named(name).unwrap() };
            let tracer = scene.tracer(0.4);
            for (camera, _) in scene.cameras().iter().step_by(3) {
                let rays = PixelRays::new(camera);
                let bent = |u: f64, v: f64| {
                    let (x, y) = lens.undistort((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy).unwrap();
                    rays.through(x * camera.fx + camera.cx, y * camera.fy + camera.cy)
                };
                let straight = |u: f64, v: f64| rays.through(u, v);
                let both: [&(dyn Fn(f64, f64) -> (DVec3, DVec3) + Sync); 2] = [&straight, &bent];
                for ray in both {
                    for (i, found) in tracer.trace([72, 52], 1, ray).iter().enumerate() {
                        let (origin, direction) = ray((i % 72) as f64 + 0.5, (i / 72) as f64 + 0.5);
                        let expected = tracer.hit(origin, direction).map_or(scene.background.map(f64::from), |hit| tracer.shade(&hit, direction));
                        assert!((0..3).all(|k| (found[k] - expected[k]).abs() < 1e-6), "{name}, {}, pixel {i}: {found:?}, {expected:?}", camera.name);
                    }
                }
            }
        }
    }
}
