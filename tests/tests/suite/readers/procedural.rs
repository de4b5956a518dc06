//! The built-in scene, and points computed from images, compared with the known geometry.

use super::common::*;
use cc4dgs_core::{Limits, Scene, SceneOptions, Seed, Split};
use cc4dgs_train::data::assemble;
use cc4dgs_train::data::init::photo_points;
use cc4dgs_train::data::procedural::{NAMES, ProceduralScene, Rig};
use glam::DVec3;
use rand::Rng;
use std::path::Path;

fn builtin(name: &str, options: &SceneOptions) -> Scene {
    open(Path::new(&format!("procedural:{name}")), options, &Limits::default()).unwrap()
}

#[test]
fn the_default_is_as_described() {
    let scene = open(Path::new("procedural"), &options(), &Limits::default()).unwrap();
    assert_eq!((scene.split(Split::Train).len(), scene.split(Split::Test).len(), scene.frame_count), (120, 20, 10));
    let (first, last) = (&scene.views[0], &scene.views[139]);
    assert_eq!((first.time_norm, last.time_norm), (0.0, 1.0));
    let image = scene.frame(0).unwrap();
    assert_eq!((image.width, image.height, image.channels), (128, 128, 3));
    assert!(NAMES.iter().all(|n| ProceduralScene::named(n).is_ok()));
    let message = open(Path::new("procedural:tinny"), &options(), &Limits::default()).err().unwrap().to_string();
    assert!(message.contains("tiny"), "{message}");
}

#[test]
fn images_are_the_same_on_any_number_of_threads() {
    let render = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let scene = builtin("tiny", &options());
            (0..scene.views.len()).map(|v| scene.frame(v).unwrap().data.clone()).collect::<Vec<_>>()
        })
    };
    assert_eq!(render(1), render(3));
}

#[test]
fn still_pixels_stay_and_moving_objects_move() {
    let scene = builtin("default", &options());
    let view = |frame: usize| (0..scene.views.len()).find(|&v| scene.views[v].camera == 0 && scene.views[v].frame == frame).unwrap();
    let (a, b) = (scene.frame(view(0)).unwrap(), scene.frame(view(5)).unwrap());
    let changed = a.data.chunks_exact(3).zip(b.data.chunks_exact(3)).filter(|(p, q)| p != q).count() as f64 / (a.data.len() / 3) as f64;
    assert!((0.02..0.5).contains(&changed), "{:.1} % of the pixels change", 100.0 * changed);
    let still = builtin("static", &options());
    assert_eq!(still.frame_count, 1);
}

#[test]
fn the_points_are_near_the_surface_and_have_its_colour() {
    let truth = ProceduralScene::named("default").unwrap();
    let scene = builtin("default", &options());
    let points = scene.points.as_ref().unwrap();
    assert_eq!((points.positions.len(), points.colors.len()), (truth.points, truth.points));
    let mean = points.positions.iter().map(|p| distance(&truth, DVec3::from(dataset_point(&scene, *p)))).sum::<f64>() / points.positions.len() as f64;
    assert!(mean < truth.point_noise * 1.5, "mean distance to the surface {mean}");
}

#[test]
fn material_points_are_carried_along() {
    let truth = ProceduralScene { point_noise: 0.0, ..ProceduralScene::named("default").unwrap() };
    let (cloud, owners) = truth.surface_samples(300);
    let mut moved = 0;
    for (p, &object) in cloud.positions.iter().zip(&owners) {
        let p = DVec3::from(p.map(f64::from));
        let later = truth.advect(object, p, 0.0, 0.6);
        let motion = &truth.objects[object].motion;
        assert_eq!(motion.is_still(), (later - p).length() < 1e-9);
        moved += usize::from(!motion.is_still());
        // On the surface of its own object, at the later time.
        assert!(object_distance(&truth, object, later, 0.6) < 1e-6);
    }
    assert!(moved > 10, "{moved} of 300 samples are on moving objects");
}

