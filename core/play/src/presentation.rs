//! How players show a model: its home camera, the cameras of its recording, the axis that points up.

use crate::orbit::middle_and_radius;
use crate::{Model, Orbit};
use cc4dgs_core::archive::{MAX_CAMERAS, Presentation};
use cc4dgs_core::{Camera, HostGaussians, Result, Similarity};
use glam::{DMat3, DVec3};

/// Size of home cameras in pixels; players resize them to their window.
const HOME: (u32, u32) = (960, 720);
/// Iterations of the power method for the upward axis.
const ITERATIONS: usize = 200;

/// `value` with nine decimals: cameras are stored as decimals, and short ones come back as they were, while those of 1e-17 may not.
fn rounded(value: f64) -> f64 {
    format!("{value:.9}").parse().unwrap_or(value)
}

/// `camera` as it will be read back from an archive.
fn storable(camera: &Camera) -> Camera {
    let mut out = camera.clone();
    for value in [&mut out.fx, &mut out.fy, &mut out.cx, &mut out.cy].into_iter().chain(out.world_to_camera.iter_mut().flatten()) {
        *value = rounded(*value);
    }
    out
}

/// The presentation of `model`, which was recorded by `cameras`, all in its coordinates. The first is the home camera; the others are thinned out to the number
/// that archives hold. Trained models have what their cameras look at in the origin; of others it is their middle.
pub fn of_recorded(model: &Model, cameras: &[Camera], up: Option<[f64; 3]>) -> Presentation {
    let target = if model.normalisation == Similarity::IDENTITY { middle_and_radius(&model.gaussians).0 } else { [0.0; 3] };
    Presentation { target: Some(target.map(|v| rounded(v) as f32)), ..of_cameras(cameras, up) }
}

/// The presentation of a model in training, which `cameras` record and whose origin they look at.
pub fn of_cameras(cameras: &[Camera], up: Option<[f64; 3]>) -> Presentation {
    let up = up.map_or_else(|| upward(cameras), DVec3::from);
    let step = cameras.len().div_ceil(MAX_CAMERAS).max(1);
    Presentation {
        up: Some(up.to_array().map(|v| rounded(v) as f32)),
        target: Some([0.0; 3]),
        home: cameras.first().map(storable),
        cameras: cameras.iter().step_by(step).map(storable).collect(),
        ..Presentation::default()
    }
}

/// The presentation of a model whose cameras are unknown: an orbit round its middle, with `up` a signed axis.
///
/// # Errors
/// As [`Orbit::around`].
pub fn of_gaussians(gaussians: &HostGaussians, up: [f64; 3]) -> Result<Presentation> {
    let orbit = Orbit { size: HOME, frames: 8, up, ..Orbit::default() };
    let cameras = orbit.around(gaussians)?;
    // Opposite cameras of a circle look down at its axis from the same height, so their viewing rays meet at the middle.
    let (a, b) = (&cameras[0], &cameras[4]);
    let (eye, forward, other) = (DVec3::from(a.center_world()), DVec3::from(a.forward_world()), DVec3::from(b.center_world()));
    let flat = 0.5 * (other - eye);
    let along = flat.length_squared() / flat.dot(forward).max(1e-12);
    let target = eye + along * forward;
    Ok(Presentation {
        up: Some(up.map(|v| v as f32)),
        target: Some(target.to_array().map(|v| rounded(v) as f32)),
        home: cameras.first().map(storable),
        ..Presentation::default()
    })
}

