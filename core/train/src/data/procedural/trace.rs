//! Rays against the objects at one instant, and images made of them.

use super::objects::{Object, Pose};
use cc4dgs_core::{Camera, Image8};
use glam::DVec3;
use rayon::prelude::*;

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

/// The objects frozen at one time.
pub struct Tracer {
    objects: Vec<(Object, Pose)>,
    background: [f32; 3],
}

/// World origin and unit direction of the ray through pixel coordinates (u, v); pixel centres lie at +0.5.
pub(super) fn pixel_ray(camera: &Camera, u: f64, v: f64) -> (DVec3, DVec3) {
    let (r, _) = camera.rotation_translation();
    let local = DVec3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
    (DVec3::from(camera.center_world()), (r.transpose() * local).normalize())
}

impl Tracer {
    /// The scene at `time_norm`.
    pub fn new(objects: &[Object], background: [f32; 3], time_norm: f64) -> Self {
        Self { objects: objects.iter().map(|o| (*o, o.motion.pose(time_norm))).collect(), background }
    }
    /// The nearest surface along a ray with unit direction.
    pub fn hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let mut nearest: Option<Hit> = None;
        for (index, (object, pose)) in self.objects.iter().enumerate() {
            let (o, d) = (pose.inverse_apply(origin), pose.rotation.conjugate() * direction);
            if let Some((distance, normal)) = object.shape.intersect(o, d)
                && nearest.is_none_or(|n| distance < n.distance)
            {
                nearest = Some(Hit { object: index, distance, point: origin + direction * distance, normal: pose.rotation * normal });
            }
        }
        nearest
    }
    /// The object at the centre of every pixel, row by row.
    pub fn objects_seen(&self, camera: &Camera) -> Vec<Option<usize>> {
        (0..camera.height * camera.width)
            .into_par_iter()
            .map(|i| {
                let (origin, direction) = pixel_ray(camera, f64::from(i % camera.width) + 0.5, f64::from(i / camera.width) + 0.5);
                self.hit(origin, direction).map(|hit| hit.object)
            })
            .collect()
    }
    /// Colour of a hit seen along `direction`: ambient, Lambert and a mild highlight of one distant light. No shadows, so that what stands still looks still.
    pub fn shade(&self, hit: &Hit, direction: DVec3) -> [f64; 3] {
        let light = DVec3::new(0.4, -0.3, 0.87).normalize();
        let (object, pose) = &self.objects[hit.object];
        let base = object.material.texture.color(pose.inverse_apply(hit.point));
        let diffuse = 0.40 + 0.60 * hit.normal.dot(light).max(0.0);
        let half = (light - direction).normalize();
        let highlight = object.material.specular * hit.normal.dot(half).max(0.0).powi(24);
        base.map(|c| (c * diffuse + highlight).min(1.0))
    }
    /// The colour along a ray.
    pub fn color(&self, origin: DVec3, direction: DVec3) -> [f64; 3] {
        match self.hit(origin, direction) {
            Some(hit) => self.shade(&hit, direction),
            None => self.background.map(f64::from),
        }
    }
    /// An image with `supersampling` x `supersampling` rays per pixel on a regular grid.
    pub fn render(&self, camera: &Camera, supersampling: u32) -> Image8 {
        let n = supersampling.max(1);
        let mut data = vec![0u8; camera.width as usize * camera.height as usize * 3];
        data.par_chunks_mut(camera.width as usize * 3).enumerate().for_each(|(row, line)| {
            for (column, px) in line.chunks_exact_mut(3).enumerate() {
                let mut sum = [0.0; 3];
                for sample in 0..n * n {
                    let offset = |i: u32| (f64::from(i) + 0.5) / f64::from(n);
                    let (origin, direction) = pixel_ray(camera, column as f64 + offset(sample % n), row as f64 + offset(sample / n));
                    let c = self.color(origin, direction);
                    sum = [sum[0] + c[0], sum[1] + c[1], sum[2] + c[2]];
                }
                for (p, s) in px.iter_mut().zip(sum) {
                    *p = (s / f64::from(n * n) * 255.0 + 0.5).clamp(0.0, 255.0) as u8;
                }
            }
        });
        Image8 { width: camera.width, height: camera.height, channels: 3, data }
    }
}
