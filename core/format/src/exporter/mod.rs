//! The exporter trait: a model in the file formats of other programs.
//!
//! An exporter reads Gaussians, or rendered images, from an [`ExportSource`] and writes one file or one folder. [`export`] runs it on a temporary name and
//! renames the result, so that an exporter need not care about interrupted or failed writes.

mod target;

#[cfg(not(target_arch = "wasm32"))]
pub use target::{check_target, export, refuse_existing, refuse_other_content};

use crate::playback::MaxError;
use crate::plugin::Plugin;
use crate::{BLUR, Camera, HostGaussians, Image8, Result};
use serde::Serialize;
use std::path::Path;

/// What an exporter writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExportTarget {
    /// One file, whose name ends in this extension (without a dot).
    File(&'static str),
    /// A folder of files, each with one of these names; `*.ply` stands for every name that ends so.
    Folder(&'static [&'static str]),
    /// One file where the name ends in the extension `file`, else a folder of files, as [`ExportTarget::Folder`] names them.
    FileOrFolder {
        /// Extension of the file.
        file: &'static str,
        /// Names of the files in the folder.
        folder: &'static [&'static str],
    },
}

impl ExportTarget {
    /// Whether `path` names a file or a folder: [`ExportTarget::File`] or [`ExportTarget::Folder`].
    pub fn at(self, path: &Path) -> Self {
        match self {
            Self::FileOrFolder { file, .. } if path.extension().is_some_and(|e| e.eq_ignore_ascii_case(file)) => Self::File(file),
            Self::FileOrFolder { folder, .. } => Self::Folder(folder),
            other => other,
        }
    }
}

/// What an exporter may know before it asks for any Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub struct ExportFacts {
    /// Name of the model, fit for file names.
    pub name: String,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// How many of them move. They come first in [`ExportSource::gaussians`] at a time.
    pub moving: usize,
    /// Spherical-harmonics degree, 0 to 4.
    pub sh_degree: usize,
    /// The instant that formats without motion hold, 0..1; `None` is the canonical model.
    pub time_norm: Option<f32>,
    /// Normalised times of the frames that formats with motion hold; at least one.
    pub times_norm: Vec<f32>,
    /// Frames per second.
    pub frames_per_second: f64,
    /// Whether the model wants Mip-Splatting's 2D filter.
    pub antialiased: bool,
    /// What a pixel adds to both diagonal entries of the projected covariance, square pixels; viewers take [`BLUR`] unless told.
    pub blur: f64,
    /// The signed unit axis of the world that points up.
    pub up: [f64; 3],
    /// A camera to look at the model from.
    pub home: Option<Camera>,
    /// Images that [`ExportSource::image`] can render; 0 where it cannot.
    pub images: usize,
}

impl ExportFacts {
    /// What a format loses that cannot tell viewers the blur, if they would take another one.
    pub fn lost_blur(&self) -> Option<String> {
        (self.blur != BLUR).then(|| format!("the blur of {} square pixels (viewers take {BLUR})", self.blur))
    }
    /// What a format loses that holds one instant without motion, as the beginning of a sentence without a full stop.
    pub fn still(&self) -> String {
        let what = self.time_norm.map_or_else(|| "the canonical Gaussians".to_string(), |t| format!("the Gaussians at time {t}"));
        if self.moving == 0 { format!("It holds {what}") } else { format!("It holds {what}; the motion of {} of {} is lost", self.moving, self.gaussians) }
    }
}

/// Where an exporter takes a model from. Gaussians are in the coordinates of the dataset.
pub trait ExportSource {
    /// What is known of the model and of the request.
    fn facts(&self) -> &ExportFacts;
    /// The Gaussians at a time in 0..1, or the canonical ones. At a time the moving ones come first, and the order is the same for every time.
    ///
    /// # Errors
    /// What the deformer and the device report.
    fn gaussians(&mut self, time_norm: Option<f32>) -> Result<HostGaussians>;
    /// The image `index` of [`ExportFacts::images`], RGB.
    ///
    /// # Errors
    /// What the renderer reports; [`Error::Unsupported`](crate::Error::Unsupported) where there is none.
    fn image(&mut self, index: usize) -> Result<Image8>;
    /// The model as the bytes of an archive that players without burn play, in the coordinates of the model: with the deformer's weights where its motion can
    /// be computed from them ([`PlaybackLayer::computed`](crate::playback::PlaybackLayer::computed)) and `baked` does not ask for a layer; else with a layer in
    /// which points are off by at most `max_error`.
    ///
    /// # Errors
    /// What baking reports; [`Error::Unsupported`](crate::Error::Unsupported) where the source cannot bake.
    fn playable(&mut self, max_error: MaxError, baked: bool) -> Result<Vec<u8>>;
    /// Reports `done` of `total` pieces of work.
    ///
    /// # Errors
    /// [`Error::Interrupted`](crate::Error::Interrupted) where the user wants to stop.
    fn progress(&mut self, done: usize, total: usize) -> Result<()>;
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Exported {
    /// Gaussians per file; 0 for images.
    pub gaussians: usize,
    /// Spherical-harmonics degree that was kept.
    pub sh_degree: usize,
    /// Frames.
    pub frames: usize,
    /// Sentences about what was measured or left out while writing.
    pub notes: Vec<String>,
}

/// A file format of other programs.
pub trait Exporter: Send + Sync {
    /// What the format cannot carry of this model, in one sentence.
    fn loses(&self, facts: &ExportFacts) -> String;
    /// Writes the file `path`, or files into the existing empty folder `path`. Equal Gaussians and settings give equal bytes.
    ///
    /// # Errors
    /// [`Error::Data`](crate::Error::Data) and [`Error::Limit`](crate::Error::Limit) for models that the format cannot hold, [`Error::Io`](crate::Error::Io),
    /// and those of the source.
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported>;
}

/// An exporter in the registry.
pub struct ExporterPlugin {
    /// Name, version and other facts. The version is that of the format.
    pub info: Plugin,
    /// What it writes.
    pub target: ExportTarget,
    /// Builds it from its settings.
    pub build: fn(&toml::Table) -> Result<Box<dyn Exporter>>,
}
crate::plugin_kind!(ExporterPlugin, "exporter");
