//! Dataset readers: a path in, a [`Scene`] out.
//!
//! [`open`] asks each reader of one table whether a path is its kind. Readers only parse; what all scenes share (choosing frames and cameras,
//! resizing, undoing distortion, missing pictures, the cache) happens once, in `raw`.

mod blender;
mod camera_box;
mod colmap;
mod colmap_binary;
mod colmap_text;
pub mod distortion;
mod files;
pub mod init;
mod llff;
mod nerfstudio;
pub mod npy;
mod options;
mod panoptic;
mod picture;
mod pose;
pub mod procedural;
mod raw;
mod resample;
mod technicolor;
mod video;

pub use camera_box::camera_box;
pub use files::read_png_or_jpeg;
pub use options::{Background, CameraRef, SceneOptions};
pub use resample::resize;

use cc4dgs_core::{Error, Limits, Result, Scene, unknown_name};
use raw::RawScene;
use std::path::Path;

/// One dataset format.
trait Reader: Sync {
    /// The name in `scene.reader`.
    fn name(&self) -> &'static str;
    /// What [`Reader::probe`] looks for, for people.
    fn looks_for(&self) -> &'static str;
    /// Whether `path` looks like this format. Reads directory entries and at most the beginning of a file.
    fn probe(&self, path: &Path) -> bool;
    /// Parses the index files of `path`; no picture is decoded.
    fn open(&self, path: &Path, options: &SceneOptions, limits: &Limits) -> Result<RawScene>;
}

/// All readers, in the order in which they are asked: the more particular a format's mark, the earlier.
static READERS: [&dyn Reader; 6] = [&panoptic::Panoptic, &technicolor::Technicolor, &llff::Llff, &blender::Blender, &nerfstudio::Nerfstudio, &colmap::Colmap];

/// Name and description of every reader, in probing order, for help texts and tables.
pub fn readers() -> Vec<(&'static str, &'static str)> {
    READERS.iter().map(|r| (r.name(), r.looks_for())).collect()
}

/// Opens the scene at `path`; `procedural` and `procedural:NAME` open the built-in one. Frames are decoded later, on demand.
///
/// Errors: [`Error::Parameter`] for options and paths no reader understands, [`Error::Data`] for broken files, [`Error::Limit`] for claims over `limits`.
pub fn open(path: &Path, options: &SceneOptions, limits: &Limits) -> Result<Scene> {
    options.validate()?;
    if let Some(name) = procedural::name_of(path) {
        return procedural::open(name, options, limits);
    }
    if !path.exists() {
        return Err(Error::parameter(
            format!("scene {}", path.display()),
            "no such file or folder",
            "Check the path, or use `procedural` for the built-in scene",
        ));
    }
    let reader = choose(path, options)?;
    let raw = reader.open(path, options, limits)?;
    raw.assemble(options, limits)
}

fn choose(path: &Path, options: &SceneOptions) -> Result<&'static dyn Reader> {
    if options.reader != "auto" {
        let found = READERS.iter().find(|r| r.name() == options.reader);
        return found.copied().ok_or_else(|| unknown_name("scene.reader", &options.reader, READERS.iter().map(|r| r.name()).chain(["auto"])));
    }
    READERS.iter().find(|r| r.probe(path)).copied().ok_or_else(|| {
        let list: Vec<String> = READERS.iter().map(|r| format!("{} looks for {}", r.name(), r.looks_for())).collect();
        Error::parameter(
            format!("scene {}", path.display()),
            "no reader recognises it",
            format!("Known formats: {}. Name one with scene.reader", list.join("; ")),
        )
    })
}
