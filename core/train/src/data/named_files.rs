//! The files that the index of a dataset names, wherever these files are.

use super::colmap::image_files;
use super::nerfstudio::{file_named, image_path};
use cc4dgs_core::Limits;
use cc4dgs_core::reader::files::{file_name, has_extension, list, read_json};
use serde::Deserialize;
use std::path::{Path, PathBuf};

#[derive(Deserialize)]
struct Document {
    #[serde(default)]
    frames: Vec<Frame>,
    ply_file_path: Option<String>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    depth_file_path: Option<String>,
}

/// The files that exist of those that a `transforms.json` at `path`, others like it (`transforms_train.json`) and a COLMAP model there name: images, videos,
/// depth and points. An index that cannot be read names none: its reader says what is wrong with it.
pub(crate) fn named_files(path: &Path) -> Vec<PathBuf> {
    let is_json = |file: &Path| file.is_file() && has_extension(file, &["json"]);
    let documents = match path.is_dir() {
        true => list(path, |file| is_json(file) && file_name(file).starts_with("transforms")).unwrap_or_default(),
        false => Some(path.to_path_buf()).into_iter().filter(|file| is_json(file)).collect(),
    };
    let limits = Limits::default();
    let mut files = image_files(path, &limits);
    for file in documents {
        let Ok(document) = read_json::<Document>(&file, &limits) else { continue };
        let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        files.extend(document.frames.iter().map(|frame| image_path(folder, &frame.file_path)));
        files.extend(document.frames.iter().filter_map(|frame| frame.depth_file_path.as_ref()).map(|named| file_named(folder, named)));
        files.extend(document.ply_file_path.iter().map(|named| file_named(folder, named)));
    }
    files.retain(|file| file.is_file());
    files
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn depth_is_named_as_images_and_points_are() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene");
        std::fs::create_dir(&scene).unwrap();
        for name in ["a.png", "a-depth.png", "points.ply"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let frames = r#"[{"file_path": "../a", "depth_file_path": "../a-depth.png"}, {"file_path": "../b.png", "depth_file_path": "../b-depth.png"}]"#;
        std::fs::write(scene.join("transforms.json"), format!(r#"{{"ply_file_path": "../points.ply", "frames": {frames}}}"#)).unwrap();
        let names: Vec<String> = named_files(&scene).iter().map(|file| file_name(file)).collect();
        assert_eq!(names, ["a.png", "a-depth.png", "points.ply"]);
    }
}
