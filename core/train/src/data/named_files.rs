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
}

/// The files that exist of those that a `transforms.json` at `path`, others like it (`transforms_train.json`) and a COLMAP model there name: images, videos and
/// points. An index that cannot be read names none: its reader says what is wrong with it.
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
        files.extend(document.ply_file_path.iter().map(|named| file_named(folder, named)));
    }
    files.retain(|file| file.is_file());
    files
}
