//! nerfstudio and instant-ngp scenes: one `transforms.json`, intrinsics shared or per frame, lens coefficients. Usually static; an entry that names a
//! video is a camera with all frames of it.

use super::assemble::fit_to_image;
use super::video::{self, Footage};
use cc4dgs_core::reader::files::{file_name, has_extension, image_size, read_json};
use cc4dgs_core::reader::pose::{from_opengl_camera_to_world, matrix4};
use cc4dgs_core::{Distortion, Error, ImageSource, Limits, Plugin, RawCamera, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory};
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Where the file names no split, every eighth image is held out, as is usual for static scenes.
pub(crate) const HOLD_OUT_EVERY: usize = 8;

#[derive(Clone, Default, Deserialize)]
struct Intrinsics {
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
    camera_model: Option<String>,
    is_fisheye: Option<bool>,
}

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<Frame>,
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
}

impl Intrinsics {
    /// Own values first, then the shared ones.
    fn over(&self, shared: &Self) -> Self {
        macro_rules! first {
            ($($field:ident),*) => { Self { $($field: self.$field.clone().or_else(|| shared.$field.clone())),* } };
        }
        first!(camera_angle_x, camera_angle_y, fl_x, fl_y, cx, cy, w, h, k1, k2, k3, k4, p1, p2, camera_model, is_fisheye)
    }
    fn distortion(&self) -> Result<Distortion, String> {
        let radial = [self.k1, self.k2, self.k3, self.k4].map(|k| k.unwrap_or(0.0));
        let tangential = [self.p1.unwrap_or(0.0), self.p2.unwrap_or(0.0)];
        match self.camera_model.as_deref().unwrap_or("OPENCV") {
            "OPENCV_FISHEYE" => Ok(Distortion::Fisheye { radial }),
            _ if self.is_fisheye == Some(true) => Ok(Distortion::Fisheye { radial }),
            "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE" => Ok(Distortion::Brown { radial, tangential }),
            other => Err(format!("camera model {other:?} is not supported; known are OPENCV, PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV_FISHEYE")),
        }
    }
    /// Focal lengths from pixels, or from the angles of view.
    fn focal(&self, w: f64, h: f64) -> Result<[f64; 2], String> {
        let from_angle = |size: f64, angle: f64| 0.5 * size / (0.5 * angle).tan();
        let fx = self.fl_x.or_else(|| self.camera_angle_x.map(|a| from_angle(w, a))).or(self.fl_y);
        let fx = fx.or_else(|| self.camera_angle_y.map(|a| from_angle(h, a))).ok_or("it has neither fl_x nor camera_angle_x")?;
        Ok([fx, self.fl_y.or_else(|| self.camera_angle_y.map(|a| from_angle(h, a))).unwrap_or(fx)])
    }
}

/// The file a JSON names, with the usual extensions tried where it names none.
pub(crate) fn image_path(folder: &Path, named: &str) -> PathBuf {
    let path = folder.join(named);
    if has_extension(&path, &["png", "jpg", "jpeg"]) || path.is_file() {
        return path;
    }
    let with = |extension: &str| folder.join(format!("{named}.{extension}"));
    ["png", "jpg", "jpeg"].iter().map(|e| with(e)).find(|p| p.is_file()).unwrap_or_else(|| with("png"))
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
    let mut frames: Vec<&Frame> = transforms.frames.iter().collect();
    frames.sort_by(|a, b| a.file_path.cmp(&b.file_path));
    let mut videos = videos(&object, &frames, folder, options, limits, &mut scene.warnings)?;
    let has_times = videos.is_empty();
    let named_split = !transforms.train_filenames.is_empty() || !transforms.test_filenames.is_empty();
    let mut missing = Vec::new();
    let mut seen = 0;
    let mut times = Vec::new();
    for frame in frames {
        let path = image_path(folder, &frame.file_path);
        if !path.is_file() {
            missing.push(frame.file_path.clone());
            continue;
        }
        let split = if named_split {
            let held_out = transforms.test_filenames.contains(&frame.file_path);
            let listed = held_out || transforms.train_filenames.is_empty() || transforms.train_filenames.contains(&frame.file_path);
            if !listed && transforms.val_filenames.contains(&frame.file_path) {
                continue;
            }
            if held_out { Split::Test } else { Split::Train }
        } else if seen % HOLD_OUT_EVERY == 0 && transforms.frames.len() > 1 {
            Split::Test
        } else {
            Split::Train
        };
        seen += 1;
        let bad = |problem: String| Error::data(format!("{object}: frame {}", frame.file_path), problem, "Correct the JSON");
        if let Some(footage) = videos.remove(&path) {
            let mut camera = camera(frame, &transforms.shared, &|| Ok((footage.size[0], footage.size[1])), &bad)?;
            fit_to_image(&mut camera, (footage.size[0], footage.size[1]), &mut scene.warnings)?;
            let images = footage.images.into_iter().enumerate().filter_map(|(index, image)| image.map(|image| (index, image)));
            scene.views.extend(images.map(|(index, image)| RawView { camera: scene.cameras.len(), frame: index, time: None, split, image }));
            scene.cameras.push(camera);
            continue;
        }
        scene.cameras.push(camera(frame, &transforms.shared, &|| image_size(&path, limits), &bad)?);
        times.push(frame.time);
        scene.views.push(RawView { camera: scene.cameras.len() - 1, frame: 0, time: Some(0.0), split, image: ImageSource::File { path, mask: None } });
    }
    if !missing.is_empty() {
        let shown = missing.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        scene.warnings.push(format!(
            "{} of {} images are missing and were skipped: {shown}{}",
            missing.len(),
            transforms.frames.len(),
            if missing.len() > 3 { ", …" } else { "" }
        ));
    }
    if has_times {
        scene.rank_times(&times, &object)?;
    }
    Ok(scene)
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

fn camera(frame: &Frame, shared: &Intrinsics, image_size: &dyn Fn() -> Result<(u32, u32)>, bad: &dyn Fn(String) -> Error) -> Result<RawCamera> {
    let intrinsics = frame.own.over(shared);
    let (w, h) = match (intrinsics.w, intrinsics.h) {
        (Some(w), Some(h)) if w >= 1.0 && h >= 1.0 && w <= 1e6 && h <= 1e6 => (w, h),
        (None, None) => {
            let (w, h) = image_size()?;
            (f64::from(w), f64::from(h))
        }
        (w, h) => return Err(bad(format!("image size w {w:?}, h {h:?} is not a size"))),
    };
    let world_to_camera = matrix4(&frame.transform_matrix).and_then(|m| from_opengl_camera_to_world(&m)).map_err(bad)?;
    Ok(RawCamera {
        name: frame.file_path.trim_start_matches("./").to_string(),
        size: [w as u32, h as u32],
        focal: intrinsics.focal(w, h).map_err(bad)?,
        principal: [intrinsics.cx.unwrap_or(0.5 * w), intrinsics.cy.unwrap_or(0.5 * h)],
        distortion: intrinsics.distortion().map_err(bad)?,
        world_to_camera,
    })
}
