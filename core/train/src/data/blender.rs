//! D-NeRF and Blender scenes: `transforms_train.json` and friends, RGBA images, times in 0..1. The images of a camera that stands still are its frames.

use super::fixed_cameras::{merge_fixed_cameras, warn_of_missing_times};
use super::intrinsics::{Intrinsics, camera};
use super::masks::warn_of_mask_paths;
use super::nerfstudio::image_path;
use cc4dgs_core::reader::files::{file_name, image_size, read_json};
use cc4dgs_core::{Error, ImageSource, InitBox, Limits, Plugin, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory};
use serde::Deserialize;
use serde::de::IgnoredAny;
use std::path::Path;

#[derive(Deserialize)]
struct Transforms {
    #[serde(flatten)]
    shared: Intrinsics,
    frames: Vec<Frame>,
}

#[derive(Deserialize)]
struct Frame {
    #[serde(flatten)]
    own: Intrinsics,
    file_path: String,
    time: Option<f64>,
    transform_matrix: Vec<Vec<f64>>,
    mask_path: Option<IgnoredAny>,
}

/// The name of the split to choose settings by.
const VALIDATION: &str = "val";
/// Half the side of the cube D-NeRF scenes are initialised in (Deformable 3D Gaussians, 4DGS: 1.3 units) over the distance of their cameras.
const INIT_HALF_SHARE: f64 = 1.3 / 4.0311;

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "blender",
            version: "1",
            summary: "D-NeRF and NeRF synthetic scenes",
            paper: "D-NeRF: Neural Radiance Fields for Dynamic Scenes (Pumarola et al. 2021)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "transforms_train.json (D-NeRF, NeRF synthetic)",
        order: 400,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    path.join("transforms_train.json").is_file()
}

fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let mut scene = RawScene { name: file_name(path), ..Default::default() };
    let mut times: Vec<Option<f64>> = Vec::new();
    let mut masked = read_split(path, "train", Split::Train, limits, &mut scene, &mut times)?;
    let test = format!("transforms_{}.json", options.test_split);
    if path.join(&test).is_file() {
        masked += read_split(path, &options.test_split, Split::Test, limits, &mut scene, &mut times)?;
    } else {
        scene.warnings.push(format!("there is no {test}; nothing is held out"));
    }
    if options.test_split != VALIDATION && path.join(format!("transforms_{VALIDATION}.json")).is_file() {
        masked += read_split(path, VALIDATION, Split::Validation, limits, &mut scene, &mut times)?;
    }
    warn_of_mask_paths(masked, &mut scene.warnings);
    warn_of_missing_times(&times, &mut scene.warnings);
    scene.rank_times(&times, &path.display().to_string())?;
    merge_fixed_cameras(&mut scene, &times, true);
    scene.init_box = Some(InitBox::Cube { half_share: INIT_HALF_SHARE });
    // The published tables composite over white (4DGS, Swift4D); images without alpha stay as they are.
    scene.background = Some([1.0; 3]);
    Ok(scene)
}

/// Reads one side of the split, and returns how many of its images have a mask.
fn read_split(folder: &Path, name: &str, split: Split, limits: &Limits, scene: &mut RawScene, times: &mut Vec<Option<f64>>) -> Result<usize> {
    let file = folder.join(format!("transforms_{name}.json"));
    let object = file.display().to_string();
    let transforms: Transforms = read_json(&file, limits)?;
    let paths: Vec<_> = transforms.frames.iter().map(|f| image_path(folder, &f.file_path)).collect();
    let Some(present) = paths.iter().find(|p| p.is_file()) else {
        let first = paths.first().map(|p| p.display().to_string()).unwrap_or_else(|| "any".into());
        let problem =
            if paths.len() == 1 { format!("its image does not exist ({first})") } else { format!("none of its {} images exist ({first})", paths.len()) };
        if split == Split::Validation {
            // Nothing depends on them, and copies of the dataset leave them out.
            scene.warnings.push(format!("{object}: {problem}; there are no validation views"));
            return Ok(0);
        }
        return Err(Error::data(object, problem, "Check that the images lie beside the JSON"));
    };
    for (frame, path) in transforms.frames.iter().zip(&paths) {
        let bad = |problem: String| Error::data(format!("{object}: frame {}", frame.file_path), problem, "Correct the JSON");
        // Files that other programs have split name the lens, too.
        let intrinsics = frame.own.over(&transforms.shared);
        // Missing images are left out later.
        let size = || image_size(if path.is_file() { path } else { present }, limits);
        scene.cameras.push(camera(&frame.file_path, &frame.transform_matrix, &intrinsics, &size, &bad)?);
        scene.views.push(RawView { camera: scene.cameras.len() - 1, frame: 0, time: None, split, image: ImageSource::file(path) });
        times.push(frame.time);
    }
    Ok(transforms.frames.iter().filter(|frame| frame.mask_path.is_some()).count())
}
