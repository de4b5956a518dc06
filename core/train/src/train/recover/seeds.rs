//! Gaussians on spheres along tracks, with the colours of the images that show them.

use super::tracks::{Sighting, Track};
use super::{Context, Lost};
use crate::init::SH_C0;
use crate::train::TrainState;
use cc4dgs_core::{DensityPlan, Result, gate_value};
use cc4dgs_play::Moving;
use glam::DVec3;

/// Gaussians of one track.
const PER_TRACK: usize = 64;
/// Where their centres lie, as a share of the radius, and their standard deviation as a share of their distance.
const DEPTH: f64 = 0.85;
const SIZE: f64 = 0.5;
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
    let score = match state.moving {
        Moving::Scored { zeta } => 2.0 * zeta + 1.0,
        _ => 0.0,
    };
    let coefficients = state.set.get("sh_rest")?.dims()[1];
    let mut plan = DensityPlan::unchanged(state.set.len());
    for track in tracks {
        for k in 0..PER_TRACK {
            let z = 1.0 - (2.0 * k as f64 + 1.0) / PER_TRACK as f64;
            let (sin, cos) = (GOLDEN_ANGLE * k as f64).sin_cos();
            let around = (1.0 - z * z).sqrt();
            let normal = DVec3::new(around * cos, around * sin, z);
            let mean = track.position + normal * (DEPTH * track.radius);
            let spacing = track.radius * (4.0 * std::f64::consts::PI / PER_TRACK as f64).sqrt();
            let row = plan.copy(0);
            let colour = colour(context, lost, sightings, track, normal);
            plan.set(row, "means", &mean.as_vec3().to_array());
            plan.set(row, "log_scales", &[(SIZE * spacing).ln() as f32; 3]);
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
    }
    plan.report.cloned = PER_TRACK * tracks.len();
    Ok(plan)
}

/// The colour of the point of a track's sphere with this outward `normal`, in the image that sees it most from the front.
fn colour(context: &Context, lost: &[Lost], sightings: &[Sighting], track: &Track, normal: DVec3) -> [f32; 3] {
    let front = |&i: &usize| -sightings[i].direction.dot(normal);
    let Some(best) = track.sightings.iter().copied().max_by(|a, b| front(a).total_cmp(&front(b))) else { return [0.5; 3] };
    let Lost { view, image, .. } = &lost[sightings[best].image];
    let camera = context.job.scene.camera(*view);
    let (rotation, translation) = camera.rotation_translation();
    // Somewhat inside, so that the silhouette's mixed pixels are left out.
    let point = rotation * (track.at(sightings[best].time) + normal * (0.7 * track.radius)) + translation;
    if point.z <= 0.0 {
        return [0.5; 3];
    }
    let (w, h) = (camera.width as usize, camera.height as usize);
    let pixel = |v: f64, most: usize| (v.max(0.0) as usize).min(most - 1);
    let (x, y) = (pixel(camera.fx * point.x / point.z + camera.cx, w), pixel(camera.fy * point.y / point.z + camera.cy, h));
    [0, 1, 2].map(|k| image[k * w * h + y * w + x])
}
