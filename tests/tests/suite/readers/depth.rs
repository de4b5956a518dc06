//! Recorded depth: the files that a `transforms.json` names, and the surfaces of built-in captures.

use super::common::*;
use cc4dgs_core::{DepthImage, Limits, Scene, SceneOptions, Split};
use cc4dgs_train::data::assemble;
use cc4dgs_train::data::procedural::ProceduralScene;
use glam::DVec3;
use std::path::Path;

/// Steps of the depth at a pixel; blocks of 2x2 pixels are unknown.
fn steps(x: u32, y: u32) -> u16 {
    if (x / 2 + y / 2).is_multiple_of(3) { 0 } else { (1000 + 100 * x + 7 * y) as u16 }
}

/// Four images of 16x12 pixels, of which all but the last have a depth image of `width` x `height` pixels.
fn write(root: &Path, width: u32, height: u32) {
    write_nerfstudio(root, 4);
    (0..3).for_each(|i| write_depth(&root.join(format!("depth/{i:04}.png")), width, height, steps));
    change(root, |document| (0..3).for_each(|i: usize| document["frames"][i]["depth_file_path"] = format!("depth/{i:04}.png").into()));
}

/// Changes the `transforms.json` of a folder.
fn change(root: &Path, with: impl Fn(&mut serde_json::Value)) {
    let file = root.join("transforms.json");
    let mut document: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    with(&mut document);
    std::fs::write(file, document.to_string()).unwrap();
}

/// The view of the image with a number.
fn view(scene: &Scene, number: usize) -> usize {
    (0..scene.views.len()).find(|&v| scene.camera(v).name == format!("images/{number:04}.png")).unwrap()
}

/// The depth of the image with a number, in units of the dataset.
fn depth(scene: &Scene, number: usize) -> DepthImage {
    let mut depth = scene.depth(view(scene, number)).unwrap().unwrap().as_ref().clone();
    depth.values.iter_mut().for_each(|z| *z = (f64::from(*z) / scene.normalisation.scale) as f32);
    depth
}

fn near(found: f32, expected: f64) -> bool {
    (f64::from(found) - expected).abs() <= 1e-5 * expected
}

#[test]
fn steps_have_the_unit_of_the_file_and_0_is_unknown() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), 16, 12);
    for (factor, unit) in [(None, 0.001), (Some(0.25), 0.25)] {
        if let Some(factor) = factor {
            change(dir.path(), |document| document["depth_unit_scale_factor"] = serde_json::Value::from(factor));
        }
        let scene = load(dir.path()).unwrap();
        assert!(scene.has_depth().unwrap() && scene.depth(view(&scene, 3)).unwrap().is_none());
        let found = depth(&scene, 1);
        assert_eq!((found.width, found.height), (16, 12));
        for (i, z) in found.values.iter().enumerate() {
            assert!(near(*z, f64::from(steps(i as u32 % 16, i as u32 / 16)) * unit), "pixel {i}: {z}");
        }
    }
    for factor in [0.0f64, -0.001] {
        change(dir.path(), |document| document["depth_unit_scale_factor"] = factor.into());
        let scene = load(dir.path()).unwrap();
        let message = scene.depth(view(&scene, 1)).unwrap_err().to_string();
        assert!(message.contains("0001.png: a step of depth is") && message.contains(&format!("is {factor} units")), "{message}");
    }
}

#[test]
fn no_size_mixes_pixels() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), 16, 12);
    let options = SceneOptions { downscale: 2.0, ..Default::default() };
    let halved = depth(&open(dir.path(), &options, &Limits::default()).unwrap(), 0);
    assert_eq!((halved.width, halved.height), (8, 6));
    for (i, z) in halved.values.iter().enumerate() {
        let (x, y) = (2 * (i as u32 % 8), 2 * (i as u32 / 8));
        let block = [steps(x, y), steps(x + 1, y), steps(x, y + 1), steps(x + 1, y + 1)];
        assert!(block.iter().any(|step| near(*z, f64::from(*step) * 0.001)), "pixel {i}: {z} is none of {block:?}");
    }
    // Sensors of depth have fewer pixels than cameras.
    write(dir.path(), 8, 6);
    let small = depth(&load(dir.path()).unwrap(), 0);
    for (i, z) in small.values.iter().enumerate() {
        assert!(near(*z, f64::from(steps(i as u32 % 16 / 2, i as u32 / 16 / 2)) * 0.001), "pixel {i}: {z}");
    }
}

