//! D-NeRF and Blender scenes: `transforms_train.json` and friends, RGBA images, times in 0..1. The images of a camera that stands still are its frames.
//! Points (`ply_file_path` of `transforms_train.json`) and recorded depth are read as in a `transforms.json`.

use super::fixed_cameras::{merge_fixed_cameras, warn_of_missing_times};
use super::intrinsics::{Intrinsics, camera};
use super::masks::warn_of_mask_paths;
use super::nerfstudio::{DEPTH_UNIT, depth_file, image_path, read_points, warn_of_missing_depth};
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
    ply_file_path: Option<String>,
    depth_unit_scale_factor: Option<f64>,
}

#[derive(Deserialize)]
struct Frame {
    #[serde(flatten)]
    own: Intrinsics,
    file_path: String,
    time: Option<f64>,
    transform_matrix: Vec<Vec<f64>>,
    mask_path: Option<IgnoredAny>,
    depth_file_path: Option<String>,
}

/// What the sides of the split have in common.
#[derive(Default)]
struct Seen {
    /// Of the views, in their order.
    times: Vec<Option<f64>>,
    /// Images with a mask.
    masked: usize,
    /// Images whose depth file does not exist.
    missing_depth: usize,
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
    let mut seen = Seen::default();
    read_split(path, "train", Split::Train, limits, &mut scene, &mut seen)?;
    let test = format!("transforms_{}.json", options.test_split);
    if path.join(&test).is_file() {
        read_split(path, &options.test_split, Split::Test, limits, &mut scene, &mut seen)?;
    } else {
        scene.warnings.push(format!("there is no {test}; nothing is held out"));
    }
    if options.test_split != VALIDATION && path.join(format!("transforms_{VALIDATION}.json")).is_file() {
        read_split(path, VALIDATION, Split::Validation, limits, &mut scene, &mut seen)?;
    }
    warn_of_mask_paths(seen.masked, &mut scene.warnings);
    warn_of_missing_depth(seen.missing_depth, &mut scene.warnings);
    warn_of_missing_times(&seen.times, &mut scene.warnings);
    scene.rank_times(&seen.times, &path.display().to_string())?;
    merge_fixed_cameras(&mut scene, &seen.times, true);
    scene.init_box = Some(InitBox::Cube { half_share: INIT_HALF_SHARE });
    // The published tables composite over white (4DGS, Swift4D); images without alpha stay as they are.
    scene.background = Some([1.0; 3]);
    Ok(scene)
}

/// Reads one side of the split. The points are those of the training images' file.
fn read_split(folder: &Path, name: &str, split: Split, limits: &Limits, scene: &mut RawScene, seen: &mut Seen) -> Result<()> {
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
            return Ok(());
        }
        return Err(Error::data(object, problem, "Check that the images lie beside the JSON"));
    };
    if split == Split::Train {
        read_points(&object, folder, transforms.ply_file_path.as_deref(), limits, scene);
    }
    let unit = transforms.depth_unit_scale_factor.unwrap_or(DEPTH_UNIT);
    for (frame, path) in transforms.frames.iter().zip(&paths) {
        let bad = |problem: String| Error::data(format!("{object}: frame {}", frame.file_path), problem, "Correct the JSON");
        // Files that other programs have split name the lens, too.
        let intrinsics = frame.own.over(&transforms.shared);
        // Missing images are left out later.
        let size = || image_size(if path.is_file() { path } else { present }, limits);
        scene.cameras.push(camera(&frame.file_path, &frame.transform_matrix, &intrinsics, &size, &bad)?);
        let depth = depth_file(folder, frame.depth_file_path.as_deref(), unit);
        seen.missing_depth += usize::from(frame.depth_file_path.is_some() && depth.is_none());
        seen.masked += usize::from(frame.mask_path.is_some());
        seen.times.push(frame.time);
        let image = ImageSource::File { path: path.clone(), mask: None, depth };
        scene.views.push(RawView { camera: scene.cameras.len() - 1, frame: 0, time: None, split, image });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::DepthFile;

    #[test]
    fn points_and_depth_are_those_that_the_files_name() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
        let frame = |name: &str, depth: &str| {
            format!(
                r#"{{"file_path": "{name}", "depth_file_path": "{depth}", "w": 8, "h": 6,
                    "transform_matrix": [[1, 0, 0, 7], [0, 1, 0, 8], [0, 0, 1, 9], [0, 0, 0, 1]]}}"#
            )
        };
        let document = |unit: &str, frames: [String; 2]| format!(r#"{{"fl_x": 8, {unit} "ply_file_path": "points.ply", "frames": [{}]}}"#, frames.join(","));
        write("transforms_train.json", &document(r#""depth_unit_scale_factor": 0.5,"#, [frame("a.png", "a-depth.png"), frame("b.png", "none.png")]));
        write("transforms_test.json", &document("", [frame("c.png", "a-depth.png"), frame("d.png", "a-depth.png")]));
        for name in ["a.png", "b.png", "c.png", "d.png", "a-depth.png"] {
            write(name, "");
        }
        let properties = "property float x\nproperty float y\nproperty float z\nproperty uint8 red\nproperty uint8 green\nproperty uint8 blue\n";
        write("points.ply", &format!("ply\nformat ascii 1.0\nelement vertex 1\n{properties}end_header\n7 8 5 255 0 51\n"));
        let read = || open(dir.path(), &SceneOptions::default(), &Limits::default()).unwrap();
        let scene = read();
        assert_eq!(scene.points.map(|points| points.positions), Some(vec![[7.0, 8.0, 5.0]]));
        let depths: Vec<Option<DepthFile>> = scene
            .views
            .iter()
            .map(|view| match &view.image {
                ImageSource::File { depth, .. } => depth.clone(),
                other => panic!("{other:?}"),
            })
            .collect();
        let depth = |unit: f64| Some(DepthFile { path: dir.path().join("a-depth.png"), unit });
        assert_eq!(depths, [depth(0.5), None, depth(DEPTH_UNIT), depth(DEPTH_UNIT)]);
        assert!(scene.warnings.iter().any(|said| said.starts_with("1 image has a depth_file_path that names no file")), "{:?}", scene.warnings);
        // Without its points the scene is still there.
        std::fs::remove_file(dir.path().join("points.ply")).unwrap();
        let scene = read();
        assert!(scene.points.is_none() && scene.warnings.iter().any(|said| said.contains("points.ply: there is no such file")), "{:?}", scene.warnings);
    }
}
