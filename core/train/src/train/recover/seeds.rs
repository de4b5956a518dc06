//! Gaussians on spheres along tracks, with the colours of the images that show them.

use super::tracks::{Sighting, Track};
use super::{Context, Lost};
use crate::data::init::limit_sizes_to;
use crate::init::SH_C0;
use crate::train::TrainState;
use crate::train::parents::Parents;
use cc4dgs_core::{DensityPlan, Event, HostGaussians, Result, Scene, gate_value};
use cc4dgs_play::Moving;
use glam::DVec3;
use std::collections::BTreeMap;

/// Gaussians of one track.
pub(super) const PER_TRACK: usize = 64;
/// Where their centres lie, as a share of the radius, and their standard deviation as a share of their distance.
const DEPTH: f64 = 0.85;
const SIZE: f64 = 0.5;
/// Largest standard deviation, as a share of the width of the image, in the nearest camera: that of the largest regions that are looked for. The images that
/// show the thing hold to it anyway, but another camera may be much nearer to it.
const WIDTH_SHARE: f64 = 0.025;
/// Their opacity as a logit: 0.8.
const OPACITY_LOGIT: f32 = 1.386;
/// Their gate: they are there during their life only.
const GATE: f32 = 0.01;
/// Falloff of their lives as a share of the half-width.
const FALLOFF: f64 = 0.5;
/// The golden angle in radians, by which points of a spiral are spread evenly over a sphere.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;

/// A plan that keeps all Gaussians and adds those of `tracks`; `half_width` of their lives is a share of the sequence.
pub(super) fn plan(context: &Context, state: &TrainState, lost: &[Lost], sightings: &[Sighting], tracks: &[Track], half_width: f64) -> Result<DensityPlan> {
    let scene: &Scene = &context.job.scene;
    let score = match state.moving {
        Moving::Scored { zeta } => 2.0 * zeta + 1.0,
        _ => 0.0,
    };
    let coefficients = state.set.get("sh_rest")?.dims()[1];
    let parents = Parents::new(&state.set.host_gaussians()?, state.moving);
    let points: Vec<(&Track, DVec3)> = tracks.iter().flat_map(|track| normals().map(move |normal| (track, normal))).collect();
    let posed = context.posed_scene(&context.job.scene, state)?;
    let (host, capped) = gaussians(&posed, &points);
    let pixels: Vec<Option<Pixel>> = points.iter().map(|&(track, normal)| pixel_of(lost, sightings, track, normal)).collect();
    let colours = colours_of(scene, &pixels, context.job.config.background()?)?;
    let mut plan = DensityPlan::unchanged(state.set.len());
    for (i, (&(track, _), colour)) in points.iter().zip(colours).enumerate() {
        let row = parents.copy(&mut plan, [0, 1, 2].map(|k| host.means[3 * i + k]));
        plan.set(row, "log_scales", &host.log_scales[3 * i..3 * i + 3]);
        plan.set(row, "quaternions", &[1.0, 0.0, 0.0, 0.0]);
        plan.set(row, "opacity_logits", &[OPACITY_LOGIT]);
        plan.set(row, "sh_dc", &colour.map(|c| (c - 0.5) / SH_C0));
        if coefficients > 0 {
            plan.set(row, "sh_rest", &vec![0.0; coefficients]);
        }
        plan.set(row, "dynamic_scores", &[score]);
        plan.set(row, "life_center", &[track.time as f32]);
        plan.set(row, "life_log_half_width", &[half_width.ln() as f32]);
        plan.set(row, "life_log_falloff", &[(FALLOFF * half_width).ln() as f32]);
        plan.set(row, "life_gate", &[gate_value(GATE)]);
        plan.set(row, "velocity", &track.velocity.as_vec3().to_array());
    }
    plan.report.cloned = points.len();
    if capped > 0 {
        let message = format!("{capped} of {} Gaussians along tracks made smaller, because each would cover much of an image", points.len());
        context.job.events.emit(&Event::Note { object: "recover".into(), message });
    }
    Ok(plan)
}

/// Outward normals, evenly spread over a sphere.
fn normals() -> impl Iterator<Item = DVec3> {
    (0..PER_TRACK).map(|k| {
        let z = 1.0 - (2.0 * k as f64 + 1.0) / PER_TRACK as f64;
        let (sin, cos) = (GOLDEN_ANGLE * k as f64).sin_cos();
        let around = (1.0 - z * z).sqrt();
        DVec3::new(around * cos, around * sin, z)
    })
}

/// Centres and scales of Gaussians for the points of spheres along tracks, given by their outward normals, and how many of them were made smaller.
fn gaussians(scene: &Scene, points: &[(&Track, DVec3)]) -> (HostGaussians, usize) {
    let mut host = HostGaussians { opacity_logits: vec![OPACITY_LOGIT; points.len()], ..Default::default() };
    for &(track, normal) in points {
        let mean = track.position + normal * (DEPTH * track.radius);
        let spacing = track.radius * (4.0 * std::f64::consts::PI / PER_TRACK as f64).sqrt();
        host.means.extend(mean.as_vec3().to_array());
        host.log_scales.extend([(SIZE * spacing).ln() as f32; 3]);
    }
    let capped = limit_sizes_to(scene, &mut host, WIDTH_SHARE);
    (host, capped)
}

