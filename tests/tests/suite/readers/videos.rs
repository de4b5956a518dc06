//! Videos as people bring them: turned, of variable or different frame rates, started at different moments. Each frame holds the number of the instant at
//! which it was recorded, so that a test can tell what it sees. Skipped with a note where the ffmpeg command is missing.

use super::common::*;
use super::recordings::*;
use cc4dgs_core::{Limits, Scene, SceneOptions, Split, SyncMode};
use std::path::Path;

#[test]
fn constant_rates_keep_every_frame() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(2, SIZE);
    (0..2).for_each(|c| record(&video(&dir, c), c, &(0..40).collect::<Vec<_>>(), "30000/1001", &[]));
    let scene = opened(&dir, &options);
    // Of two cameras none is held out, and that is all there is to say.
    assert!(scene.warnings.len() == 1 && scene.warnings[0].contains("none is held out"), "{:?}", scene.warnings);
    assert!(scene.split(Split::Test).is_empty());
    assert_eq!(instants(&scene), (0..40).map(|k| (k, vec![Some(k); 2])).collect());
    // A cleaned cache may be incomplete.
    let images = |dir: &Path| std::fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.extension().is_some_and(|e| e == "png"));
    let cached = std::fs::read_dir(dir.path().join("cache")).unwrap().map(|entry| entry.unwrap().path()).find(|path| path.is_dir()).unwrap();
    images(&cached).take(7).for_each(|image| std::fs::remove_file(image).unwrap());
    assert_eq!(instants(&opened(&dir, &options)).len(), 40);
    assert_eq!(images(&cached).count(), 40);
    let some = opened(&dir, &SceneOptions { frames: Some([5, 6, 4]), video_cache: Some(dir.path().join("50%d")), ..options });
    assert_eq!(instants(&some), (0..6).map(|k| (k, vec![Some(5 + 4 * k); 2])).collect());
}

/// Writes a display matrix into the header of an mp4 file.
fn set_matrix(file: &Path, matrix: [f64; 4]) {
    let mut bytes = std::fs::read(file).unwrap();
    let header = bytes.windows(4).position(|w| w == b"tkhd").unwrap() + 4;
    assert_eq!(bytes[header], 0, "version 0 of the track header");
    let [a, b, c, d] = matrix.map(|v| (v * 65536.0) as i32);
    for (index, value) in [a, b, 0, c, d, 0, 0, 0, 1 << 30].into_iter().enumerate() {
        let at = header + 40 + 4 * index;
        bytes[at..at + 4].copy_from_slice(&value.to_be_bytes());
    }
    std::fs::write(file, bytes).unwrap();
}

#[test]
fn rotated_phones_are_upright() {
    if !ffmpeg() {
        return;
    }
    // Clockwise by 0, 90, 180 and 270 degrees: where the corner that is bright in the file, lower left, is displayed (right, bottom).
    let turns = [([1.0, 0.0, 0.0, 1.0], (0, 1)), ([0.0, 1.0, -1.0, 0.0], (0, 0)), ([-1.0, 0.0, 0.0, -1.0], (1, 0)), ([0.0, -1.0, 1.0, 0.0], (1, 1))];
    for (matrix, corner) in turns {
        let size = if matrix[0] == 0.0 { (SIZE.1, SIZE.0) } else { SIZE };
        let (dir, options) = rig(2, size);
        for c in 0..2 {
            record(&video(&dir, c), c, &[0, 1, 2], "30", &[]);
            set_matrix(&video(&dir, c), matrix);
        }
        let scene = opened(&dir, &options);
        assert_eq!((scene.cameras[0].width, scene.cameras[0].height), size);
        let image = scene.frame(2).unwrap();
        assert_eq!((image.width, image.height), size);
        let at = |right: u32, bottom: u32| image.data[(((bottom * (size.1 - 5) + 2) * size.0 + right * (size.0 - 5) + 2) * 3) as usize];
        let bright: Vec<(u32, u32)> = [(0, 0), (1, 0), (0, 1), (1, 1)].into_iter().filter(|(r, b)| at(*r, *b) > 180).collect();
        assert_eq!(bright, [corner], "{matrix:?}");
        // ffmpeg itself shows the same.
        let shown = dir.path().join("shown.png");
        encode(&["-i", video(&dir, 0).to_str().unwrap(), "-frames:v", "1"], &shown);
        let shown = image::open(&shown).unwrap().into_rgb8();
        let ours = scene.frame(0).unwrap();
        assert_eq!(shown.dimensions(), size);
        assert!(shown.as_raw().iter().zip(&ours.data).all(|(a, b)| a.abs_diff(*b) <= 2), "{matrix:?}");
    }
    // The calibration of the file's own size does not fit what is displayed.
    let (dir, options) = rig(1, SIZE);
    record(&video(&dir, 0), 0, &[0, 1], "30", &[]);
    set_matrix(&video(&dir, 0), [0.0, 1.0, -1.0, 0.0]);
    let message = open(dir.path(), &options, &Limits::default()).err().unwrap().to_string();
    assert!(message.contains("48x64"), "{message}");
    set_matrix(&video(&dir, 0), [0.7, 0.7, -0.7, 0.7]);
    let message = open(dir.path(), &options, &Limits::default()).err().unwrap().to_string();
    assert!(message.contains("45.0 degrees"), "{message}");
}

