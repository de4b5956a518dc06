//! The options that all readers share: frames, held-out cameras, sizes, images that are missing or have a wrong size.

use super::common::*;
use cc4dgs_core::reader::files::read_png_or_jpeg;
use cc4dgs_core::{Background, CameraRef, Error, Limits, Registry, SceneOptions, Split};
use cc4dgs_train::data::{Trained, open_in};
use std::path::Path;

#[test]
fn frames_are_chosen_and_renumbered() {
    let dir = tempfile::tempdir().unwrap();
    write_panoptic(dir.path(), 4, 9);
    let options = SceneOptions { frames: Some([1, 3, 2]), ..Default::default() };
    let scene = open(dir.path(), &options, &Limits::default()).unwrap();
    assert_eq!(scene.frame_count, 3);
    for (view, v) in scene.views.iter().enumerate() {
        let c: usize = scene.camera(view).name.parse().unwrap();
        assert_eq!(scene.frame(view).unwrap().data[2] as usize, 10 * c + 1 + 2 * v.frame);
        assert!((v.time_norm - v.frame as f32 / 2.0).abs() < 1e-6);
    }
    // Times that are stated begin at 0 and end at 1, too.
    let stated = tempfile::tempdir().unwrap();
    write_dnerf(stated.path(), 5, 1, 16);
    let scene = open(stated.path(), &SceneOptions { frames: Some([1, 3, 1]), ..Default::default() }, &Limits::default()).unwrap();
    let mut times: Vec<f32> = scene.views.iter().map(|v| v.time_norm).collect();
    times.dedup();
    assert_eq!(times, [0.0, 0.5, 1.0]);
    let none = SceneOptions { frames: Some([50, 3, 1]), ..Default::default() };
    let message = open(dir.path(), &none, &Limits::default()).err().unwrap().to_string();
    assert!(message.contains("9 frames"), "{message}");
    let many = SceneOptions { frames: Some([7, usize::MAX, usize::MAX]), ..Default::default() };
    assert_eq!(open(dir.path(), &many, &Limits::default()).unwrap().frame_count, 1);
}

#[test]
fn held_out_cameras_and_caps() {
    let dir = tempfile::tempdir().unwrap();
    write_panoptic(dir.path(), 4, 2);
    let options = SceneOptions { test_cameras: Some(vec![CameraRef::Index(0), CameraRef::Name("2".into())]), max_views: 3, ..Default::default() };
    let scene = open(dir.path(), &options, &Limits::default()).unwrap();
    let test: Vec<&str> = scene.split(Split::Test).iter().map(|&v| scene.camera(v).name.as_str()).collect();
    assert_eq!(test, ["0", "2", "0", "2"]);
    let train = scene.split(Split::Train);
    assert_eq!((train.len(), scene.views[train[0]].frame), (3, 0), "the first view stays");
    let wrong = SceneOptions { test_cameras: Some(vec![CameraRef::Name("cam7".into())]), ..Default::default() };
    assert!(open(dir.path(), &wrong, &Limits::default()).err().unwrap().to_string().contains("cam7"));
    let all = SceneOptions { test_cameras: Some((0..5).map(CameraRef::Index).collect()), ..Default::default() };
    assert!(open(dir.path(), &all, &Limits::default()).err().unwrap().to_string().contains("no training image"));
}

#[test]
fn sizes_follow_the_options() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 2, 1, 16);
    let options = SceneOptions { width: 8, background: Some(Background::Name("black".into())), ..Default::default() };
    let scene = open(dir.path(), &options, &Limits::default()).unwrap();
    let (camera, image) = (scene.camera(0), scene.frame(0).unwrap());
    assert_eq!((camera.width, camera.height, image.width, image.height), (8, 8, 8, 8));
    let native = load(dir.path()).unwrap();
    assert!((camera.fx * 2.0 - native.camera(0).fx).abs() < 1e-9 && camera.cx == 4.0);
    assert_eq!(scene.background, Some([0.0; 3]));
    let small = Limits { max_pixels: 100, ..Default::default() };
    assert_eq!(open(dir.path(), &options, &small).err().unwrap().exit_code(), 4, "16x16 is over 100 pixels");
}

