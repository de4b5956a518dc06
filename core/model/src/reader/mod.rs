//! Readers: dataset formats as plug-ins.
//!
//! A reader parses the index files of a dataset into a [`RawScene`]: calibrated cameras, views, and where the image of each view comes from. Everything common
//! to all scenes (choosing frames and cameras, resizing, undoing lens distortion, the frame cache) happens afterwards, in the same code for every reader.
//!
//! ```
//! use cc4dgs_core::reader::{RawScene, ReaderPlugin, SceneOptions, files};
//! use cc4dgs_core::{Limits, Plugin, Result, inventory};
//! use std::path::Path;
//!
//! fn probe(path: &Path) -> bool {
//!     path.join("rig.txt").is_file()
//! }
//! fn open(path: &Path, _options: &SceneOptions, limits: &Limits) -> Result<RawScene> {
//!     let _text = files::read_text(&path.join("rig.txt"), limits)?;
//!     Ok(RawScene { name: files::file_name(path), ..RawScene::default() })
//! }
//! inventory::submit! {
//!     ReaderPlugin {
//!         info: Plugin { name: "rig", version: "1", summary: "my rig", paper: "", schema: "", capabilities: &[] },
//!         looks_for: "rig.txt",
//!         order: 1000,
//!         probe,
//!         open,
//!     }
//! }
//! ```
//!
//! [`files`] reads untrusted files, [`pose`] converts common conventions of camera poses. `conformance::reader` is the conformance suite of readers.

pub mod files;
mod lens;
mod options;
pub mod pose;
mod raw;

pub use lens::Distortion;
pub use options::{Background, CameraRef, SceneOptions, SyncMode};
pub use raw::{DepthFile, ImageSource, InitBox, RawCamera, RawPoints, RawScene, RawView, SAME_TIME};

use crate::{Limits, Plugin, Result, plugin_kind};
use std::path::Path;

/// A registered dataset format.
pub struct ReaderPlugin {
    /// Name, version and other facts; `info.name` is the value of `scene.reader`.
    pub info: Plugin,
    /// Description of what [`ReaderPlugin::probe`] looks for: `transforms.json (nerfstudio)`.
    pub looks_for: &'static str,
    /// Readers are probed in ascending order, equal ones by name. More specific formats get lower numbers; built-in readers use multiples of 100 up to 600.
    pub order: u32,
    /// Whether a path looks like this format. It reads directory entries and at most the beginning of a file, and never fails.
    pub probe: fn(&Path) -> bool,
    /// Parses the index files at a path. No image is decoded. The path need not exist for a reader that computes its scenes.
    ///
    /// # Errors
    /// [`crate::Error::Data`] for invalid files, [`crate::Error::Limit`] for sizes over the limits, [`crate::Error::Parameter`] for options that it does not
    /// support.
    pub open: fn(&Path, &SceneOptions, &Limits) -> Result<RawScene>,
}

plugin_kind!(ReaderPlugin, "reader");