#[test]
fn variable_rates_are_matched_by_time() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(2, SIZE);
    let all: Vec<usize> = (0..48).collect();
    record(&video(&dir, 0), 0, &all, "24", &[]);
    // The recorder dropped frames, and the file says so. (ffmpeg writes mp4 at a constant rate unless told otherwise.)
    record(&dir.path().join("cam01.mkv"), 1, &all, "24", &["-vf", "select='not(between(n,10,14)+eq(n,30))'"]);
    let scene = opened(&dir, &options);
    let dropped = |k: usize| (10..=14).contains(&k) || k == 30;
    assert_eq!(instants(&scene), all.iter().map(|&k| (k, vec![Some(k), (!dropped(k)).then_some(k)])).collect());
    assert!(scene.warnings.iter().any(|w| w.contains("cam01.mkv has a variable frame rate") && w.contains("6 of 48")), "{:?}", scene.warnings);
    let strided = opened(&dir, &SceneOptions { frames: Some([0, 0, 3]), ..options });
    assert_eq!(instants(&strided), (0..16).map(|k| (k, vec![Some(3 * k), (!dropped(3 * k)).then_some(3 * k)])).collect());
}

#[test]
fn frames_count_whose_container_states_no_times() {
    if !ffmpeg() {
        return;
    }
    // MPEG program streams state none for some frames where there are B frames.
    let (dir, options) = rig(2, SIZE);
    let frames: Vec<usize> = (0..40).collect();
    (0..2).for_each(|c| record(&dir.path().join(format!("cam{c:02}.mpg")), c, &frames, "25", &["-c:v", "mpeg2video", "-bf", "2"]));
    assert_eq!(instants(&opened(&dir, &options)), (0..40).map(|k| (k, vec![Some(k); 2])).collect());
}

#[test]
fn different_rates_are_brought_to_the_lowest() {
    if !ffmpeg() {
        return;
    }
    // Instants are sixtieths of a second.
    let (dir, options) = rig(3, SIZE);
    record(&video(&dir, 0), 0, &(0..60).collect::<Vec<_>>(), "60", &[]);
    record(&video(&dir, 1), 1, &(0..30).map(|k| 2 * k).collect::<Vec<_>>(), "30", &[]);
    record(&video(&dir, 2), 2, &(0..20).map(|k| 3 * k).collect::<Vec<_>>(), "20", &[]);
    let scene = opened(&dir, &options);
    let found = instants(&scene);
    assert_eq!(found.len(), 20);
    for (k, shown) in found {
        assert_eq!((shown[0], shown[2]), (Some(3 * k), Some(3 * k)));
        assert!(shown[1].unwrap().abs_diff(3 * k) <= 1, "frame {k}: {shown:?}");
    }
    assert!(scene.warnings.iter().any(|w| w.contains("different frame rates") && w.contains("20.00 frames per second")), "{:?}", scene.warnings);
}