#[test]
fn technicolor_cameras_follow_the_size_of_the_images() {
    let dir = tempfile::tempdir().unwrap();
    let focal = 64.0 * write_technicolor(dir.path(), 3, &[100])[0].fx;
    let sized = |width: u32, height: u32| {
        (0..3).for_each(|c| write_image(&dir.path().join(format!("Painter_undist_00100_{c:02}.png")), width, height, c));
        load(dir.path())
    };
    // Sides of smaller copies are rounded to whole pixels.
    for (width, height, is_scaled) in [(2048, 1088, false), (100, 53, true)] {
        let scene = sized(width, height).unwrap();
        let [sx, sy] = [f64::from(width) / 2048.0, f64::from(height) / 1088.0];
        for camera in &scene.cameras {
            let found = [camera.fx, camera.fy, camera.cx, camera.cy];
            let expected = [focal * sx, focal * sy, 1088.0 * sx, 480.0 * sy];
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}, not {expected:?}");
        }
        let said = scene.warnings.join("\n");
        assert_eq!(said.contains(&format!("the images are {width}x{height}, the calibration is for 2048x1088")), is_scaled, "{said}");
    }
    let message = sized(32, 24).err().unwrap().to_string();
    assert!(message.contains("calibrated for 2048x1088 pixels, its image has 32x24"), "{message}");
    // The calibration of another rig, by its principal points.
    let file = dir.path().join("cameras_parameters.txt");
    std::fs::write(&file, std::fs::read_to_string(&file).unwrap().replace(" 1088 480 ", " 17 11.5 ")).unwrap();
    let scene = sized(32, 24).unwrap();
    assert!(scene.cameras.iter().all(|camera| (camera.fx, camera.cx, camera.cy) == (focal, 17.0, 11.5)), "{:?}", scene.cameras);
    assert!(!scene.warnings.join("\n").contains("calibration"), "{:?}", scene.warnings);
}

#[test]
fn other_frames_keep_the_clock_of_a_training() {
    let dir = tempfile::tempdir().unwrap();
    write_panoptic(dir.path(), 2, 9);
    let stated = tempfile::tempdir().unwrap();
    write_dnerf(stated.path(), 9, 1, 16);
    let registry = Registry::collect().unwrap();
    for path in [dir.path(), stated.path()] {
        let normalisation = open(path, &SceneOptions::default(), &Limits::default()).unwrap().normalisation;
        let times = |trained: Option<[usize; 3]>, wanted: Option<[usize; 3]>| {
            let options = SceneOptions { frames: wanted, ..Default::default() };
            let scene = open_in(path, &options, &Trained { normalisation, frames: trained }, &registry, &Limits::default())?;
            let mut times: Vec<f32> = scene.split(Split::Train).into_iter().map(|view| scene.views[view].time_norm).collect();
            times.dedup();
            Ok::<_, Error>(times)
        };
        assert_eq!(times(None, Some([0, 3, 1])).unwrap(), [0.0, 0.125, 0.25]);
        assert_eq!(times(None, Some([4, 2, 4])).unwrap(), [0.5, 1.0]);
        assert_eq!(times(Some([2, 5, 1]), Some([3, 2, 1])).unwrap(), [0.25, 0.5]);
        assert_eq!(times(Some([2, 5, 1]), Some([2, 5, 1])).unwrap(), [0.0, 0.25, 0.5, 0.75, 1.0]);
        let beyond = times(Some([2, 5, 1]), None).unwrap_err();
        assert!(beyond.exit_code() == 2 && beyond.to_string().contains("scene.frames"), "{beyond}");
        let damaged = times(Some([0, 5, 0]), Some([0, 3, 1])).unwrap_err();
        assert!(damaged.exit_code() == 3 && damaged.to_string().contains("[0, 5, 0]"), "{damaged}");
    }
    // The frames of a built-in scene are samples of all of its time, whatever their number.
    let (path, options) = (Path::new("procedural:tiny"), SceneOptions { frames: Some([0, 5, 1]), ..Default::default() });
    let trained = Trained { normalisation: open(path, &options, &Limits::default()).unwrap().normalisation, frames: Some([0, 3, 1]) };
    let scene = open_in(path, &options, &trained, &registry, &Limits::default()).unwrap();
    let last = scene.views.iter().map(|view| view.time_norm).fold(0.0, f32::max);
    assert_eq!((scene.frame_count, last), (5, 1.0));
}