/// A pixel of a view, by its index in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Pixel {
    view: usize,
    index: usize,
}

/// The pixel that shows the point of a track's sphere with this outward `normal`, in the image that sees it most from the front; `None` where that is behind
/// the camera.
fn pixel_of(lost: &[Lost], sightings: &[Sighting], track: &Track, normal: DVec3) -> Option<Pixel> {
    let front = |&i: &usize| -sightings[i].direction.dot(normal);
    let best = track.sightings.iter().copied().max_by(|a, b| front(a).total_cmp(&front(b)))?;
    let Lost { view, camera, .. } = &lost[sightings[best].image];
    let (rotation, translation) = camera.rotation_translation();
    // Somewhat inside, so that the silhouette's mixed pixels are left out.
    let point = rotation * (track.at(sightings[best].time) + normal * (0.7 * track.radius)) + translation;
    if point.z <= 0.0 {
        return None;
    }
    let (w, h) = (camera.width as usize, camera.height as usize);
    let pixel = |v: f64, most: usize| (v.max(0.0) as usize).min(most - 1);
    let (x, y) = (pixel(camera.fx * point.x / point.z + camera.cx, w), pixel(camera.fy * point.y / point.z + camera.cy, h));
    Some(Pixel { view: *view, index: y * w + x })
}

/// The colours of pixels, grey for those that are none. The image of each view is loaded once, and one is held at a time.
fn colours_of(scene: &Scene, pixels: &[Option<Pixel>], background: [f32; 3]) -> Result<Vec<[f32; 3]>> {
    let mut of_view: BTreeMap<usize, Vec<(usize, usize)>> = BTreeMap::new();
    for (i, pixel) in pixels.iter().enumerate() {
        if let Some(Pixel { view, index }) = *pixel {
            of_view.entry(view).or_default().push((i, index));
        }
    }
    let mut colours = vec![[0.5; 3]; pixels.len()];
    for (view, wanted) in of_view {
        let planes = scene.frame(view)?.to_planes(background);
        for (i, index) in wanted {
            colours[i] = [0, 1, 2].map(|k| planes[k * (planes.len() / 3) + index]);
        }
    }
    Ok(colours)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::{Camera, FrameSource, Image8, Split, View};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Images of 4x2 pixels whose values say view, pixel and channel; counts how many are loaded.
    #[derive(Default)]
    struct Counted(AtomicUsize);
    impl FrameSource for Counted {
        fn load(&self, view: usize) -> Result<Image8> {
            self.0.fetch_add(1, Ordering::Relaxed);
            Ok(Image8 { width: 4, height: 2, channels: 3, data: (0..24).map(|i| (100 * view + i) as u8).collect() })
        }
    }

    /// Two cameras on one axis, 4 and 2 units from the origin, at which they look.
    fn scene(source: Arc<Counted>) -> Scene {
        let camera = |k: usize| Camera::look_at(&format!("c{k}"), (4, 2), 1.0, [0.0, 0.0, 2.0 * k as f64 - 4.0], [0.0; 3], [0.0, 1.0, 0.0]);
        let view = |k: usize| View { camera: k, frame: k, time_norm: k as f32, split: Split::Train };
        Scene::new("s", (0..2).map(camera).collect(), (0..2).map(view).collect(), source, 0).unwrap()
    }

    #[test]
    fn colours_load_each_image_once() {
        let source = Arc::new(Counted::default());
        let scene = scene(source.clone());
        let pixel = |view: usize, index: usize| Some(Pixel { view, index });
        let found = colours_of(&scene, &[pixel(1, 7), None, pixel(0, 2), pixel(1, 0), pixel(0, 2)], [0.0; 3]).unwrap();
        let value = |view: usize, index: usize| [0, 1, 2].map(|k| (100 * view + 3 * index + k) as f32 / 255.0);
        assert_eq!(found, [value(1, 7), [0.5; 3], value(0, 2), value(1, 0), value(0, 2)]);
        assert_eq!(source.0.load(Ordering::Relaxed), 2, "one load for each of two views");
    }

    #[test]
    fn no_gaussian_covers_much_of_an_image() {
        let scene = scene(Arc::default());
        let of = |radius: f64| {
            let track = Track { time: 0.5, position: DVec3::ZERO, velocity: DVec3::ZERO, radius, sightings: Vec::new() };
            let points: Vec<(&Track, DVec3)> = normals().map(|normal| (&track, normal)).collect();
            gaussians(&scene, &points)
        };
        let (small, capped) = of(0.05);
        assert_eq!((small.len(), capped), (PER_TRACK, 0));
        let (large, capped) = of(0.5);
        assert_eq!(capped, PER_TRACK);
        // The share of the width that a unit of length covers at a unit's depth.
        let magnification = scene.cameras[1].fx / 4.0;
        for (mean, scales) in large.means.chunks_exact(3).zip(large.log_scales.chunks_exact(3)) {
            let share = f64::from(scales[0].exp()) * magnification / (2.0 + f64::from(mean[2]));
            assert!(share < 1.01 * WIDTH_SHARE, "{share}");
        }
    }
}
