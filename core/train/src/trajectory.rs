//! Trajectory error on a synthetic scene with known motion: trajectories of its Gaussians against the true ones, and images where the motion is, object by object.

use crate::data::procedural::{Motion, ProceduralScene, Shape};
use burn::tensor::Device;
use cc4dgs_core::{Event, EventSink, HostGaussians, Registry, Result, Split};
use cc4dgs_play::{Model, Player};
use glam::DVec3;
use serde::Serialize;

/// Gaussians this near to a ball's surface at the first frame, as shares of its radius, belong to it.
const NEAR_SURFACE: [f64; 2] = [0.7, 1.2];
/// Gaussians below this opacity count as invisible.
const LEAST_OPACITY: f32 = 0.1;
/// Times at which the pixels that an object covers are collected.
const MOMENTS: usize = 24;

/// One swaying object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionScore {
    /// Index among the scene's objects.
    pub object: usize,
    /// Cycles of its motion over the sequence.
    pub cycles: f64,
    /// Gaussians on its surface at the first frame.
    pub gaussians: usize,
    /// Root-mean-square distance of their displacements since the first frame from the true ones, over all frames at which they can be seen, as a share of the
    /// true displacement's root-mean-square: 0 follows exactly, 1 is as good as not moving. None without Gaussians.
    pub trajectory_error: Option<f64>,
    /// PSNR over the pixels that the object ever covers, all held-out cameras and frames, 8-bit.
    pub psnr_db: f64,
}

/// Scores every swaying ball of `scene` at the times of its frames, in the coordinates of `scene`.
pub fn motion_scores(model: &Model, scene: &ProceduralScene, registry: &Registry, device: &Device, events: &dyn EventSink) -> Result<Vec<MotionScore>> {
    let balls: Vec<(usize, f64, f64)> = scene
        .objects
        .iter()
        .enumerate()
        .filter_map(|(index, object)| match (object.motion, object.shape) {
            (Motion::Sway { cycles, .. }, Shape::Sphere { radius }) => Some((index, cycles, radius)),
            _ => None,
        })
        .collect();
    if balls.is_empty() {
        return Ok(Vec::new());
    }
    let mut player = Player::new(model, registry, device)?.on(Some(scene.background));
    let gaussians_at = |player: &mut Player, time: f32| {
        let mut found = player.gaussians_at(time)?.to_host()?;
        model.to_dataset(&mut found);
        Result::Ok(found)
    };
    let first = gaussians_at(&mut player, 0.0)?;
    let owned: Vec<Vec<usize>> = balls.iter().map(|&(object, _, radius)| on_ball(scene, object, radius, &first)).collect();
    let cameras: Vec<_> = scene.cameras().into_iter().filter(|(_, split)| *split == Split::Test).map(|(camera, _)| camera).collect();
    let masks: Vec<Vec<Vec<bool>>> = cameras.iter().map(|camera| covered(scene, camera, &balls)).collect();

    let mut distances = vec![[0.0f64; 2]; balls.len()];
    let mut errors = vec![(0.0f64, 0u64); balls.len()];
    for frame in 0..scene.frames {
        let time = scene.time(frame);
        let now = gaussians_at(&mut player, time as f32)?;
        for ((&(object, _, _), rows), sums) in balls.iter().zip(&owned).zip(&mut distances) {
            for &row in rows.iter().filter(|&&row| opacity(&now, row) >= LEAST_OPACITY) {
                let start = point(&first, row);
                let truth = scene.advect(object, start, 0.0, time) - start;
                sums[0] += (point(&now, row) - start - truth).length_squared();
                sums[1] += truth.length_squared();
            }
        }
        for (camera, masks) in cameras.iter().zip(&masks) {
            let found = player.frame(&model.normalisation.apply_camera(camera), time as f32)?;
            let truth = scene.render(camera, time);
            for (mask, sum) in masks.iter().zip(&mut errors) {
                for (pixel, _) in mask.iter().enumerate().filter(|(_, covered)| **covered) {
                    for c in 3 * pixel..3 * pixel + 3 {
                        sum.0 += (f64::from(found.data[c]) - f64::from(truth.data[c])).powi(2);
                        sum.1 += 1;
                    }
                }
            }
        }
        events.emit(&Event::Progress { task: "trajectories".into(), done: frame as u64 + 1, total: scene.frames as u64 });
    }
    let scores = balls.iter().zip(owned).zip(distances).zip(errors).map(|(((&(object, cycles, _), rows), d), (error, count))| MotionScore {
        object,
        cycles,
        gaussians: rows.len(),
        trajectory_error: (d[1] > 0.0).then(|| (d[0] / d[1]).sqrt()),
        psnr_db: 10.0 * (255.0f64.powi(2) * count.max(1) as f64 / error.max(1e-9)).log10(),
    });
    Ok(scores.collect())
}