#[test]
fn cameras_of_different_rates_are_matched_by_their_numbers() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[2, 17], &llff_rows(&ring(2, 16, 12)))).unwrap();
    (0..9).for_each(|t| write_image(&dir.path().join(format!("cam0/{t:04}.png")), 16, 12, t as u8));
    (0..9).step_by(2).for_each(|t| write_image(&dir.path().join(format!("cam1/{t:04}.png")), 16, 12, t as u8));
    let scene = open(dir.path(), &SceneOptions { test_cameras: Some(Vec::new()), ..Default::default() }, &Limits::default()).unwrap();
    assert_eq!((scene.frame_count, scene.views.len()), (9, 14));
    for (view, v) in scene.views.iter().enumerate() {
        assert_eq!(usize::from(scene.frame(view).unwrap().data[2]), v.frame);
    }
    assert!(scene.warnings.iter().any(|w| w.contains("cam1") && w.contains("4 of 9 frames")), "{:?}", scene.warnings);
}

#[test]
fn missing_images_are_skipped_and_named() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 4, 1, 8);
    std::fs::remove_file(dir.path().join("train/r_002.png")).unwrap();
    let scene = load(dir.path()).unwrap();
    assert_eq!(scene.split(Split::Train).len(), 3);
    assert!(scene.warnings.iter().any(|w| w.contains("r_002.png")), "{:?}", scene.warnings);
    std::fs::remove_dir_all(dir.path().join("train")).unwrap();
    assert!(load(dir.path()).err().unwrap().to_string().contains("none of its 4 images"));
}

#[test]
fn misfit_and_broken_images_are_errors_that_name_them() {
    let dir = tempfile::tempdir().unwrap();
    write_panoptic(dir.path(), 2, 2);
    write_image(&dir.path().join("ims/0/000001.png"), 10, 10, 0);
    let scene = load(dir.path()).unwrap();
    let view = (0..scene.views.len()).find(|&v| scene.camera(v).name == "0" && scene.views[v].frame == 1).unwrap();
    let message = scene.frame(view).err().unwrap().to_string();
    assert!(message.contains("000001.png") && message.contains("10x10") && message.contains("16x12"), "{message}");

    let jpeg = dir.path().join("a.jpg");
    image::RgbImage::from_fn(64, 64, |x, y| image::Rgb([(x * y) as u8, x as u8, y as u8])).save(&jpeg).unwrap();
    let bytes = std::fs::read(&jpeg).unwrap();
    let read = |bytes: &[u8]| {
        std::fs::write(&jpeg, bytes).unwrap();
        read_png_or_jpeg(&jpeg, &Limits::default())
    };
    assert!(read(&bytes).is_ok());
    for keep in [0, 1, 3, bytes.len() / 2, bytes.len() - 3] {
        assert!(read(&bytes[..keep]).is_err(), "a JPEG truncated to {keep} of {} bytes", bytes.len());
    }
    // A PNG header that states a gigantic image.
    let png = dir.path().join("ims/0/000000.png");
    let mut bytes = std::fs::read(&png).unwrap();
    bytes[16..24].copy_from_slice(&[0x7f, 0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff]);
    std::fs::write(&png, bytes).unwrap();
    assert!(load(dir.path()).is_err());
}
