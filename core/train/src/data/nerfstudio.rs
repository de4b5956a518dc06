//! nerfstudio and instant-ngp scenes: one `transforms.json`, intrinsics shared or per frame, lens coefficients. Static, unless images
//! state a `time` (those of a camera that stands still are then frames of one camera) or an entry names a video, which is a camera with all frames of it. The
//! points of `ply_file_path` are those of the scene, the PNG files of `depth_file_path` its recorded depth.

use super::assemble::fit_to_image;
use super::fixed_cameras::{merge_fixed_cameras, warn_of_missing_times};
use super::intrinsics::{Intrinsics, camera};
use super::masks::warn_of_mask_paths;
use super::ply_points;
use super::video::{self, Footage};
use cc4dgs_core::reader::files::{file_name, has_extension, image_size, read_bytes, read_json};
use cc4dgs_core::{DepthFile, Error, ImageSource, Limits, Plugin, RawPoints, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory, plural};
use serde::Deserialize;
use serde::de::IgnoredAny;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Where the file names no split, every eighth image is held out, as is usual for static scenes.
pub(crate) const HOLD_OUT_EVERY: usize = 8;
/// From so many cameras or images on some are held out: one alone cannot be trained on.
pub(crate) const LEAST_HELD_OUT: usize = 3;
/// What is said of fewer.
pub(crate) const NOTHING_HELD_OUT: &str = "fewer than three images or cameras: none is held out (scene.test_cameras names some)";
/// Units of depth per step where the file states none: millimetres, in a world of metres (nerfstudio's data conventions).
pub(super) const DEPTH_UNIT: f64 = 1e-3;

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<Frame>,
    /// Points in the world of the frames' poses: where there is an `applied_transform`, both went through it.
    ply_file_path: Option<String>,
    /// Units of the world per step of the depth images.
    depth_unit_scale_factor: Option<f64>,
    #[serde(default)]
    train_filenames: Vec<String>,
    #[serde(default)]
    test_filenames: Vec<String>,
    #[serde(default)]
    val_filenames: Vec<String>,
}

#[derive(Deserialize)]
struct Frame {
    #[serde(flatten)]
    own: Intrinsics,
    file_path: String,
    transform_matrix: Vec<Vec<f64>>,
    time: Option<f64>,
    mask_path: Option<IgnoredAny>,
    depth_file_path: Option<String>,
}

/// The file a JSON names. Backslashes of Windows separate folders, unless a file has them in its name.
pub(super) fn file_named(folder: &Path, named: &str) -> PathBuf {
    let file = folder.join(named);
    if named.contains('\\') && !file.is_file() { folder.join(named.replace('\\', "/")) } else { file }
}

/// The image a JSON names, as [`file_named`], with the usual extensions tried where it names none.
pub(crate) fn image_path(folder: &Path, named: &str) -> PathBuf {
    if named.contains('\\') && !folder.join(named).is_file() {
        return image_path(folder, &named.replace('\\', "/"));
    }
    let path = folder.join(named);
    if has_extension(&path, &["png", "jpg", "jpeg"]) || path.is_file() {
        return path;
    }
    let with = |extension: &str| folder.join(format!("{named}.{extension}"));
    ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"].iter().map(|e| with(e)).find(|p| p.is_file()).unwrap_or_else(|| with("png"))
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "nerfstudio",
            version: "1",
            summary: "nerfstudio and instant-ngp scenes",
            paper: "Nerfstudio (Tancik et al. 2023)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "transforms.json (nerfstudio, instant-ngp) that names images, or a video per camera; or the path of such a file",
        order: 500,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    path.join("transforms.json").is_file() || (path.is_file() && has_extension(path, &["json"]))
}

fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let file = if path.is_file() { path.to_path_buf() } else { path.join("transforms.json") };
    let folder = file.parent().unwrap_or(Path::new("."));
    let object = file.display().to_string();
    let transforms: Transforms = read_json(&file, limits)?;
    let mut scene = RawScene { name: file_name(path), ..Default::default() };
    read_points(&object, folder, transforms.ply_file_path.as_deref(), limits, &mut scene);
    let mut frames: Vec<&Frame> = transforms.frames.iter().collect();
    frames.sort_by(|a, b| a.file_path.cmp(&b.file_path));
    let mut videos = videos(&object, &frames, folder, options, limits, &mut scene.warnings)?;
    let has_times = videos.is_empty();
    let named = |names: &[String]| names.iter().map(|name| plain(name).to_string()).collect::<BTreeSet<_>>();
    let [train, test, validation] = [&transforms.train_filenames, &transforms.test_filenames, &transforms.val_filenames].map(|names| named(names));
    let named_split = [&train, &test, &validation].iter().any(|names| !names.is_empty());
    let unit = transforms.depth_unit_scale_factor.unwrap_or(DEPTH_UNIT);
    let (mut missing, mut missing_depth, mut depth_of_videos, mut unlisted, mut seen) = (Vec::new(), 0, 0, 0, 0);
    let mut times = Vec::new();
    let of_frame = |frame: &Frame, image_size: &dyn Fn() -> Result<(u32, u32)>, bad: &dyn Fn(String) -> Error| {
        camera(&frame.file_path, &frame.transform_matrix, &frame.own.over(&transforms.shared), image_size, bad)
    };
    for frame in frames {
        let path = image_path(folder, &frame.file_path);
        if !path.is_file() {
            missing.push(frame.file_path.clone());
            continue;
        }
        let split = if named_split {
            match plain(&frame.file_path) {
                name if test.contains(name) => Split::Test,
                name if validation.contains(name) => Split::Validation,
                name if train.is_empty() || train.contains(name) => Split::Train,
                _ => {
                    unlisted += 1;
                    continue;
                }
            }
        } else if seen % HOLD_OUT_EVERY == 0 && transforms.frames.len() >= LEAST_HELD_OUT {
            Split::Test
        } else {
            Split::Train
        };
        seen += 1;
        let bad = |problem: String| Error::data(format!("{object}: frame {}", frame.file_path), problem, "Correct the JSON");
        if let Some(footage) = videos.remove(&path) {
            let mut camera = of_frame(frame, &|| Ok((footage.size[0], footage.size[1])), &bad)?;
            fit_to_image(&mut camera, (footage.size[0], footage.size[1]), &mut scene.warnings)?;
            let images = footage.images.into_iter().enumerate().filter_map(|(index, image)| image.map(|image| (index, image)));
            scene.views.extend(images.map(|(index, image)| RawView { camera: scene.cameras.len(), frame: index, time: None, split, image }));
            scene.cameras.push(camera);
            depth_of_videos += usize::from(frame.depth_file_path.is_some());
            continue;
        }
        scene.cameras.push(of_frame(frame, &|| image_size(&path, limits), &bad)?);
        times.push(frame.time);
        let depth = depth_file(folder, frame.depth_file_path.as_deref(), unit);
        missing_depth += usize::from(frame.depth_file_path.is_some() && depth.is_none());
        let image = ImageSource::File { path, mask: None, depth };
        scene.views.push(RawView { camera: scene.cameras.len() - 1, frame: 0, time: Some(0.0), split, image });
    }
    if depth_of_videos > 0 {
        let [have, their] = [plural(depth_of_videos, "video has", "videos have"), plural(depth_of_videos, "its", "their")];
        scene.warnings.push(format!("{depth_of_videos} {have} a depth_file_path, which is read for images alone; {their} depth is unknown"));
    }
    warn_of_missing_depth(missing_depth, &mut scene.warnings);
    if !missing.is_empty() {
        let shown = missing.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        scene.warnings.push(format!(
            "{} of {} {} {} skipped: {shown}{}",
            missing.len(),
            transforms.frames.len(),
            if has_times { "images" } else { "videos" },
            plural(missing.len(), "is missing and was", "are missing and were"),
            if missing.len() > 3 { ", …" } else { "" }
        ));
    }
    if !named_split && transforms.frames.len() < LEAST_HELD_OUT && options.test_cameras.is_none() {
        scene.warnings.push(NOTHING_HELD_OUT.into());
    }
    if unlisted > 0 {
        let [are, were] = [plural(unlisted, "image is", "images are"), plural(unlisted, "was", "were")];
        scene.warnings.push(format!("{unlisted} {are} in none of train_filenames, test_filenames and val_filenames, and {were} skipped"));
    }
    warn_of_mask_paths(transforms.frames.iter().filter(|frame| frame.mask_path.is_some()).count(), &mut scene.warnings);
    if has_times {
        warn_of_missing_times(&times, &mut scene.warnings);
        if times.len() > 1 && times.iter().all(Option::is_none) {
            scene.warnings.push(format!(
                "none of the {} images states a time, so nothing moves; for a scene that does, write \"time\" (0 at the first instant, 1 at the last) into every \
                 entry of \"frames\"",
                times.len()
            ));
        }
        scene.rank_times(&times, &object)?;
        if merge_fixed_cameras(&mut scene, &times, false) && !named_split && scene.cameras.len() >= LEAST_HELD_OUT {
            // Another instant of a camera that is trained on says nothing of new views.
            scene.views.iter_mut().for_each(|view| view.split = if view.camera.is_multiple_of(HOLD_OUT_EVERY) { Split::Test } else { Split::Train });
        }
    }
    Ok(scene)
}

/// Gives `scene` the points of the PLY that the document `object` names, if it names one. A warning says why they are not used.
pub(super) fn read_points(object: &str, folder: &Path, named: Option<&str>, limits: &Limits, scene: &mut RawScene) {
    match named.map(|named| points(object, folder, named, limits)).transpose() {
        Ok(points) => scene.points = points,
        // The cameras do not need them.
        Err(error) => scene.warnings.push(format!("the points of ply_file_path are not used: {error}")),
    }
}

/// The file of recorded depth that an image names, if there is one; `unit` is in units of the world per step.
pub(super) fn depth_file(folder: &Path, named: Option<&str>, unit: f64) -> Option<DepthFile> {
    named.map(|named| file_named(folder, named)).filter(|f| f.is_file()).map(|path| DepthFile { path, unit })
}

