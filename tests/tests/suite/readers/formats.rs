//! Every format but COLMAP on a tiny scene: poses are reproduced, splits and times follow the convention of the dataset.

use super::common::*;
use cc4dgs_core::{Limits, Registry, SceneOptions, Split};

#[test]
fn dnerf() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = write_dnerf(dir.path(), 5, 2, 16);
    let scene = load(dir.path()).unwrap();
    assert_eq!(train_count(&scene), (5, 2));
    assert_eq!(scene.frame_count, 5, "distinct times");
    // The cube of D-NeRF's scenes, whose cameras are 4.03 away.
    let (low, high) = scene.init_box.unwrap();
    assert!((0..3).all(|k| low[k] == -high[k] && (high[k] - 1.29).abs() < 1e-3), "{low:?} {high:?}");
    assert_eq!(scene.background, Some([1.0; 3]));
    for (i, truth) in cameras.iter().enumerate().take(5) {
        let view = scene.views.iter().position(|v| scene.cameras[v.camera].name == format!("train/r_{i:03}")).unwrap();
        same_pose(&dataset_camera(&scene, view), truth);
        assert!((scene.camera(view).fx - truth.fx).abs() < 1e-9);
        assert!((f64::from(scene.views[view].time_norm) - i as f64 / 4.0).abs() < 1e-6);
        assert_eq!(scene.frame(view).unwrap().data[..4], [10, 20, 30, 255]);
    }
}

#[test]
fn dnerf_has_validation_views_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 5, 2, 16);
    let without = load(dir.path()).unwrap();
    let document = std::fs::read_to_string(dir.path().join("transforms_test.json")).unwrap();
    std::fs::write(dir.path().join("transforms_val.json"), document.replace("./test/", "./val/")).unwrap();
    let told = |scene: &cc4dgs_core::Scene| scene.warnings.join("\n").contains("there are no validation views");
    assert!(told(&load(dir.path()).unwrap()), "copies without these images are read");
    std::fs::create_dir(dir.path().join("val")).unwrap();
    for name in ["r_000.png", "r_001.png"] {
        std::fs::copy(dir.path().join("test").join(name), dir.path().join("val").join(name)).unwrap();
    }
    let scene = load(dir.path()).unwrap();
    assert!(!told(&scene));
    assert_eq!((train_count(&scene), scene.split(Split::Validation).len()), ((5, 2), 2));
    let others: Vec<_> = scene.views.iter().filter(|view| view.split != Split::Validation).cloned().collect();
    assert_eq!((others, scene.frame_count), (without.views, without.frame_count), "as without them");
    // They are taken in place of training views.
    assert_eq!(train_count(&cc4dgs_train::data::hold_out(&scene, 1).unwrap()), (5, 2));
    let held_out = open(dir.path(), &SceneOptions { test_split: "val".into(), ..Default::default() }, &Limits::default()).unwrap();
    assert_eq!((train_count(&held_out), held_out.split(Split::Validation).len()), ((5, 2), 0));
}

#[test]
fn panoptic() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = write_panoptic(dir.path(), 4, 3);
    let scene = load(dir.path()).unwrap();
    assert_eq!(train_count(&scene), (12, 3));
    assert_eq!((scene.cameras.len(), scene.frame_count), (5, 3), "a camera that stands is one camera");
    for (view, v) in scene.views.iter().enumerate() {
        let c: usize = scene.camera(view).name.parse().unwrap();
        same_pose(&dataset_camera(&scene, view), &cameras[c]);
        assert_eq!(scene.frame(view).unwrap().data[2], (10 * c + v.frame) as u8, "each view shows its own image");
        assert!((v.time_norm - v.frame as f32 / 2.0).abs() < 1e-6, "1 at the last frame");
    }
    let (low, high) = scene.init_box.unwrap();
    assert!((0..3).all(|k| low[k] < -2.0 && high[k] > 2.0), "{low:?} {high:?}");
    assert!(scene.foreground_masks.is_none());
}