#[test]
fn frames_can_be_finer_and_subsets_agree() {
    let fine = builtin("tiny", &SceneOptions { frames: Some([0, 7, 1]), ..Default::default() });
    assert_eq!(fine.frame_count, 7);
    let subset = builtin("tiny", &SceneOptions { frames: Some([1, 2, 2]), width: 20, ..Default::default() });
    assert_eq!((subset.frame_count, subset.camera(0).width, subset.camera(0).height), (2, 20, 16));
    let scene = builtin("tiny", &SceneOptions { width: 20, ..Default::default() });
    let at = |s: &Scene, frame: usize| (0..s.views.len()).find(|&v| s.views[v].frame == frame).unwrap();
    assert_eq!(subset.frame(at(&subset, 1)).unwrap(), scene.frame(at(&scene, 3)).unwrap());
}

/// Distance of a point to the surface of one object at a time, by the shape's own formula.
fn object_distance(truth: &ProceduralScene, object: usize, p: DVec3, time: f64) -> f64 {
    use cc4dgs_train::data::procedural::Shape;
    let o = &truth.objects[object];
    let local = o.motion.pose(time).inverse_apply(p);
    match o.shape {
        Shape::Sphere { radius } => (local.length() - radius).abs(),
        Shape::Cuboid { half } => {
            let q = local.abs() - half;
            (q.max(DVec3::ZERO).length() + q.max_element().min(0.0)).abs()
        }
        other => panic!("the first scenes have no {other:?}"),
    }
}

fn distance(truth: &ProceduralScene, p: DVec3) -> f64 {
    (0..truth.objects.len()).map(|o| object_distance(truth, o, p, 0.0)).fold(f64::INFINITY, f64::min)
}

#[test]
fn points_from_images_lie_on_the_truth() {
    // Distances between cameras as in a capture, and images large enough for matching.
    let truth = ProceduralScene { width: 240, height: 200, rig: Rig::Rings { train: 20, test: 2 }, frames: 1, ..ProceduralScene::named("default").unwrap() };
    let scene = assemble(truth.clone().into_raw("truth".into()), &options(), None, &Limits::default()).unwrap();
    let start = std::time::Instant::now();
    let cloud = photo_points(&scene, 5000, Seed::root(3)).unwrap();
    eprintln!("{} points in {:.2} s", cloud.positions.len(), start.elapsed().as_secs_f64());
    assert!(cloud.positions.len() > 3000, "{}", cloud.positions.len());
    let sorted = |points: Vec<[f32; 3]>| {
        let mut errors: Vec<f64> = points.iter().map(|p| distance(&truth, DVec3::from(dataset_point(&scene, *p)))).collect();
        errors.sort_by(f64::total_cmp);
        errors
    };
    let errors = sorted(cloud.positions);
    let (low, high) = scene.init_box.unwrap();
    let mut rng = Seed::root(4).rng();
    let random = sorted((0..2000).map(|_| std::array::from_fn(|k| rng.random_range(low[k]..high[k]))).collect());
    let (median, share) = (errors[errors.len() / 2], errors.iter().filter(|e| **e < 0.06).count() as f64 / errors.len() as f64);
    let chance = random[random.len() / 2];
    eprintln!("median distance {median:.4} (random points {chance:.4}), within 0.06: {:.1} %", 100.0 * share);
    // A pixel is 0.015 wide at the middle of the scene.
    assert!(median < 0.035 && share > 0.7 && median < 0.15 * chance, "median {median}, share {share}, chance {chance}");
    assert!(cloud.colors.iter().flatten().all(|c| (0.0..=1.0).contains(c)));
}

#[test]
fn points_from_images_do_not_depend_on_threads() {
    let make = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| photo_points(&builtin("tiny", &SceneOptions { width: 80, ..Default::default() }), 500, Seed::root(1)).unwrap())
    };
    let (a, b) = (make(1), make(3));
    assert_eq!(a, b);
    assert!(a.positions.len() > 100);
}