/// Says so where `count` images name a depth file that does not exist.
pub(super) fn warn_of_missing_depth(count: usize, warnings: &mut Vec<String>) {
    if count > 0 {
        let [have, their] = [plural(count, "image has", "images have"), plural(count, "its", "their")];
        warnings.push(format!("{count} {have} a depth_file_path that names no file; {their} depth is unknown"));
    }
}

/// The points of the PLY that the document `object` names.
fn points(object: &str, folder: &Path, named: &str, limits: &Limits) -> Result<RawPoints> {
    let file = file_named(folder, named);
    let name = file.display().to_string();
    if !file.exists() {
        let problem = format!("there is no such file, and {object} names it as ply_file_path");
        return Err(Error::data(name, problem, "Copy it there, or remove the entry to start from other points"));
    }
    ply_points::points(&name, &read_bytes(&file, limits)?, limits)
}

/// The name of a file without a leading `./`.
pub(super) fn plain(name: &str) -> &str {
    name.trim_start_matches("./")
}

/// The videos that the frames name, if they do, by path.
fn videos(
    object: &str,
    frames: &[&Frame],
    folder: &Path,
    options: &SceneOptions,
    limits: &Limits,
    warnings: &mut Vec<String>,
) -> Result<BTreeMap<PathBuf, Footage>> {
    let found: Vec<PathBuf> = frames.iter().map(|f| image_path(folder, &f.file_path)).filter(|p| p.is_file()).collect();
    let paths: Vec<PathBuf> = found.iter().filter(|p| video::is_video(p)).cloned().collect();
    let problem = if paths.iter().collect::<BTreeSet<_>>().len() < paths.len() {
        "a video is named by two entries"
    } else if !paths.is_empty() && paths.len() < found.len() {
        "it names images and videos"
    } else {
        let footage = video::footage(&paths, options, limits, warnings)?;
        return Ok(paths.into_iter().zip(footage).collect());
    };
    Err(Error::data(object, problem, "Write one entry per camera with its video, or one per image"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backslashes_of_windows_separate_folders() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("images")).unwrap();
        let file = dir.path().join("images/a.png");
        std::fs::write(&file, "").unwrap();
        for named in ["images/a.png", "images/a", "images\\a.png", "images\\a"] {
            assert_eq!(image_path(dir.path(), named), file, "{named}");
        }
        assert!(image_path(dir.path(), "./images\\a").is_file() && !image_path(dir.path(), "images\\b").is_file());
        std::fs::write(dir.path().join("images/r_0.PNG"), "").unwrap();
        assert!(image_path(dir.path(), "./images/r_0").is_file());
    }

    #[test]
    fn the_ply_of_points_is_in_the_world_of_the_poses() {
        let dir = tempfile::tempdir().unwrap();
        let (named, file) = ("points\\\\sparse_pc.ply", dir.path().join("points/sparse_pc.ply"));
        std::fs::create_dir(dir.path().join("points")).unwrap();
        std::fs::write(dir.path().join("a.png"), "").unwrap();
        let pose = "[[1, 0, 0, 7], [0, 1, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]]";
        let applied = "[[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]";
        let text = format!(
            r#"{{"fl_x": 8, "w": 8, "h": 6, "ply_file_path": "{named}", "applied_transform": {applied},
                "frames": [{{"file_path": "a.png", "transform_matrix": {pose}}}]}}"#
        );
        std::fs::write(dir.path().join("transforms.json"), text).unwrap();
        let properties = "property float x\nproperty float y\nproperty float z\nproperty uint8 red\nproperty uint8 green\nproperty uint8 blue\n";
        let sound = format!("ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n7 8 5 255 0 51\n1 2 3 0 255 0\n");
        let read = || open(dir.path(), &SceneOptions::default(), &Limits::default()).unwrap();
        std::fs::write(&file, &sound).unwrap();
        let scene = read();
        assert_eq!(scene.warnings, [NOTHING_HELD_OUT]);
        assert_eq!(scene.points, Some(RawPoints { positions: vec![[7.0, 8.0, 5.0], [1.0, 2.0, 3.0]], colors: vec![[1.0, 0.0, 0.2], [0.0, 1.0, 0.0]] }));
        assert_eq!(scene.cameras[0].pinhole().center_world(), [7.0, 8.0, 9.0]);
        // Without its points the scene is still there.
        let told = || {
            let scene = read();
            assert!(scene.points.is_none() && scene.views.len() == 1);
            scene.warnings.join("")
        };
        std::fs::write(&file, &sound[..sound.len() - 8]).unwrap();
        let damaged = told();
        assert!(damaged.contains("sparse_pc.ply: it states 2 vertices") && damaged.contains("write it again"), "{damaged}");
        std::fs::remove_file(&file).unwrap();
        let missing = told();
        assert!(missing.contains("sparse_pc.ply: there is no such file") && missing.contains("Copy it there"), "{missing}");
    }
}