#[test]
fn panoptic_masks_are_found() {
    let dir = tempfile::tempdir().unwrap();
    write_panoptic(dir.path(), 4, 2);
    let mask = image::GrayImage::from_fn(16, 12, |x, _| image::Luma([if x < 8 { 255 } else { 0 }]));
    std::fs::create_dir_all(dir.path().join("seg/1")).unwrap();
    mask.save(dir.path().join("seg/1/000001.png")).unwrap();
    let scene = load(dir.path()).unwrap();
    let masks = scene.foreground_masks.clone().unwrap();
    let at = |camera: &str, frame: usize| (0..scene.views.len()).find(|&v| scene.camera(v).name == camera && scene.views[v].frame == frame).unwrap();
    let found = masks.load(at("1", 1)).unwrap();
    assert_eq!((found.data[0], found.data[15 * 3]), (255, 0));
    assert!(masks.load(at("1", 0)).is_err(), "a view without a mask says so");
}

#[test]
fn llff_with_frame_folders() {
    let dir = tempfile::tempdir().unwrap();
    // Calibrated at twice the size of the frames, as N3DV is used.
    let cameras = ring(3, 32, 24);
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[3, 17], &llff_rows(&cameras))).unwrap();
    for c in 0..3 {
        for t in 0..4 {
            write_image(&dir.path().join(format!("cam{c:02}/images/{t:04}.png")), 16, 12, (10 * c + t) as u8);
        }
    }
    let scene = load(dir.path()).unwrap();
    assert_eq!(train_count(&scene), (8, 4));
    for (view, v) in scene.views.iter().enumerate() {
        let camera = scene.camera(view);
        same_pose(&dataset_camera(&scene, view), &cameras[v.camera]);
        assert_eq!((camera.width, camera.fx, camera.cx), (16, cameras[0].fx / 2.0, 8.0));
        assert_eq!(v.split, if camera.name == "cam00" { Split::Test } else { Split::Train });
        assert!((v.time_norm - v.frame as f32 / 3.0).abs() < 1e-6);
        assert_eq!(scene.frame(view).unwrap().data[2], (10 * v.camera + v.frame) as u8);
    }
}

#[test]
fn frames_are_numbered_by_their_names() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[3, 17], &llff_rows(&ring(3, 16, 12)))).unwrap();
    // Not padded, so that text order is 1, 10, 11, 2; one frame of one camera is lost.
    for c in 0..3 {
        for t in (1..=11).filter(|t| (c, *t) != (1, 4)) {
            write_image(&dir.path().join(format!("cam{c}/frame_{t}.png")), 16, 12, (20 * c + t) as u8);
        }
    }
    let scene = load(dir.path()).unwrap();
    assert_eq!((scene.frame_count, train_count(&scene)), (11, (21, 11)));
    for (view, v) in scene.views.iter().enumerate() {
        assert_eq!(scene.frame(view).unwrap().data[2], (20 * v.camera + v.frame + 1) as u8);
    }
    assert!(scene.warnings.iter().any(|w| w.contains("cam1") && w.contains("1 of 11 frames")), "{:?}", scene.warnings);
}

#[test]
fn frames_that_begin_with_different_numbers_are_told() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[2, 17], &llff_rows(&ring(2, 16, 12)))).unwrap();
    for (c, t) in (0..6).map(|i| (i / 3, i % 3)) {
        write_image(&dir.path().join(format!("cam{c}/{:04}.png", c + t)), 16, 12, 0);
    }
    std::fs::write(dir.path().join("cam0/._0000.png"), "of macOS, no image").unwrap();
    let scene = load(dir.path()).unwrap();
    assert!(scene.warnings.iter().any(|w| w.contains("cam0 begin with number 0, those of cam1 with 1")), "{:?}", scene.warnings);
}

#[test]
fn a_model_beside_the_poses_that_cannot_be_read_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    write_llff(dir.path());
    std::fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
    for name in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::write(dir.path().join("sparse/0").join(name), [9; 40]).unwrap();
    }
    let scene = load(dir.path()).unwrap();
    assert!(scene.points.is_none() && scene.warnings.iter().any(|w| w.contains("COLMAP")), "{:?}", scene.warnings);
}

#[test]
fn llff_refuses_a_camera_too_many() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[2, 17], &llff_rows(&ring(2, 16, 12)))).unwrap();
    (0..3).for_each(|c| write_image(&dir.path().join(format!("images/{c}.png")), 16, 12, 0));
    let message = load(dir.path()).err().unwrap().to_string();
    assert!(message.contains("2 rows") && message.contains("3 cameras"), "{message}");
}