#[test]
fn start_times_count() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(2, SIZE);
    let at = |camera: usize| dir.path().join(format!("cam{camera:02}.mkv"));
    record(&at(0), 0, &(0..30).collect::<Vec<_>>(), "25", &[]);
    record(&at(1), 1, &(5..35).collect::<Vec<_>>(), "25", &["-output_ts_offset", "0.2"]);
    let scene = opened(&dir, &options);
    assert_eq!(instants(&scene), (0..25).map(|k| (k, vec![Some(5 + k); 2])).collect());
    assert!(scene.warnings.iter().any(|w| w.contains("matched by time")), "{:?}", scene.warnings);
}

#[test]
fn offsets_between_cameras_are_undone() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(4, SIZE);
    let starts = [30, 30, 22, 41];
    starts.iter().enumerate().for_each(|(c, start)| record(&video(&dir, c), c, &(*start..start + 260).collect::<Vec<_>>(), "30", &[]));
    let scene = opened(&dir, &options);
    for (camera, offset) in [("cam02", "k+8"), ("cam03", "k-11")] {
        assert!(scene.warnings.iter().any(|w| w.contains(camera) && w.contains(offset)), "{camera}: {:?}", scene.warnings);
    }
    // All cameras recorded from 41 to 281.
    assert_eq!(instants(&scene), (0..241).map(|k| (k, vec![Some(41 + k); 4])).collect());
    // The offsets do not depend on the frames that are chosen, and the second opening reads the cache.
    let few = opened(&dir, &SceneOptions { frames: Some([7, 2, 5]), ..options.clone() });
    assert_eq!(instants(&few), [(0, vec![Some(48); 4]), (1, vec![Some(53); 4])].into());
    let off = opened(&dir, &SceneOptions { sync: SyncMode::Off, frames: Some([0, 2, 1]), ..options.clone() });
    assert_eq!(instants(&off), (0..2).map(|k| (k, starts.iter().map(|s| Some(s + k)).collect())).collect());
    let stated = SceneOptions { offsets: [("cam02".to_string(), 8)].into(), frames: Some([0, 2, 1]), ..options };
    assert_eq!(instants(&opened(&dir, &stated)), (0..2).map(|k| (k, [30, 30, 30, 41].iter().map(|s| Some(s + k)).collect())).collect());
}

