//! How much a reader may believe of what a file claims.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Caps for everything that reads bytes from outside. A reader checks a claimed size here before it allocates for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// The most bytes one object (a stream, an image, an array) may take once decoded.
    pub max_bytes: u64,
    /// The most Gaussians (or points) one model may hold.
    pub max_gaussians: u64,
    /// The most pixels one image may have.
    pub max_pixels: u64,
    /// The most nested levels of a document.
    pub max_depth: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self { max_bytes: 4 << 30, max_gaussians: 20_000_000, max_pixels: 64 << 20, max_depth: 64 }
    }
}

impl Limits {
    /// Refuses `bytes` claimed by `object` when they are over [`Limits::max_bytes`].
    pub fn check_bytes(&self, object: &str, bytes: u64) -> Result<()> {
        Self::check(object, bytes, self.max_bytes, "Raise limits.max_bytes if the file is trusted")
    }
    /// Refuses `count` Gaussians claimed by `object` when they are over [`Limits::max_gaussians`].
    pub fn check_gaussians(&self, object: &str, count: u64) -> Result<()> {
        Self::check(object, count, self.max_gaussians, "Raise limits.max_gaussians if the file is trusted")
    }
    /// Refuses a `width` x `height` image claimed by `object` when it is over [`Limits::max_pixels`].
    pub fn check_pixels(&self, object: &str, width: u64, height: u64) -> Result<()> {
        Self::check(object, width.saturating_mul(height), self.max_pixels, "Raise limits.max_pixels if the image is trusted")
    }
    fn check(object: &str, value: u64, limit: u64, remedy: &str) -> Result<()> {
        if value > limit { Err(Error::limit(object, value, limit, remedy)) } else { Ok(()) }
    }
}