/// A fake ffmpeg for the two calls of the reader; it copies frames prepared by the test.
#[cfg(unix)]
#[test]
fn llff_with_videos() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let tools = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[2, 17], &llff_rows(&ring(2, 16, 12)))).unwrap();
    for c in 0..2u8 {
        std::fs::write(dir.path().join(format!("cam{c:02}.mp4")), "not a video").unwrap();
        (0..6u8).for_each(|t| write_image(&tools.path().join(format!("cam{c:02}/{t}.png")), 16, 12, 10 * c + t));
    }
    let script = |name: &str, text: String| {
        let path = tools.path().join(name);
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        path.to_string_lossy().into_owned()
    };
    let packets: Vec<String> = (0..6).map(|t| format!("{{\"pts_time\": \"{}.0\", \"flags\": \"K_\"}}", t)).collect();
    let facts = format!(
        "{{\"packets\": [{}], \"streams\": [{{\"width\": 16, \"height\": 12, \"field_order\": \"ORDER\", \"color_transfer\": \"smpte2084\"}}]}}",
        packets.join(",")
    );
    // The second camera is interlaced.
    script("ffprobe", format!("#!/bin/sh\ncase \"$*\" in *cam01*) order=tt;; *) order=progressive;; esac\necho '{facts}' | sed \"s/ORDER/$order/\"\n"));
    // The last argument is the pattern; the frames the filter selects are 1, 3, 5.
    let log = tools.path().join("log");
    let body = "for last; do :; done\nout=$(dirname \"$last\")\ncam=$(echo \"$*\" | grep -o 'cam0[0-9]' | head -1)\n";
    let copy = "i=1\nfor t in 1 3 5; do cp TOOLS/$cam/$t.png $out/$(printf %06d $i).png; i=$((i+1)); done\n".replace("TOOLS", &tools.path().to_string_lossy());
    let times = "for t in 0 1 2 3 4 5; do echo \"frame:$t pts:${t}000000 pts_time:$t\"; done\n";
    let ffmpeg = script("ffmpeg", format!("#!/bin/sh\necho \"$*\" >> {}\n{body}{copy}{times}", log.display()));
    let options = SceneOptions { ffmpeg, frames: Some([1, 3, 2]), video_cache: Some(tools.path().join("cache")), ..Default::default() };
    let scene = open(dir.path(), &options, &Limits::default()).unwrap();
    assert_eq!(scene.frame_count, 3);
    let combed: Vec<&String> = scene.warnings.iter().filter(|w| w.contains("interlaced")).collect();
    let parts = ["1 of 2 videos", "(cam01.mp4)", "ffmpeg -i cam01.mp4 -vf yadif", "OTHER_FOLDER/cam01.mp4"];
    assert!(combed.len() == 1 && parts.iter().all(|part| combed[0].contains(part)), "{:?}", scene.warnings);
    let high: Vec<&String> = scene.warnings.iter().filter(|w| w.contains("high dynamic range")).collect();
    let parts = ["2 of 2 videos", "(cam00.mp4 and others)", "r=tv,format=yuv420p", "OTHER_FOLDER/cam00.mp4"];
    assert!(high.len() == 1 && parts.iter().all(|part| high[0].contains(part)), "{:?}", scene.warnings);
    assert!(!log.exists(), "nothing is decoded before a frame is wanted");
    for (view, v) in scene.views.iter().enumerate() {
        assert_eq!(scene.frame(view).unwrap().data[2] as usize, 10 * v.camera + 1 + 2 * v.frame);
    }
    let calls = std::fs::read_to_string(&log).unwrap();
    assert_eq!(calls.lines().count(), 2, "each video is decoded once: {calls}");
    assert!(calls.contains("between(n,1,5)*not(mod(n-1,2))") && calls.contains("scale=16:12"), "{calls}");
    // A second scene reads the frames from the cache.
    let again = open(dir.path(), &options, &Limits::default()).unwrap();
    again.frame(0).unwrap();
    assert_eq!(std::fs::read_to_string(&log).unwrap().lines().count(), 2);
}

