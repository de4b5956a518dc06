//! Scenes that list images with poses and times: cameras that stand still, cameras of different sizes, and what is said where a file leaves something open.

use super::common::*;
use cc4dgs_core::{Camera, Limits, SceneOptions, Split};
use cc4dgs_train::auto::{Arrangement, Facts};
use serde_json::{Value, json};
use std::path::Path;

/// Four instants of each of `cameras`, whose images are numbered from `first` on, as entries of a file in `root`.
fn frames(root: &Path, cameras: &[Camera], first: usize) -> Vec<Value> {
    let mut frames = Vec::new();
    for (c, camera) in (first..).zip(cameras) {
        for t in 0..4 {
            let name = format!("images/{c}_{t}.png");
            write_image(&root.join(&name), 16, 12, (10 * c + t) as u8);
            frames.push(json!({"file_path": name, "time": t as f64 / 3.0, "transform_matrix": opengl_camera_to_world(camera)}));
        }
    }
    frames
}

fn write(file: &Path, frames: &[Value]) {
    let document = json!({"fl_x": 20.0, "w": 16, "h": 12, "frames": frames});
    std::fs::write(file, document.to_string()).unwrap();
}

#[test]
fn images_of_a_camera_that_stands_still_are_its_frames() {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("transforms.json"), &frames(dir.path(), &ring(9, 16, 12), 0));
    let scene = load(dir.path()).unwrap();
    assert_eq!((scene.cameras.len(), scene.frame_count, (scene.split(Split::Train).len(), scene.split(Split::Test).len())), (9, 4, (28, 8)));
    for (view, v) in scene.views.iter().enumerate() {
        assert_eq!(scene.frame(view).unwrap().data[2], (10 * v.camera + v.frame) as u8);
        assert_eq!(v.split == Split::Test, v.camera % 8 == 0, "whole cameras are held out");
    }
}

#[test]
fn a_rig_in_split_files_is_one_camera_for_each_pose() {
    let dir = tempfile::tempdir().unwrap();
    let (cameras, file) = (ring(6, 16, 12), |name: &str| dir.path().join(format!("transforms_{name}.json")));
    let mut train = frames(dir.path(), &cameras[..5], 0);
    write(&file("train"), &train);
    write(&file("test"), &frames(dir.path(), &cameras[5..], 5));
    let counts = |scene: &cc4dgs_core::Scene| (scene.cameras.len(), scene.frame_count, scene.split(Split::Train).len(), scene.split(Split::Test).len());
    let scene = load(dir.path()).unwrap();
    assert_eq!((counts(&scene), scene.warnings.len()), ((6, 4, 20, 4), 0), "{:?}", scene.warnings);
    for (view, v) in scene.views.iter().enumerate() {
        assert_eq!(scene.frame(view).unwrap().data[2], (10 * v.camera + v.frame) as u8);
        same_pose(&dataset_camera(&scene, view), &cameras[v.camera]);
    }
    // The same poses on both sides of the split stay apart.
    write(&file("test"), &train[..4]);
    assert_eq!(counts(&load(dir.path()).unwrap()), (6, 4, 20, 4));
    // What keeps the images of a rig apart is said.
    train[3]["time"] = train[2]["time"].clone();
    train[4].as_object_mut().unwrap().remove("time");
    write(&file("train"), &train);
    let scene = load(dir.path()).unwrap();
    assert_eq!(scene.cameras.len(), 24);
    let said = |part: &str| scene.warnings.iter().any(|w| w.contains(part));
    assert!(said("24 images have 6 poses, but 1 of them states no time and 1 the same time as another image of its pose"), "{:?}", scene.warnings);
}

#[test]
fn cameras_whose_clocks_jitter_are_a_rig() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("transforms.json");
    let mut images = frames(dir.path(), &ring(9, 16, 12), 0);
    // Up to a fifth of the interval late; then each camera a ninth of it after the one before.
    let mut delayed = |share: &dyn Fn(usize) -> f64| {
        for (index, image) in images.iter_mut().enumerate() {
            let (camera, instant) = (index / 4, index % 4);
            image["time"] = json!((instant as f64 + share(camera + 3 * instant)) / 4.0);
        }
        write(&file, &images);
        load(dir.path()).unwrap()
    };
    let scene = delayed(&|number| 0.05 * (number % 5) as f64);
    assert_eq!((scene.cameras.len(), scene.frame_count, scene.views.len()), (9, 4, 36));
    assert_eq!(Facts::of(&scene).unwrap().arrangement, Arrangement::Dome);
    let mut times: Vec<u32> = scene.views.iter().map(|view| view.time_norm.to_bits()).collect();
    times.sort_unstable();
    times.dedup();
    assert!(times.len() > 16, "each image keeps its own time: {times:?}");
    assert!(scene.warnings.iter().any(|w| w.contains("36 images are 4 frames, each image at its own time")), "{:?}", scene.warnings);
    let options = SceneOptions { frames: Some([1, 2, 1]), ..options() };
    assert_eq!(open(dir.path(), &options, &Limits::default()).unwrap().views.len(), 18);
    let scene = delayed(&|number| (number % 9) as f64 / 9.0);
    assert_eq!((scene.cameras.len(), scene.views.len()), (9, 36));
    assert!(scene.frame_count > 30 && !Facts::of(&scene).unwrap().arrangement.has_several_cameras(), "{} frames", scene.frame_count);
}

