//! Trajectory error on a synthetic scene with known motion: trajectories of its Gaussians against the true ones, and images where the motion is, body by body.

use crate::data::procedural::{Body, ProceduralScene, Viewpoint};
use burn::tensor::Device;
use cc4dgs_core::metrics::psnr_of_mean_squared_error;
use cc4dgs_core::{Event, EventSink, HostGaussians, Registry, Result, Split};
use cc4dgs_play::{Model, Player};
use glam::DVec3;
use serde::Serialize;

/// Gaussians this near to an object's surface when it is first there belong to it. 0 is the deepest point, 1 the surface.
const NEAR_SURFACE: [f64; 2] = [0.7, 1.2];
/// Gaussians below this opacity count as invisible.
const LEAST_OPACITY: f32 = 0.1;
/// Displacements below this share of the coordinates are rounding errors of bodies that stand still.
const LEAST_DISPLACEMENT: f64 = 1e-9;

/// One moving body: a ball, or all parts of a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MotionScore {
    /// What it is.
    pub name: String,
    /// Index of its first object among the scene's objects.
    pub object: usize,
    /// Cycles of its motion over the sequence, if it repeats.
    pub cycles: Option<f64>,
    /// Gaussians on its surface when it is first there.
    pub gaussians: usize,
    /// Root-mean-square distance of their displacements since then from the true ones, over all frames at which they can be seen, as a share of the
    /// true displacement's root-mean-square: 0 follows exactly, 1 is as good as not moving. None without Gaussians or true displacements.
    pub trajectory_error: Option<f64>,
    /// PSNR over the pixels that the body covers, all held-out images, 8-bit: those it covers at any frame for a camera that takes all frames, those of the
    /// image's own frame for a moving camera. None where there are none.
    pub psnr_db: Option<f64>,
}