#[test]
fn videos_without_ffmpeg_say_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("poses_bounds.npy"), npy(&[1, 17], &llff_rows(&ring(1, 16, 12)))).unwrap();
    std::fs::write(dir.path().join("cam00.mp4"), "x").unwrap();
    let options = SceneOptions { ffmpeg: "/nonexistent/ffmpeg".into(), ..Default::default() };
    let message = open(dir.path(), &options, &Limits::default()).err().unwrap().to_string();
    let parts = ["/nonexistent/ffprobe", "Install ffmpeg", "beside poses_bounds.npy", "transforms.json"];
    assert!(parts.iter().all(|part| message.contains(part)), "{message}");
}

#[test]
fn technicolor() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = write_technicolor(dir.path(), 12, &[99, 100, 101, 149, 150]);
    let scene = load(dir.path()).unwrap();
    // Frames 99 and 150 lie outside the 50 of Painter.
    assert_eq!((scene.frame_count, train_count(&scene)), (3, (33, 3)));
    for (view, v) in scene.views.iter().enumerate() {
        let camera = scene.camera(view);
        same_pose(&dataset_camera(&scene, view), &cameras[v.camera]);
        assert_eq!((camera.cx, camera.cy), (17.0, 7.5), "the principal point is honoured");
        assert_eq!((camera.fx, camera.fy), (cameras[v.camera].fx, cameras[v.camera].fx));
        assert_eq!(v.split == Split::Test, camera.name == "cam10");
        assert_eq!(scene.frame(view).unwrap().data[2] as usize, v.camera);
    }
}

#[test]
fn nerfstudio_with_shared_and_own_intrinsics_and_gaps() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = ring(10, 32, 24);
    let frames: Vec<_> = cameras
        .iter()
        .enumerate()
        .map(|(i, c)| {
            if i != 4 {
                write_image(&dir.path().join(format!("images/{i:04}.jpg")), 32, 24, 0);
            }
            let mut frame = serde_json::json!({"file_path": format!("images/{i:04}.jpg"), "transform_matrix": opengl_camera_to_world(c)});
            if i == 5 {
                frame["fl_x"] = 55.0.into();
            }
            frame
        })
        .collect();
    let document = serde_json::json!({"fl_x": 50.0, "fl_y": 51.0, "cx": 16.5, "cy": 12.0, "w": 32.0, "h": 24.0, "aabb_scale": 4, "frames": frames});
    std::fs::write(dir.path().join("transforms.json"), document.to_string()).unwrap();
    let scene = load(dir.path()).unwrap();
    assert_eq!(train_count(&scene), (7, 2));
    assert!(scene.warnings.iter().any(|w| w.contains("1 of 10") && w.contains("images/0004.jpg")), "{:?}", scene.warnings);
    let camera = |name: &str| scene.cameras.iter().find(|c| c.name == name).unwrap();
    same_pose(&scene.normalisation.inverse().apply_camera(camera("images/0005.jpg")), &cameras[5]);
    assert_eq!((camera("images/0005.jpg").fx, camera("images/0006.jpg").fx, camera("images/0006.jpg").fy), (55.0, 50.0, 51.0));
}

#[test]
fn a_lens_beside_the_angle_of_view_counts_in_split_files_too() {
    let dir = tempfile::tempdir().unwrap();
    write_dnerf(dir.path(), 3, 1, 16);
    let file = dir.path().join("transforms_train.json");
    let mut document: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    for (key, value) in [("fl_x", 21.0), ("fl_y", 22.0), ("cx", 7.0), ("cy", 9.0)] {
        document[key] = value.into();
    }
    std::fs::write(&file, document.to_string()).unwrap();
    let scene = load(dir.path()).unwrap();
    let of = |split: Split| scene.camera(scene.split(split)[0]);
    let (train, test) = (of(Split::Train), of(Split::Test));
    assert_eq!((train.fx, train.fy, train.cx, train.cy), (21.0, 22.0, 7.0, 9.0));
    assert!((test.fx - 8.0 / 0.4f64.tan()).abs() < 1e-9 && test.cx == 8.0);
}

/// Changes a JSON file.
fn change(file: &std::path::Path, with: impl Fn(&mut serde_json::Value)) {
    let mut document: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    with(&mut document);
    std::fs::write(file, document.to_string()).unwrap();
}

