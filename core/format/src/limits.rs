//! Limits on the sizes that readers accept from files.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Upper bounds for readers of untrusted bytes. A reader checks a stated size against them before it allocates memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Largest decoded size of one object (a stream, the streams that are read together, an image, an array), in bytes.
    pub max_bytes: u64,
    /// Largest number of Gaussians (or points) of one model.
    pub max_gaussians: u64,
    /// Largest number of pixels of one image.
    pub max_pixels: u64,
    /// Largest nesting depth of a document.
    pub max_depth: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self { max_bytes: 4 << 30, max_gaussians: 20_000_000, max_pixels: 64 << 20, max_depth: 64 }
    }
}

impl Limits {
    /// Refuses an `object` of more than [`Limits::max_bytes`].
    ///
    /// # Errors
    /// [`Error::Limit`].
    pub fn check_bytes(&self, object: &str, bytes: u64) -> Result<()> {
        Self::check(object, bytes, self.max_bytes, "Raise limits.max_bytes if the file is trusted")
    }
    /// The bytes of the file at `path`, which may have [`Limits::max_bytes`]: of a larger one nothing is read.
    ///
    /// # Errors
    /// [`Error::Limit`], [`Error::Io`].
    pub fn read_file(&self, path: &Path) -> Result<Vec<u8>> {
        let failed = |e| Error::io(path, e);
        self.check_bytes(&path.display().to_string(), std::fs::metadata(path).map_err(failed)?.len())?;
        std::fs::read(path).map_err(failed)
    }
    /// Refuses an `object` of more than [`Limits::max_gaussians`].
    ///
    /// # Errors
    /// [`Error::Limit`].
    pub fn check_gaussians(&self, object: &str, count: u64) -> Result<()> {
        Self::check(object, count, self.max_gaussians, "Raise limits.max_gaussians if the file is trusted")
    }
    /// Refuses an image `object` of more than [`Limits::max_pixels`].
    ///
    /// # Errors
    /// [`Error::Limit`].
    pub fn check_pixels(&self, object: &str, width: u64, height: u64) -> Result<()> {
        Self::check(object, width.saturating_mul(height), self.max_pixels, "Raise limits.max_pixels if the image is trusted")
    }
    fn check(object: &str, value: u64, limit: u64, remedy: &str) -> Result<()> {
        if value > limit { Err(Error::limit(object, value, limit, remedy)) } else { Ok(()) }
    }
}
