//! Technicolor light-field videos as E-D3DGS uses them: a 4x4 rig, undistorted images or smaller copies of them, `cameras_parameters.txt`.
//! First points come from a dense cloud or a COLMAP model beside it.

use super::dense_clouds::first_points;
use cc4dgs_core::reader::files::{file_name, image_size, is_image, list, read_text};
use cc4dgs_core::reader::pose::from_quaternion;
use cc4dgs_core::{Distortion, Error, ImageSource, Limits, Plugin, RawCamera, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory, plural};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// First frame of the 50 each of the five scenes is evaluated on.
const FIRST_FRAMES: [(&str, u32); 5] = [("Birthday", 151), ("Fabien", 51), ("Painter", 100), ("Theater", 51), ("Train", 151)];
const FRAMES: u32 = 50;
/// Width and height in pixels of the dataset's images. Its `cameras_parameters.txt` is calibrated for them without saying so.
const FULL_SIZE: [u32; 2] = [2048, 1088];
/// The held-out view.
const TEST_CAMERA: u32 = 10;

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "technicolor",
            version: "1",
            summary: "Technicolor light-field videos",
            paper: "Dataset and Pipeline for Multi-View Light-Field Video (Sabater et al. 2017)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "cameras_parameters.txt and <Scene>_undist_<frame>_<camera>.png (Technicolor)",
        order: 200,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    path.join("cameras_parameters.txt").is_file()
}

fn open(path: &Path, _: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let file = path.join("cameras_parameters.txt");
    let rows = read_parameters(&file, limits)?;
    let mut images: BTreeMap<(u32, u32), PathBuf> = BTreeMap::new();
    let mut scene_name = String::new();
    for image in list(path, is_image)? {
        if let Some((name, frame, camera)) = parse_name(&image) {
            scene_name = name;
            images.insert((frame, camera), image);
        }
    }
    // "Trains" and "Train" are both in use.
    let range = FIRST_FRAMES.iter().find(|(name, _)| scene_name.starts_with(name)).map(|&(_, first)| first..first + FRAMES);
    let found = images.len();
    if let Some(range) = &range {
        images.retain(|(frame, _), _| range.contains(frame));
    }
    let mut frames: Vec<u32> = images.keys().map(|k| k.0).collect();
    frames.dedup();
    let Some(first) = images.values().next() else {
        let (problem, remedy) = match range {
            Some(range) => (
                format!("it has no image of frames {} to {}, those that {scene_name} is evaluated on", range.start, range.end - 1),
                "Add these frames, or begin the names of the images with another scene to use all of them",
            ),
            None => ("no image is named <Scene>_undist_<frame>_<camera>.png".to_string(), "Check the path"),
        };
        return Err(Error::data(path.display().to_string(), problem, remedy));
    };
    let size = calibrated_size(&rows, image_size(first, limits)?.into());
    let mut scene = RawScene { name: file_name(path), ..Default::default() };
    if let Some(range) = range.filter(|_| images.len() < found) {
        let (more, last) = (found - images.len(), range.end - 1);
        let [are, were] = [plural(more, "image is", "images are"), plural(more, "was", "were")];
        scene.warnings.push(format!("{more} {are} outside of frames {} to {last}, on which {scene_name} is evaluated, and {were} skipped", range.start));
    }
    for (index, row) in rows.iter().enumerate() {
        let bad = |problem: String| Error::data(format!("{}: camera {index}", file.display()), problem, "Fetch the file again");
        scene.cameras.push(RawCamera {
            name: format!("cam{index:02}"),
            size,
            focal: [row[0]; 2],
            principal: [row[1], row[2]],
            distortion: Distortion::None,
            world_to_camera: from_quaternion([row[5], row[6], row[7], row[8]], [row[9], row[10], row[11]]).map_err(bad)?,
        });
    }
    for ((frame, camera), path) in images {
        if camera as usize >= rows.len() {
            return Err(Error::data(
                file.display().to_string(),
                format!("it has {} cameras, {} is of camera {camera}", rows.len(), path.display()),
                "Fetch the file again",
            ));
        }
        let split = if camera == TEST_CAMERA { Split::Test } else { Split::Train };
        let frame = frames.partition_point(|&f| f < frame);
        scene.views.push(RawView { camera: camera as usize, frame, time: None, split, image: ImageSource::file(path) });
    }
    scene.points = first_points(path, "cameras_parameters.txt", &scene.cameras, limits, &mut scene.warnings)?;
    if scene.views.iter().all(|view| view.split != Split::Test) {
        scene.warnings.push(format!("there is no image of camera {TEST_CAMERA}; nothing is held out"));
    }
    Ok(scene)
}

/// `Birthday_undist_00151_03.png` to ("Birthday", 151, 3).
fn parse_name(path: &Path) -> Option<(String, u32, u32)> {
    let stem = path.file_stem()?.to_str()?;
    let (name, rest) = stem.split_once("_undist_")?;
    let (frame, camera) = rest.split_once('_')?;
    Some((name.to_string(), frame.parse().ok()?, camera.parse().ok()?))
}

/// The size that `rows` are calibrated for: that of the dataset's images, or for a rig of its own that of the first image, whichever has its centre nearer
/// to the mean principal point.
fn calibrated_size(rows: &[Vec<f64>], first: [u32; 2]) -> [u32; 2] {
    let mean = [1, 2].map(|column| rows.iter().map(|row| row[column]).sum::<f64>() / rows.len() as f64);
    let distance = |size: [u32; 2]| (f64::from(size[0]) / 2.0 - mean[0]).hypot(f64::from(size[1]) / 2.0 - mean[1]);
    if distance(FULL_SIZE) < distance(first) { FULL_SIZE } else { first }
}

/// A header line, then 12 numbers a row: focal, cx, cy, two ignored, quaternion (w,x,y,z), translation; world to camera.
fn read_parameters(file: &Path, limits: &Limits) -> Result<Vec<Vec<f64>>> {
    let text = read_text(file, limits)?;
    let mut rows = Vec::new();
    for (number, line) in text.lines().enumerate().skip(1).filter(|(_, l)| !l.trim().is_empty()) {
        let bad = |problem: String| Error::data(format!("{}: line {}", file.display(), number + 1), problem, "Fetch the file again");
        let row: Vec<f64> = line.split_whitespace().map(|t| t.parse::<f64>().map_err(|_| bad(format!("{t:?} is not a number")))).collect::<Result<_>>()?;
        if row.len() < 12 {
            return Err(bad(format!("it has {} numbers, 12 are needed", row.len())));
        }
        rows.push(row);
    }
    if rows.is_empty() {
        return Err(Error::data(file.display().to_string(), "it lists no camera", "Fetch the file again"));
    }
    Ok(rows)
}