/// Scores every body of `scene` at the times of its frames, in the coordinates of `scene`.
pub fn motion_scores(model: &Model, scene: &ProceduralScene, registry: &Registry, device: &Device, events: &dyn EventSink) -> Result<Vec<MotionScore>> {
    if scene.bodies.is_empty() {
        return Ok(Vec::new());
    }
    let mut player = Player::new(model, registry, device)?.on(Some(scene.background));
    let gaussians_at = |player: &mut Player, time: f32| {
        let mut found = player.gaussians_at(time)?.to_host()?;
        model.to_dataset(&mut found);
        Result::Ok(found)
    };
    let mut followed = Vec::with_capacity(scene.bodies.len());
    for body in &scene.bodies {
        let start = first_time(scene, body);
        let gaussians = gaussians_at(&mut player, start as f32)?;
        followed.push(Followed { start, rows: on_body(scene, body, start, &gaussians), gaussians });
    }
    let held_out: Vec<Viewpoint> = scene.viewpoints().into_iter().filter(|v| v.split == Split::Test).collect();
    let masks: Vec<Vec<Vec<bool>>> = held_out.iter().map(|viewpoint| covered(scene, viewpoint)).collect();

    let mut distances = vec![[0.0f64; 3]; scene.bodies.len()];
    let mut errors = vec![(0.0f64, 0u64); scene.bodies.len()];
    for frame in 0..scene.frames {
        let time = scene.time(frame);
        let now = gaussians_at(&mut player, time as f32)?;
        for (followed, sums) in followed.iter().zip(&mut distances) {
            for &(row, object) in followed.rows.iter().filter(|&&(row, object)| scene.objects[object].is_there(time) && opacity(&now, row) >= LEAST_OPACITY) {
                let start = point(&followed.gaussians, row);
                let truth = scene.advect(object, start, followed.start, time) - start;
                sums[0] += (point(&now, row) - start - truth).length_squared();
                sums[1] += truth.length_squared();
                sums[2] += start.length_squared();
            }
        }
        for (viewpoint, masks) in held_out.iter().zip(&masks).filter(|(v, _)| v.frame.is_none_or(|own| own == frame)) {
            let found = player.frame(&model.normalisation.apply_camera(&viewpoint.camera), time as f32)?;
            let truth = scene.render(&viewpoint.camera, time);
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
    let scores = scene.bodies.iter().zip(followed).zip(distances).zip(errors).map(|(((body, followed), d), (error, count))| MotionScore {
        name: body.name.clone(),
        object: body.objects.start,
        cycles: body.cycles,
        gaussians: followed.rows.len(),
        trajectory_error: trajectory_error(d),
        psnr_db: psnr_of_sums(error, count),
    });
    Ok(scores.collect())
}

/// PSNR in dB of `count` values of 8 bits whose squared errors add up to `error`; `None` of no values.
fn psnr_of_sums(error: f64, count: u64) -> Option<f64> {
    (count > 0).then(|| psnr_of_mean_squared_error(error / (255.0f64.powi(2) * count as f64)))
}

/// The trajectory error from sums of squares over Gaussians and frames: of differences, of true displacements, and of the coordinates at the start.
fn trajectory_error([differences, displacements, coordinates]: [f64; 3]) -> Option<f64> {
    (displacements > LEAST_DISPLACEMENT.powi(2) * coordinates).then(|| (differences / displacements).sqrt())
}

/// The Gaussians of one body.
struct Followed {
    /// When the body is first there.
    start: f64,
    /// All Gaussians at that time.
    gaussians: HostGaussians,
    /// Those on the body, with the object they are on.
    rows: Vec<(usize, usize)>,
}

fn point(g: &HostGaussians, row: usize) -> DVec3 {
    DVec3::new(f64::from(g.means[3 * row]), f64::from(g.means[3 * row + 1]), f64::from(g.means[3 * row + 2]))
}

fn opacity(g: &HostGaussians, row: usize) -> f32 {
    1.0 / (1.0 + (-g.opacity_logits[row]).exp())
}

/// The time of the first frame at which the body is there.
fn first_time(scene: &ProceduralScene, body: &Body) -> f64 {
    let there = |time: &f64| body.objects.clone().any(|object| scene.objects[object].is_there(*time));
    (0..scene.frames).map(|frame| scene.time(frame)).find(there).unwrap_or(0.0)
}

/// The Gaussians on the body's surfaces at `time` that can be seen, each with the object it is nearest to.
fn on_body(scene: &ProceduralScene, body: &Body, time: f64, g: &HostGaussians) -> Vec<(usize, usize)> {
    let nearest = |row: usize| {
        let shares = body.objects.clone().map(|object| (scene.depth_share(object, point(g, row), time), object));
        shares.min_by(|a, b| (a.0 - 1.0).abs().total_cmp(&(b.0 - 1.0).abs())).filter(|(share, _)| (NEAR_SURFACE[0]..NEAR_SURFACE[1]).contains(share))
    };
    (0..g.len()).filter(|row| opacity(g, *row) >= LEAST_OPACITY).filter_map(|row| nearest(row).map(|(_, object)| (row, object))).collect()
}

/// Per body, the pixels it covers at any frame, or at the frame that the viewpoint takes. Traces one ray per pixel and frame, fewer than the images that are
/// compared need.
fn covered(scene: &ProceduralScene, viewpoint: &Viewpoint) -> Vec<Vec<bool>> {
    let pixels = (viewpoint.camera.width * viewpoint.camera.height) as usize;
    let mut masks = vec![vec![false; pixels]; scene.bodies.len()];
    for frame in viewpoint.frame.map_or(0..scene.frames, |own| own..own + 1) {
        let seen = scene.tracer(scene.time(frame)).objects_seen(&viewpoint.camera);
        for (mask, body) in masks.iter_mut().zip(&scene.bodies) {
            mask.iter_mut().zip(&seen).for_each(|(m, s)| *m |= s.is_some_and(|object| body.objects.contains(&object)));
        }
    }
    masks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::procedural::Shape;

    /// A Gaussian on the surface of every object of the bodies, at the time its body is first there, and one where nothing is.
    fn on_surfaces(scene: &ProceduralScene) -> HostGaussians {
        let mut g = HostGaussians::default();
        for body in &scene.bodies {
            for object in body.objects.clone() {
                let (shape, pose) = (scene.objects[object].shape, scene.objects[object].motion.pose(first_time(scene, body)));
                let aside = if let Shape::Cuboid { half } = shape { half.x } else { shape.inner_radius() };
                let at = scene.unit.apply(pose.apply(DVec3::X * aside).to_array());
                g.means.extend(at.map(|v| v as f32));
                g.opacity_logits.push(2.0);
            }
        }
        g.means.extend([1e7; 3]);
        g.opacity_logits.push(2.0);
        g
    }

    #[test]
    fn what_stands_still_has_no_trajectory() {
        assert_eq!(trajectory_error([4.0, 16.0, 100.0]), Some(0.5));
        assert_eq!((trajectory_error([1e-3, 1e-30, 100.0]), trajectory_error([0.0; 3])), (None, None));
    }

    #[test]
    fn sums_have_the_psnr_of_the_metric() {
        use cc4dgs_core::metrics::{Metric, PSNR_CEILING_DB, Rounding};
        let (a, b) = ([0.0f32, 51.0, 255.0], [5.0f32, 51.0, 251.0]);
        let unit = |values: [f32; 3]| values.map(|v| v / 255.0);
        let whole = Metric::psnr(Rounding::EightBit).score(&unit(a), &unit(b), [3, 1, 1], None).unwrap();
        let sums = [psnr_of_sums(25.0 + 16.0, 3), psnr_of_sums(0.0, 3), psnr_of_sums(0.0, 0)];
        assert!((sums[0].unwrap() - whole).abs() < 1e-9, "{sums:?}, {whole}");
        assert_eq!((sums[1], sums[2]), (Some(PSNR_CEILING_DB), None));
    }

    #[test]
    fn masks_cover_the_path_and_gaussians_belong_to_their_ball() {
        let scene = ProceduralScene::named("frequencies").unwrap();
        assert_eq!(scene.bodies.len(), 5);
        let g = on_surfaces(&scene);
        for (k, body) in scene.bodies.iter().enumerate() {
            assert_eq!(on_body(&scene, body, 0.0, &g), [(k, body.objects.start)]);
        }
        let viewpoint = scene.viewpoints().pop().unwrap();
        let masks = covered(&scene, &viewpoint);
        let still = scene.tracer(0.0).objects_seen(&viewpoint.camera).iter().filter(|s| **s == Some(scene.bodies[0].objects.start)).count();
        assert!(masks[0].iter().filter(|m| **m).count() > still, "it moves");
    }

    #[test]
    fn masks_cover_fast_bodies_at_every_frame() {
        let scene = ProceduralScene::named("frequencies").unwrap();
        let viewpoint = scene.viewpoints().pop().unwrap();
        let masks = covered(&scene, &viewpoint);
        // The ball of 16 cycles is at rest, on top, at rest and at the bottom in frames 0 to 3.
        for frame in 0..4 {
            let seen = scene.tracer(scene.time(frame)).objects_seen(&viewpoint.camera);
            for (mask, body) in masks.iter().zip(&scene.bodies) {
                let outside = mask.iter().zip(&seen).filter(|(m, s)| !**m && **s == Some(body.objects.start)).count();
                assert_eq!(outside, 0, "{}, frame {frame}", body.name);
            }
        }
    }

    #[test]
    fn figures_are_followed_in_any_unit_and_bodies_that_come_later_too() {
        for name in ["captures/dome", "captures/units", "captures/appear"] {
            let scene = ProceduralScene::named(name).unwrap();
            let g = on_surfaces(&scene);
            for body in &scene.bodies {
                let start = first_time(&scene, body);
                let rows = on_body(&scene, body, start, &g);
                assert!(rows.len() >= body.objects.len(), "{name}, {}: {rows:?}", body.name);
                assert!(rows.iter().all(|(row, _)| *row + 1 < g.len()), "{name}, {}", body.name);
                for (row, object) in rows {
                    let later = scene.advect(object, point(&g, row), start, 1.0);
                    assert!((0.7..1.2).contains(&scene.depth_share(object, later, 1.0)), "{name}, {}", body.name);
                }
            }
        }
        let late = ProceduralScene::named("captures/appear").unwrap();
        let start = late.bodies.iter().find(|b| b.name == "crate that appears").map(|b| first_time(&late, b)).unwrap();
        assert!((0.35..0.40).contains(&start), "{start}");
    }
}