/// The direction that is up for all cameras: perpendicular to their rows of pixels, as nearly as can be.
fn upward(cameras: &[Camera]) -> DVec3 {
    let row = |c: &Camera, r: usize| DVec3::new(c.world_to_camera[r][0], c.world_to_camera[r][1], c.world_to_camera[r][2]);
    let mean = -cameras.iter().map(|c| row(c, 1)).sum::<DVec3>();
    let scatter = cameras.iter().map(|c| row(c, 0)).fold(DMat3::ZERO, |sum, r| sum + DMat3::from_cols(r * r.x, r * r.y, r * r.z));
    // The smallest eigenvector, by the power method on the matrix that has it as its largest.
    let flipped = DMat3::IDENTITY * (1.001 * cameras.len() as f64) - scatter;
    let start = mean.try_normalize().unwrap_or(DVec3::Z);
    let mut up = start;
    for _ in 0..ITERATIONS {
        up = (flipped * up).try_normalize().unwrap_or(start);
    }
    if up.dot(start) < 0.0 { -up } else { up }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::archive::Manifest;
    use cc4dgs_core::format::near_without_units;
    use cc4dgs_core::{GaussianFile, Rules};

    #[test]
    fn up_is_that_of_upright_cameras_whatever_they_look_at() {
        let camera = |eye: [f64; 3]| Camera::look_at("t", (8, 8), 1.0, eye, [0.0; 3], [0.0, -1.0, 0.0]);
        let rig = [camera([3.0, -2.5, 0.0]), camera([0.0, -2.0, 3.0]), camera([2.0, -3.0, 2.0])];
        let up = of_cameras(&rig, None).up.unwrap();
        assert!((up[1] + 1.0).abs() < 1e-3, "{up:?}");
        let one = of_cameras(&rig[..1], None);
        one.validate("t").unwrap();
        // Cameras survive being written as decimals.
        let manifest = Manifest { frame_count: 1, presentation: of_cameras(&rig, None), ..Default::default() };
        manifest.to_json().unwrap();
        assert!(one.up.unwrap()[1] < -0.5);
    }

    #[test]
    fn files_that_were_not_normalised_are_looked_at_in_their_middle() {
        let gaussians = HostGaussians { means: [2.0, 3.0, 4.0].repeat(3), opacity_logits: vec![3.0; 3], ..Default::default() };
        let mut model = Model::from_static(GaussianFile { gaussians, ..Default::default() }, 0);
        let cameras = [Camera::look_at("t", (8, 8), 1.0, [9.0, 3.0, 4.0], [2.0, 3.0, 4.0], [0.0, 0.0, 1.0])];
        let shown = of_recorded(&model, &cameras, None);
        assert_eq!((shown.target, shown.home.as_ref()), (Some([2.0, 3.0, 4.0]), Some(&storable(&cameras[0]))));
        model.normalisation = Similarity { scale: 0.5, ..Similarity::IDENTITY };
        assert_eq!(of_recorded(&model, &cameras, None).target, Some([0.0; 3]));
    }

    #[test]
    fn models_of_files_are_drawn_from_nearer_where_they_are_small() {
        let near = |size: f32| {
            let gaussians =
                HostGaussians { means: (0..30).map(|k| size * (k as f32 * 0.7).sin()).collect(), opacity_logits: vec![3.0; 10], ..Default::default() };
            let usual = Rules::default().near();
            // As the player draws them.
            let expected = near_without_units(gaussians.shown_box(), usual);
            let near = Model::from_static(GaussianFile { gaussians, ..Default::default() }, 0).render.near;
            assert_eq!(near.unwrap_or(usual), expected);
            near
        };
        assert_eq!(near(100.0), None);
        let small = near(1e-3).unwrap();
        assert!((1e-6..1e-4).contains(&small), "{small}");
    }

    #[test]
    fn an_orbit_is_home_where_no_camera_is_known() {
        let gaussians = HostGaussians { means: vec![2.0, 3.0, 4.0, 2.5, 3.0, 4.0], opacity_logits: vec![3.0; 2], ..Default::default() };
        let shown = of_gaussians(&gaussians, [0.0, 0.0, 1.0]).unwrap();
        shown.validate("t").unwrap();
        let (camera, target) = (shown.home.unwrap(), shown.target.unwrap());
        let seen: [f64; 3] =
            std::array::from_fn(|r| (0..3).map(|c| camera.world_to_camera[r][c] * f64::from(target[c])).sum::<f64>() + camera.world_to_camera[r][3]);
        assert!(seen[2] > 0.0 && seen[0].abs() < 1e-4 && seen[1].abs() < 1e-4, "{seen:?}");
        assert!((target[2] - 4.0).abs() < 1e-3);
    }
}
