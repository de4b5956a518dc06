//! Datasets: a path in, a [`Scene`] out.
//!
//! [`open`] asks each registered reader whether a path is its kind. Readers only parse; what all scenes share (choosing frames and cameras, resizing,
//! undoing distortion, missing images, the cache) happens once, in [`assemble`].

mod align;
mod assemble;
mod blender;
mod camera_box;
mod colmap;
mod colmap_binary;
mod colmap_camera;
mod colmap_text;
mod colmap_videos;
mod dense_clouds;
mod fixed_cameras;
mod focus;
mod frames;
mod hold_out;
pub mod init;
mod instants;
mod intrinsics;
mod llff;
mod masks;
mod named_files;
mod nerfstudio;
mod normalise;
pub mod npy;
mod panoptic;
mod ply_points;
pub mod procedural;
pub(crate) mod resample;
mod select;
mod sync;
mod technicolor;
mod undistort;
mod video;

pub use assemble::assemble;
pub use camera_box::camera_box;
pub(crate) use colmap::project_folder;
pub use hold_out::hold_out;
pub(crate) use named_files::named_files;
pub use resample::resize;
pub use undistort::Undistort;
pub use video::{answers_interrupts, end_commands};

use cc4dgs_core::{Error, Limits, RawScene, ReaderPlugin, Registry, Result, Scene, SceneOptions, Similarity};
use std::path::Path;

/// Opens the scene at `path` with the registered reader that recognises it, or the one `options` name. Frames are decoded later, on demand.
///
/// Errors: [`Error::Parameter`] for options and paths no reader understands, [`Error::Data`] for broken files, [`Error::Limit`] for claims over `limits`.
pub fn open(path: &Path, options: &SceneOptions, registry: &Registry, limits: &Limits) -> Result<Scene> {
    assemble(read(path, options, registry, limits)?, options, None, limits)
}

/// What a model knows of the scene that it was trained on.
#[derive(Clone, Copy, Debug)]
pub struct Trained {
    /// From the coordinates of the dataset to those of the model.
    pub normalisation: Similarity,
    /// The option `frames` of its training: the first of these frames is at time 0, the last at time 1.
    pub frames: Option<[usize; 3]>,
}

/// Opens the scene at `path` in the coordinates and on the clock of a model that was trained on it: other frames or cameras of a dataset would be given their
/// own.
///
/// Errors: as [`open`]; [`Error::Parameter`] for frames before the first or after the last one of the training, [`Error::Data`] for a model that states a
/// stride of 0.
pub fn open_in(path: &Path, options: &SceneOptions, trained: &Trained, registry: &Registry, limits: &Limits) -> Result<Scene> {
    // Options are checked, but those of the model may be others, and come from a file.
    if let Some([first, count, 0]) = trained.frames {
        let problem = format!("it states scene.frames = [{first}, {count}, 0], and a stride is 1 or more");
        return Err(Error::data("the configuration of the model", problem, "The file is damaged; fetch or write it again"));
    }
    // A built-in scene shows all of its time in any number of frames.
    let samples = |frames: &[usize; 3]| procedural::name_of(path).is_some() && matches!(frames, [0, count, 1] if *count > 0);
    let trained = Trained { frames: trained.frames.filter(|frames| !samples(frames)), ..*trained };
    assemble(read(path, options, registry, limits)?, options, Some(&trained), limits)
}

fn read(path: &Path, options: &SceneOptions, registry: &Registry, limits: &Limits) -> Result<RawScene> {
    options.validate()?;
    (choose(path, options, registry)?.open)(path, options, limits)
}

fn choose(path: &Path, options: &SceneOptions, registry: &Registry) -> Result<&'static ReaderPlugin> {
    let readers = registry.readers();
    let named = if options.reader == "auto" { None } else { Some(registry.reader(&options.reader)?) };
    let found = named.or_else(|| readers.iter().copied().find(|r| (r.probe)(path)));
    // A reader may compute its scene from a path that is only a name.
    match found {
        Some(reader) if path.exists() || (reader.probe)(path) => Ok(reader),
        _ if !path.exists() => {
            Err(Error::parameter(format!("scene {}", path.display()), "no such file or folder", "Check the path, or use `procedural` for the built-in scene"))
        }
        _ => {
            let list: Vec<String> = readers.iter().map(|r| format!("{} looks for {}", r.info.name, r.looks_for)).collect();
            Err(Error::parameter(
                format!("scene {}", path.display()),
                "no reader recognises it",
                format!("Known formats: {}. Name one with scene.reader", list.join("; ")),
            ))
        }
    }
}