#[test]
fn moving_cameras_keep_an_entry_and_a_name_for_each_image() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 5, 4, 16);
    // Test images of one pose do not make a rig of it.
    let file = dir.path().join("transforms_test.json");
    let mut document: Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    (1..4).for_each(|i| document["frames"][i]["transform_matrix"] = document["frames"][0]["transform_matrix"].clone());
    std::fs::write(&file, document.to_string()).unwrap();
    let scene = load(dir.path()).unwrap();
    let mut names: Vec<&str> = scene.cameras.iter().map(|c| c.name.as_str()).collect();
    names.sort_unstable();
    let all = ["test/r_000", "test/r_001", "test/r_002", "test/r_003", "train/r_000", "train/r_001", "train/r_002", "train/r_003", "train/r_004"];
    assert_eq!((names.as_slice(), scene.warnings.len()), (&all[..], 0), "{:?}", scene.warnings);
}

#[test]
fn images_without_any_time_are_told() {
    let dir = tempfile::tempdir().unwrap();
    write_nerfstudio(dir.path(), 4);
    let scene = load(dir.path()).unwrap();
    assert!(scene.warnings.iter().any(|w| w.contains("none of the 4 images states a time, so nothing moves")), "{:?}", scene.warnings);
}

#[test]
fn images_of_different_sizes_keep_their_lens_and_are_not_enlarged() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 3, 1, 16);
    write_rgba_image(&dir.path().join("train/r_001.png"), 8, 6, [10, 20, 30, 255]);
    let native = load(dir.path()).unwrap();
    let sizes = |options: &SceneOptions| {
        let scene = open(dir.path(), options, &Limits::default()).unwrap();
        let size = |view: usize| {
            let (camera, image) = (scene.camera(view), scene.frame(view).unwrap());
            assert_eq!((camera.width, camera.height), (image.width, image.height));
            // The angles that an image spans do not depend on its size.
            let whole = native.cameras.iter().find(|c| c.name == camera.name).unwrap();
            let [sx, sy] = [f64::from(camera.width) / f64::from(whole.width), f64::from(camera.height) / f64::from(whole.height)];
            let scaled = [whole.fx * sx, whole.fy * sy, whole.cx * sx, whole.cy * sy];
            let found = [camera.fx, camera.fy, camera.cx, camera.cy];
            assert!(found.iter().zip(scaled).all(|(a, b)| (a - b).abs() < 1e-9), "{}: {found:?}, not {scaled:?}", camera.name);
            (camera.width, camera.height)
        };
        (scene.split(Split::Train).into_iter().map(size).collect::<Vec<_>>(), scene.warnings.join("\n"))
    };
    let small = native.cameras.iter().find(|c| c.name == "train/r_001").unwrap();
    assert!((small.fx - 4.0 / 0.4f64.tan()).abs() < 1e-9 && (small.cx, small.cy) == (4.0, 3.0), "{small:?}");
    assert_eq!(sizes(&SceneOptions::default()), (vec![(16, 16), (8, 6), (16, 16)], String::new()));
    assert_eq!(sizes(&SceneOptions { downscale: 2.0, ..options() }), (vec![(8, 8), (4, 3), (8, 8)], String::new()));
    let said = |options: SceneOptions, expected: [(u32, u32); 3], parts: &[&str]| {
        let (found, said) = sizes(&options);
        assert_eq!(found, expected);
        assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    };
    let one = ["1 of 4 cameras are smaller", "8x6, where 12x9 is asked for"];
    said(SceneOptions { width: 12, ..options() }, [(12, 12), (8, 6), (12, 12)], &one);
    said(SceneOptions { width: 12, height: 5, ..options() }, [(12, 5), (8, 5), (12, 5)], &["8x6, where 12x5 is asked for"]);
    for larger in [SceneOptions { width: 32, ..options() }, SceneOptions { height: 32, ..options() }, SceneOptions { downscale: 0.5, ..options() }] {
        said(larger, [(16, 16), (8, 6), (16, 16)], &["4 of 4 cameras are smaller", "16x16, where 32x32 is asked for"]);
    }
}

#[test]
fn photos_that_lie_on_their_side_are_told() {
    let dir = tempfile::tempdir().unwrap();
    write_nerfstudio(dir.path(), 4);
    let message = |width, height| {
        write_image(&dir.path().join("images/0001.png"), width, height, 0);
        load(dir.path()).err().unwrap().to_string()
    };
    assert!(message(12, 16).contains("EXIF") && message(24, 32).contains("mogrify -auto-orient"));
    assert!(!message(16, 16).contains("EXIF"));
}
