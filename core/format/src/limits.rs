//! Limits on the sizes that readers accept from files.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::io::Read;
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
    /// The bytes of the file at `path`, which may have [`Limits::max_bytes`]: of a larger one nothing is read. Pipes and devices state no length; of them one
    /// byte more is read at most.
    ///
    /// # Errors
    /// [`Error::Limit`], [`Error::Io`].
    pub fn read_file(&self, path: &Path) -> Result<Vec<u8>> {
        let (object, failed) = (path.display().to_string(), |e| Error::io(path, e));
        let stated = std::fs::metadata(path).map_err(failed)?.len();
        self.check_bytes(&object, stated)?;
        let mut bytes = Vec::with_capacity(usize::try_from(stated).unwrap_or(0));
        std::fs::File::open(path).and_then(|file| file.take(self.max_bytes.saturating_add(1)).read_to_end(&mut bytes)).map_err(failed)?;
        self.check_bytes(&object, bytes.len() as u64)?;
        Ok(bytes)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_up_to_the_limit_are_read() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), [7; 100]).unwrap();
        let read = |max_bytes: u64| Limits { max_bytes, ..Limits::default() }.read_file(file.path());
        assert!(read(100).unwrap() == [7; 100] && read(u64::MAX).unwrap().len() == 100);
        assert!(matches!(read(99), Err(Error::Limit { value: 100, limit: 99, .. })));
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_that_states_no_length_is_held_to_the_limit() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let read = |max_bytes: u64| {
            let writer = std::thread::spawn({
                let pipe = pipe.clone();
                move || std::fs::write(pipe, [7; 100])
            });
            let found = Limits { max_bytes, ..Limits::default() }.read_file(&pipe);
            // The reader may have closed the pipe before all was written.
            writer.join().unwrap().ok();
            found
        };
        assert_eq!(read(100).unwrap(), [7; 100]);
        assert!(matches!(read(10), Err(Error::Limit { value: 11, limit: 10, .. })));
    }
}