#[test]
fn transforms_and_colmap_may_name_videos() {
    if !ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let cameras = ring(3, SIZE.0, SIZE.1);
    for c in 0..3 {
        std::fs::create_dir_all(dir.path().join("videos")).unwrap();
        record(&dir.path().join(format!("videos/c{c}.mp4")), c, &(0..12).collect::<Vec<_>>(), "30", &[]);
    }
    let options = SceneOptions { video_cache: Some(dir.path().join("cache")), ..Default::default() };
    let check = |scene: &Scene| {
        assert_eq!((scene.cameras.len(), scene.frame_count), (3, 12));
        assert_eq!(instants(scene), (0..12).map(|k| (k, vec![Some(k); 3])).collect());
        (0..36).for_each(|view| same_pose(&dataset_camera(scene, view), &cameras[scene.views[view].camera]));
    };
    let frame = |(c, camera): (usize, &cc4dgs_core::Camera)| serde_json::json!({"file_path": format!("videos/c{c}.mp4"), "transform_matrix": opengl_camera_to_world(camera)});
    let frames: Vec<_> = cameras.iter().enumerate().map(frame).collect();
    let write = |frames: &[serde_json::Value]| {
        // Calibrated at twice the size of the videos.
        let document = serde_json::json!({"fl_x": 2.0 * cameras[0].fx, "cx": 64.0, "cy": 48.0, "w": 128, "h": 96, "frames": frames});
        std::fs::write(dir.path().join("transforms.json"), document.to_string()).unwrap();
    };
    write(&frames);
    let scene = opened(&dir, &options);
    check(&scene);
    assert_eq!((scene.camera(0).width, scene.camera(0).cx, scene.cameras[0].name.as_str()), (64, 32.0, "videos/c0.mp4"));
    let mut with_depth = frames.clone();
    with_depth[1]["depth_file_path"] = "depth/c1.png".into();
    write(&with_depth);
    let warnings = opened(&dir, &options).warnings;
    assert!(warnings.iter().any(|line| line.starts_with("1 video has a depth_file_path, which is read for images alone; its")), "{warnings:?}");
    // Frames of a camera with a lens are stored a little larger than they are wanted, not at the size of the video.
    let lens = serde_json::json!({"fl_x": 2.0 * cameras[0].fx, "cx": 64.0, "cy": 48.0, "w": 128, "h": 96, "k1": -0.05, "frames": frames});
    std::fs::write(dir.path().join("transforms.json"), lens.to_string()).unwrap();
    let small = SceneOptions { width: 16, video_cache: Some(dir.path().join("small")), ..options.clone() };
    let (whole, small) = (opened(&dir, &options), opened(&dir, &small));
    let image = small.frame(0).unwrap();
    assert_eq!((small.camera(0).width, image.width, image.height), (16, 16, small.camera(0).height));
    let angle = |camera: &cc4dgs_core::Camera| f64::from(camera.width) / camera.fx;
    assert!((angle(whole.camera(0)) / angle(small.camera(0)) - 1.0).abs() < 0.05, "{} {}", angle(whole.camera(0)), angle(small.camera(0)));
    let folders = std::fs::read_dir(dir.path().join("small")).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_dir());
    let stored = folders.map(|folder| image::image_dimensions(folder.join("000001.png")).unwrap().0).max().unwrap();
    assert!((16..32).contains(&stored), "{stored} of 64 pixels");
    let refused = |extra: serde_json::Value| {
        write(&[&frames[..], &[extra]].concat());
        open(dir.path(), &options, &Limits::default()).err().unwrap().to_string()
    };
    assert!(refused(frames[1].clone()).contains("named by two entries"));
    write_image(&dir.path().join("a.png"), 64, 48, 0);
    assert!(refused(serde_json::json!({"file_path": "a.png", "transform_matrix": opengl_camera_to_world(&cameras[0])})).contains("images and videos"));

    std::fs::remove_file(dir.path().join("transforms.json")).unwrap();
    std::fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
    let names: Vec<String> = (0..3).map(|c| format!("c{c}.png")).collect();
    for (file, bytes) in ["cameras", "images", "points3D"].iter().zip(colmap_binary(&cameras, &names)) {
        std::fs::write(dir.path().join(format!("sparse/0/{file}.bin")), bytes).unwrap();
    }
    check(&opened(&dir, &options));
}

#[test]
fn frames_that_a_cut_made_undecodable_do_not_count() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(3, SIZE);
    let elsewhere = tempfile::tempdir().unwrap();
    let source = elsewhere.path().join("source.mp4");
    let open_groups = ["-c:v", "libx264", "-x264-params", "open-gop=1:keyint=12:min-keyint=12:bframes=3:b-adapt=0:scenecut=0:log=none"];
    for c in 0..3 {
        record(&source, c, &(0..60).collect::<Vec<_>>(), "30", &open_groups);
        // Begins at the key frame of instant 24, with three frames before it that need the ones that are cut off.
        encode(&["-ss", "0.8", "-i", source.to_str().unwrap(), "-c", "copy", "-avoid_negative_ts", "make_zero", "-f", "matroska"], &video(&dir, c));
    }
    let scene = opened(&dir, &options);
    let found: Vec<Vec<Option<usize>>> = instants(&scene).into_values().collect();
    let first = found[0][0].unwrap();
    assert!(found.len() > 30 && found.iter().enumerate().all(|(k, cameras)| cameras.iter().all(|c| *c == Some(first + k))), "{found:?}");
}

