//! Videos that give fewer images than they have packets, or in another order: no image may be taken for that of another time. Skipped with a note where the
//! ffmpeg command is missing.

use super::recordings::*;
use cc4dgs_core::{Scene, SceneOptions};
use std::path::Path;
use std::process::Command;

/// Overwrites a packet of a video with zeros.
fn damage(video: &Path, packet: usize) {
    let packets = ["-v", "error", "-select_streams", "v:0", "-show_entries", "packet=pos,size", "-of", "json"];
    let output = Command::new("ffprobe").args(packets).arg(video).output().unwrap();
    let listed: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let number = |key: &str| listed["packets"][packet][key].as_str().unwrap().parse::<usize>().unwrap();
    let (start, size) = (number("pos"), number("size"));
    let mut bytes = std::fs::read(video).unwrap();
    bytes[start..start + size].fill(0);
    std::fs::write(video, bytes).unwrap();
}

/// What is wrong with the first image of a camera that cannot be read; `None` where all can.
fn problem(scene: &Scene, camera: usize) -> Option<String> {
    (0..scene.views.len()).filter(|view| scene.views[*view].camera == camera).find_map(|view| scene.frame(view).err()).map(|error| error.to_string())
}

#[test]
fn a_frame_that_does_not_decode_is_named() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(2, SIZE);
    let file = video(&dir, 1);
    (0..2).for_each(|c| record(&video(&dir, c), c, &(0..40).collect::<Vec<_>>(), "25", &["-g", "1"]));
    damage(&file, 20);
    let scene = opened(&dir, &options);
    assert_eq!(problem(&scene, 0), None);
    let error = problem(&scene, 1).unwrap();
    assert!(["cam01.mp4", "frame 20, at 0.800 s", "OTHER_FOLDER/cam01.mkv", "scene.frames"].iter().all(|part| error.contains(part)), "{error}");
    let after = opened(&dir, &SceneOptions { frames: Some([30, 5, 1]), ..options.clone() });
    assert!(problem(&after, 1).unwrap().contains("0.800 s"));
    // What comes before it is sound.
    let before = opened(&dir, &SceneOptions { frames: Some([0, 20, 1]), ..options.clone() });
    assert_eq!(instants(&before), (0..20).map(|k| (k, vec![Some(k); 2])).collect());
    // The command that the error names.
    let named = error.split_once("(ffmpeg ").and_then(|(_, rest)| rest.split_once(" OTHER_FOLDER/cam01.mkv)")).unwrap().0;
    let arguments: Vec<&str> = named.split(' ').map(|part| if part == "cam01.mp4" { file.to_str().unwrap() } else { part }).collect();
    encode(&arguments, &dir.path().join("cam01.mkv"));
    std::fs::remove_file(&file).unwrap();
    assert_eq!(instants(&opened(&dir, &options)), (0..40).map(|k| (k, vec![Some(k), (k != 20).then_some(k)])).collect());
}

#[test]
fn damage_does_not_change_the_offsets_between_cameras() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(4, SIZE);
    let starts = [30, 30, 22, 41];
    starts.iter().enumerate().for_each(|(c, start)| record(&video(&dir, c), c, &(*start..start + 260).collect::<Vec<_>>(), "30", &[]));
    damage(&video(&dir, 2), 5);
    let warnings = opened(&dir, &options).warnings;
    assert!(warnings.iter().any(|w| w.contains("cam02") && w.contains("k+8")), "{warnings:?}");
}

#[test]
fn hidden_frames_of_vp8_do_not_count() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(2, SIZE);
    let elsewhere = tempfile::tempdir().unwrap();
    let (source, log) = (elsewhere.path().join("source.mkv"), elsewhere.path().join("log"));
    let frames: Vec<usize> = (0..50).collect();
    record(&video(&dir, 0), 0, &frames, "25", &[]);
    record(&source, 1, &frames, "25", &["-c:v", "ffv1"]);
    // Only with two passes the encoder writes frames that are not shown.
    for (pass, out) in [("1", elsewhere.path().join("first.webm")), ("2", dir.path().join("cam01.webm"))] {
        let (source, log) = (source.to_str().unwrap(), log.to_str().unwrap());
        let codec = ["-c:v", "libvpx", "-auto-alt-ref", "1", "-lag-in-frames", "25", "-b:v", "1M", "-g", "100"];
        encode(&[&["-i", source][..], &codec, &["-pass", pass, "-passlogfile", log]].concat(), &out);
    }
    assert_eq!(instants(&opened(&dir, &options)), (0..50).map(|k| (k, vec![Some(k); 2])).collect());
}

#[test]
fn joined_recordings_are_not_mixed_up() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(1, SIZE);
    let elsewhere = tempfile::tempdir().unwrap();
    let part = |name: &str, more: &[&str]| {
        let file = elsewhere.path().join(name);
        record(&file, 0, &(0..20).collect::<Vec<_>>(), "25", &[&["-c:v", "mpeg2video"][..], more].concat());
        std::fs::read(&file).unwrap()
    };
    let (small, large) = (part("a.ts", &[]), part("b.ts", &["-vf", "scale=96:72", "-output_ts_offset", "0.8"]));
    let join = |second: &[u8]| std::fs::write(dir.path().join("cam00.ts"), [&small[..], second].concat()).unwrap();
    join(&large);
    let error = problem(&opened(&dir, &options), 0).unwrap();
    assert!(error.contains("cam00.ts") && error.contains("size or pixel format") && error.contains("-vf scale=64:48"), "{error}");
    let first = opened(&dir, &SceneOptions { frames: Some([0, 10, 1]), ..options.clone() });
    assert_eq!(instants(&first), (0..10).map(|k| (k, vec![Some(k)])).collect());
    // Both begin at the same time.
    join(&small);
    let error = problem(&opened(&dir, &options), 0).unwrap();
    assert!(error.contains("cam00.ts") && error.contains("order of their times"), "{error}");
}

#[test]
fn streams_that_begin_between_key_frames_are_read_from_the_first_one_on() {
    if !ffmpeg() {
        return;
    }
    let (dir, options) = rig(1, SIZE);
    let file = dir.path().join("cam00.ts");
    record(&file, 0, &(0..60).collect::<Vec<_>>(), "25", &["-c:v", "mpeg2video", "-g", "12", "-bf", "2"]);
    // Transport streams have packets of 188 bytes; a third of them was not recorded.
    let bytes = std::fs::read(&file).unwrap();
    std::fs::write(&file, &bytes[bytes.len() / 3 / 188 * 188..]).unwrap();
    let found = instants(&opened(&dir, &options));
    let first = found[&0][0].unwrap();
    assert!(first > 0 && first + found.len() == 60, "{} frames from {first} on", found.len());
    assert_eq!(found, (0..found.len()).map(|k| (k, vec![Some(first + k)])).collect());
}