#[test]
fn a_list_of_distortion_parameters_is_read_or_refused() {
    let opened = |key: &str, value: serde_json::Value| {
        let dir = tempfile::tempdir().unwrap();
        write_nerfstudio(dir.path(), 4);
        change(&dir.path().join("transforms.json"), |document| document[key] = value.clone());
        load(dir.path()).map(|scene| (scene.camera(0).width, scene.camera(0).height, scene.camera(0).cx))
    };
    let named = opened("k1", 0.3.into()).unwrap();
    assert!(named.0 < 16, "{named:?}");
    assert_eq!(opened("distortion_params", serde_json::json!([0.3, 0, 0, 0, 0, 0])).unwrap(), named);
    let message = opened("distortion_params", serde_json::json!([0.3, 0, 0, 0])).unwrap_err().to_string();
    assert!(message.contains("images/0000.png") && message.contains("distortion_params has 4 numbers"), "{message}");
}

#[test]
fn mask_paths_are_told_once() {
    let dir = tempfile::tempdir().unwrap();
    let mask = |file: &std::path::Path| change(file, |document| document["frames"][0]["mask_path"] = "masks/0.png".into());
    let told = |path: &std::path::Path| {
        let scene = load(path).unwrap();
        scene.warnings.iter().filter(|w| w.contains("mask_path")).cloned().collect::<Vec<_>>()
    };
    let [studio, split] = ["studio", "split"].map(|name| dir.path().join(name));
    write_nerfstudio(&studio, 4);
    write_dnerf(&split, 3, 1, 16);
    assert!(told(&studio).is_empty() && told(&split).is_empty());
    mask(&studio.join("transforms.json"));
    mask(&split.join("transforms_train.json"));
    mask(&split.join("transforms_test.json"));
    for (path, begins) in [(studio, "1 image has a mask_path; its mask is not used"), (split, "2 images have a mask_path; their masks are not used")] {
        let said = told(&path);
        assert!(said.len() == 1 && said[0].starts_with(begins) && said[0].contains("alpha channel"), "{said:?}");
    }
}

#[test]
fn names_of_a_split_may_begin_with_a_dot() {
    let dir = tempfile::tempdir().unwrap();
    write_nerfstudio(dir.path(), 6);
    let file = dir.path().join("transforms.json");
    let mut document: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    let names = |of: &[usize]| serde_json::json!(of.iter().map(|i| format!("./images/{i:04}.png")).collect::<Vec<_>>());
    (document["train_filenames"], document["test_filenames"], document["val_filenames"]) = (names(&[0, 1, 2]), names(&[3]), names(&[4]));
    std::fs::write(&file, document.to_string()).unwrap();
    let scene = load(dir.path()).unwrap();
    let of = |split: Split| scene.split(split).iter().map(|&v| scene.camera(v).name.clone()).collect::<Vec<_>>();
    assert_eq!((of(Split::Test), of(Split::Validation)), (vec!["images/0003.png".to_string()], vec!["images/0004.png".into()]));
    assert_eq!(of(Split::Train).len(), 3);
    assert!(scene.warnings.iter().any(|w| w.starts_with("1 image is in none of")), "{:?}", scene.warnings);
    // Validation images may be named alone.
    ["train_filenames", "test_filenames"].iter().for_each(|key| document[*key] = serde_json::json!([]));
    std::fs::write(&file, document.to_string()).unwrap();
    let scene = load(dir.path()).unwrap();
    assert_eq!((scene.split(Split::Validation).len(), scene.split(Split::Train).len()), (1, 5));
}

#[test]
fn the_right_reader_answers_or_all_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let message = load(dir.path()).err().unwrap().to_string();
    for reader in Registry::collect().unwrap().readers() {
        assert!(message.contains(reader.info.name) && message.contains(reader.looks_for), "{message}");
    }
    let missing = load(&dir.path().join("nothing")).err().unwrap();
    assert_eq!(missing.exit_code(), 2, "{missing}");
    // A folder that two readers recognise is opened by the more specific one, unless scene.reader names the other.
    write_dnerf(dir.path(), 3, 1, 8);
    std::fs::write(dir.path().join("transforms.json"), "{}").unwrap();
    assert!(load(dir.path()).is_ok());
    let forced = SceneOptions { reader: "nerfstudio".into(), ..Default::default() };
    assert!(open(dir.path(), &forced, &Limits::default()).is_err());
    let typo = SceneOptions { reader: "blendr".into(), ..Default::default() };
    let message = open(dir.path(), &typo, &Limits::default()).err().unwrap().to_string();
    assert!(message.contains("Did you mean blender"), "{message}");
}