#[test]
fn broken_videos_are_errors() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(1, SIZE);
    let file = video(&dir, 0);
    record(&file, 0, &(0..10).collect::<Vec<_>>(), "30", &[]);
    let sound = std::fs::read(&file).unwrap();
    let refuse = |bytes: &[u8], limits: &Limits| {
        std::fs::write(&file, bytes).unwrap();
        let error = open(dir.path(), &options, limits).and_then(|s| (0..s.views.len()).try_for_each(|v| s.frame(v).map(drop)));
        error.unwrap_err().to_string()
    };
    assert!(refuse(b"", &Limits::default()).contains("cam00.mp4"));
    assert!(refuse(b"no video at all", &Limits::default()).contains("ffprobe failed"));
    assert!(refuse(&sound[..sound.len() / 3], &Limits::default()).contains("cam00.mp4"));
    assert!(refuse(&sound, &Limits { max_pixels: 1000, ..Default::default() }).contains("3072"));
    // Sound only.
    let silence = dir.path().join("silence.m4a");
    encode(&["-f", "lavfi", "-i", "anullsrc", "-t", "0.2", "-c:a", "aac"], &silence);
    assert!(refuse(&std::fs::read(&silence).unwrap(), &Limits::default()).contains("holds no video"));
}

/// What a damaged or forged file may make ffprobe say.
#[cfg(unix)]
#[test]
fn absurd_facts_are_errors() {
    use std::os::unix::fs::PermissionsExt;
    let (dir, options) = rig(2, SIZE);
    let (probe, said) = (dir.path().join("ffprobe"), dir.path().join("said.json"));
    std::fs::write(&probe, format!("#!/bin/sh\ncat {}\n", said.display())).unwrap();
    std::fs::set_permissions(&probe, std::fs::Permissions::from_mode(0o755)).unwrap();
    let options = SceneOptions { ffmpeg: dir.path().join("ffmpeg").to_string_lossy().into_owned(), ..options };
    let say = |text: &str| {
        std::fs::write(&said, text).unwrap();
        // What is known of a video holds for the file as it was.
        (0..2).for_each(|c| std::fs::write(video(&dir, c), text).unwrap());
        open(dir.path(), &options, &Limits::default()).map(|s| s.frame_count).map_err(|e| e.to_string())
    };
    let stream = r#""streams": [{"width": 64, "height": 48, "avg_frame_rate": "1/0", "r_frame_rate": "99999999999/1"}]"#;
    for (text, problem) in [
        ("", "ffprobe said"),
        ("16,12,6", "ffprobe said"),
        ("{}", "no video"),
        (r#"{"streams": [{"width": 0, "height": 48}]}"#, "0x48"),
        (r#"{"streams": [{"width": 99999999, "height": 48}]}"#, "99999999x48"),
        (r#"{"streams": [{"width": -3, "height": 48}]}"#, "ffprobe said"),
        (&format!("{{{stream}, \"packets\": []}}"), "no frame"),
        (&format!("{{{stream}, \"packets\": [{{\"flags\": \"KD\"}}]}}"), "no frame"),
    ] {
        let message = say(text).unwrap_err();
        assert!(message.contains(problem), "{text}: {message}");
    }
    let times =
        |list: &[&str]| format!("{{{stream}, \"packets\": [{}]}}", list.iter().map(|t| format!("{{\"pts_time\": \"{t}\"}}")).collect::<Vec<_>>().join(","));
    assert_eq!(say(&times(&["nan", "1", "2"])), Ok(3));
    assert_eq!(say(&times(&["1e308", "-1e308"])), Ok(1));
    assert!(say(&times(&["0", "0.000001", "0.000002", "1e18"])).is_ok_and(|count| count <= 17));
    // Where a disk is full, the folder of the cache is to blame.
    let ffmpeg = dir.path().join("ffmpeg");
    std::fs::write(&ffmpeg, "#!/bin/sh\necho No space left on device >&2\nexit 1\n").unwrap();
    std::fs::set_permissions(&ffmpeg, std::fs::Permissions::from_mode(0o755)).unwrap();
    assert_eq!(say(&times(&["0", "1", "2"])), Ok(3));
    let (cache, full) = (dir.path().join("full"), SceneOptions { video_cache: Some(dir.path().join("full")), ..options.clone() });
    let error = open(dir.path(), &full, &Limits::default()).unwrap().frame(0).err().unwrap().to_string();
    assert!(["No space left", cache.to_str().unwrap(), "scene.video_cache"].iter().all(|part| error.contains(part)), "{error}");
}