fn point(g: &HostGaussians, row: usize) -> DVec3 {
    DVec3::new(f64::from(g.means[3 * row]), f64::from(g.means[3 * row + 1]), f64::from(g.means[3 * row + 2]))
}

fn opacity(g: &HostGaussians, row: usize) -> f32 {
    1.0 / (1.0 + (-g.opacity_logits[row]).exp())
}

/// The Gaussians on the ball's surface at time 0 that can be seen.
fn on_ball(scene: &ProceduralScene, object: usize, radius: f64, g: &HostGaussians) -> Vec<usize> {
    let pose = scene.objects[object].motion.pose(0.0);
    let near = |row: &usize| (NEAR_SURFACE[0]..NEAR_SURFACE[1]).contains(&(pose.inverse_apply(point(g, *row)).length() / radius));
    (0..g.len()).filter(|row| opacity(g, *row) >= LEAST_OPACITY && near(row)).collect()
}

/// Per ball, the pixels it covers at some moment.
fn covered(scene: &ProceduralScene, camera: &cc4dgs_core::Camera, balls: &[(usize, f64, f64)]) -> Vec<Vec<bool>> {
    let pixels = (camera.width * camera.height) as usize;
    let mut masks = vec![vec![false; pixels]; balls.len()];
    for moment in 0..MOMENTS {
        let seen = scene.tracer(moment as f64 / MOMENTS as f64).objects_seen(camera);
        for (mask, &(object, _, _)) in masks.iter_mut().zip(balls) {
            mask.iter_mut().zip(&seen).for_each(|(m, s)| *m |= *s == Some(object));
        }
    }
    masks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_cover_the_path_and_gaussians_belong_to_their_ball() {
        let scene = ProceduralScene::named("frequencies").unwrap();
        let balls: Vec<usize> = (0..scene.objects.len()).filter(|&k| matches!(scene.objects[k].motion, Motion::Sway { .. })).collect();
        assert_eq!(balls.len(), 5);
        let mut g = HostGaussians::default();
        for &ball in &balls {
            let Shape::Sphere { radius } = scene.objects[ball].shape else { panic!("a ball") };
            let at = scene.objects[ball].motion.pose(0.0).apply(DVec3::X * radius);
            g.means.extend(at.as_vec3().to_array());
            g.opacity_logits.push(2.0);
        }
        for (k, &ball) in balls.iter().enumerate() {
            let Shape::Sphere { radius } = scene.objects[ball].shape else { panic!("a ball") };
            assert_eq!(on_ball(&scene, ball, radius, &g), [k]);
        }
        let (camera, _) = scene.cameras().pop().unwrap();
        let masks = covered(&scene, &camera, &[(balls[0], 1.0, 0.2)]);
        let still = scene.tracer(0.0).objects_seen(&camera).iter().filter(|s| **s == Some(balls[0])).count();
        assert!(masks[0].iter().filter(|m| **m).count() > still, "it moves");
    }
}