#[test]
fn what_is_no_depth_is_refused_where_it_is_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), 16, 12);
    let file = dir.path().join("depth/0001.png");
    let sound = std::fs::read(&file).unwrap();
    let refused = || {
        let scene = load(dir.path()).unwrap();
        let v = view(&scene, 1);
        assert!(scene.frame(v).is_ok(), "the image is there all the same");
        scene.depth(v).map(drop).map_err(|e| e.to_string())
    };
    write_depth(&file, 10, 12, steps);
    let message = refused().unwrap_err();
    assert!(message.contains("0001.png") && message.contains("10x12 pixels of depth for an image of 16x12"), "{message}");
    image::GrayImage::new(16, 12).save(&file).unwrap();
    let message = refused().unwrap_err();
    assert!(message.contains("0001.png") && message.contains("L8, not 16-bit grey"), "{message}");
    write_image(&file, 16, 12, 0);
    assert!(refused().unwrap_err().contains("Rgb8, not 16-bit grey"));
    for cut in (0..sound.len()).step_by(5) {
        std::fs::write(&file, &sound[..cut]).unwrap();
        if let Err(message) = refused() {
            assert!(message.contains("0001.png"), "cut at {cut}: {message}");
        }
        let flipped: Vec<u8> = sound.iter().enumerate().map(|(i, byte)| if i == cut { byte ^ 0x40 } else { *byte }).collect();
        std::fs::write(&file, flipped).unwrap();
        let _ = refused();
    }
    std::fs::write(&file, &sound).unwrap();
    assert_eq!(refused(), Ok(()));
    let message = cc4dgs_core::reader::files::read_depth(&file, 0.001, &Limits { max_pixels: 100, ..Limits::default() }).unwrap_err().to_string();
    assert!(message.contains("max_pixels"), "{message}");
    assert!(cc4dgs_core::reader::files::read_depth(&file, 1e300, &Limits::default()).is_err(), "no finite depth");
}

#[test]
fn depth_that_is_missing_is_told() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), 16, 12);
    let told = |scene: &Scene| scene.warnings.iter().any(|w| w.contains("images have a depth_file_path that names no file"));
    assert!(!told(&load(dir.path()).unwrap()));
    std::fs::remove_dir_all(dir.path().join("depth")).unwrap();
    let scene = load(dir.path()).unwrap();
    assert!(told(&scene) && !scene.has_depth().unwrap(), "{:?}", scene.warnings);
}

#[test]
fn depth_of_captures_is_that_of_their_surfaces() {
    // Largest relative difference, and the share of pixels that keep to it: through a lens, pixels show what is up to half a pixel beside them.
    for (name, largest, share) in [("handheld", 1e-4, 0.99), ("units", 1e-4, 0.99), ("lens", 0.05, 0.9)] {
        let truth = ProceduralScene::named(&format!("captures/{name}")).unwrap();
        let scene = assemble(truth.clone().into_raw(name.into()), &options(), None, &Limits::default()).unwrap();
        let v = scene.split(Split::Train)[0];
        let (found, camera) = (scene.depth(v).unwrap().unwrap(), dataset_camera(&scene, v));
        let tracer = truth.tracer(truth.time(scene.views[v].frame));
        let (origin, to_world) = (DVec3::from(camera.center_world()), camera.rotation_translation().0.transpose());
        let exact = |pixel: usize| {
            let (x, y) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
            let local = DVec3::new((f64::from(x) + 0.5 - camera.cx) / camera.fx, (f64::from(y) + 0.5 - camera.cy) / camera.fy, 1.0);
            let hit = tracer.hit(origin, (to_world * local).normalize());
            hit.map_or(0.0, |hit| project(&camera, hit.point.to_array()).2 * scene.normalisation.scale)
        };
        let agrees = |z: f64, exact: f64| (z - exact).abs() <= largest * exact;
        let agreeing = found.values.iter().enumerate().filter(|(pixel, z)| agrees(f64::from(**z), exact(*pixel))).count();
        assert!(found.values.iter().any(|z| *z > 0.5), "{name}");
        assert!(agreeing as f64 > share * found.values.len() as f64, "{name}: {agreeing} of {} pixels", found.values.len());
    }
}
