//! The real scenes, if they are present.

use super::common::*;
use cc4dgs_core::{Limits, SceneOptions, Seed, Split};
use cc4dgs_train::data::init::photo_points;

#[test]
fn dnerf_mutant() {
    let Some(path) = real("dnerf_mutant") else { return };
    let scene = open(&path, &SceneOptions { width: 400, ..Default::default() }, &Limits::default()).unwrap();
    assert_eq!([Split::Train, Split::Test, Split::Validation].map(|split| scene.split(split).len()), [150, 20, 20]);
    assert_eq!(scene.frame_count, 150);
    assert!((scene.normalisation.scale - 1.0).abs() < 0.02, "{:?}", scene.normalisation);
    for camera in scene.cameras.iter().map(|c| scene.normalisation.inverse().apply_camera(c)) {
        let (u, v, z) = project(&camera, [0.0; 3]);
        assert!((u - 200.0).abs() < 1.0 && (v - 200.0).abs() < 1.0 && (z - 4.031).abs() < 0.01, "{}: origin at ({u}, {v}, {z})", camera.name);
    }
    let image = scene.frame(0).unwrap();
    assert_eq!((image.width, image.channels), (400, 4));
    // Something is opaque near the middle, the corner is empty.
    assert!(image.data[3] == 0 && image.data[(200 * 400 + 200) * 4 + 3] > 200);
}

#[test]
fn panoptic_basketball() {
    let Some(path) = real("panoptic_basketball") else { return };
    let scene = open(&path, &SceneOptions { frames: Some([0, 30, 1]), ..Default::default() }, &Limits::default()).unwrap();
    let names = |split| {
        let mut names: Vec<String> = scene.split(split).iter().map(|&v| scene.camera(v).name.clone()).collect();
        names.sort();
        names.dedup();
        names
    };
    assert_eq!((names(Split::Train).len(), names(Split::Test)), (27, ["0", "10", "15", "30"].map(String::from).to_vec()));
    assert_eq!((scene.cameras.len(), scene.views.len()), (31, 31 * 30));
    let (low, high) = scene.init_box.unwrap();
    let middle: [f64; 3] = std::array::from_fn(|k| f64::from(low[k] + high[k]) / 2.0);
    for camera in &scene.cameras {
        let (u, v, z) = project(camera, middle);
        assert!(z > 1.0 && (0.0..640.0).contains(&u) && (0.0..360.0).contains(&v), "camera {} sees the middle at ({u:.0}, {v:.0}, {z:.2})", camera.name);
    }
    assert_eq!(scene.frame(3).unwrap().width, 640);
    assert!(scene.foreground_masks.is_some());
}

#[test]
fn panoptic_points_agree_with_a_held_out_camera() {
    let Some(path) = real("panoptic_basketball") else { return };
    let scene = open(&path, &SceneOptions { frames: Some([0, 1, 1]), ..Default::default() }, &Limits::default()).unwrap();
    let start = std::time::Instant::now();
    let cloud = photo_points(&scene, 40_000, Seed::root(0)).unwrap();
    eprintln!("{} points in {:.2} s", cloud.positions.len(), start.elapsed().as_secs_f64());
    assert!(cloud.positions.len() > 20_000);
    // The nearest point per block of pixels, projected into a held-out camera, must be closer to its image than shuffled points are.
    let mut errors = [0.0, 0.0];
    for &view in &scene.split(Split::Test) {
        let (camera, image) = (scene.camera(view), scene.frame(view).unwrap());
        let mut nearest = std::collections::BTreeMap::new();
        for (p, c) in cloud.positions.iter().zip(&cloud.colors) {
            let (u, v, z) = project(camera, p.map(f64::from));
            if z > 0.1 && (0.0..640.0).contains(&u) && (0.0..360.0).contains(&v) {
                let slot = nearest.entry((u as usize / 6, v as usize / 6)).or_insert((z, u as usize, v as usize, *c));
                if z < slot.0 {
                    *slot = (z, u as usize, v as usize, *c);
                }
            }
        }
        let points: Vec<_> = nearest.into_values().collect();
        let difference = |shift: usize| {
            let n = points.len();
            let sum: f64 = (0..n)
                .map(|i| {
                    let (_, u, v, _) = points[i];
                    let c = points[(i + shift) % n].3;
                    (0..3).map(|k| (f64::from(c[k]) - f64::from(image.data[(v * 640 + u) * 3 + k]) / 255.0).abs()).sum::<f64>() / 3.0
                })
                .sum();
            sum / n as f64
        };
        let (own, shuffled) = (difference(0), difference(points.len() / 2));
        eprintln!("camera {}: {} blocks of {}, colour difference {own:.3}, shuffled {shuffled:.3}", camera.name, points.len(), 107 * 60);
        errors = [errors[0] + own, errors[1] + shuffled];
    }
    assert!(errors[0] < 0.6 * errors[1], "{errors:?}");
}

#[test]
fn n3dv_sample() {
    let Some(path) = real("n3dv_flame_steak_1frame") else { return };
    let scene = open(&path, &SceneOptions { width: 676, ..Default::default() }, &Limits::default()).unwrap();
    assert_eq!((scene.split(Split::Train).len(), scene.split(Split::Test).len(), scene.frame_count), (4, 1, 1));
    assert_eq!(scene.camera(scene.split(Split::Test)[0]).name, "1");
    let camera = scene.camera(0);
    assert_eq!((camera.width, camera.height, camera.cx), (676, 507, 338.0));
    assert!((camera.fx - 1462.067 / 4.0).abs() < 0.01);
    assert_eq!(scene.frame(0).unwrap().data.len(), 676 * 507 * 3);
    // The COLMAP model in the folder belongs to another coordinate system and other images, and must not be used.
    assert!(scene.points.is_none());
    let (low, high) = scene.init_box.unwrap();
    assert!((0..3).all(|k| low[k] < high[k]), "{low:?} {high:?}");
    // Four cameras are few, but enough for points; they lie in front of the held-out camera.
    let cloud = photo_points(&scene, 10_000, Seed::root(0)).unwrap();
    let held_out = scene.camera(scene.split(Split::Test)[0]);
    let ahead = cloud.positions.iter().filter(|p| project(held_out, p.map(f64::from)).2 > 0.0).count();
    eprintln!("{} points, {ahead} ahead of the held-out camera", cloud.positions.len());
    assert!(cloud.positions.len() > 2000 && ahead * 100 > cloud.positions.len() * 95);
}
