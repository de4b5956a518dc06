//! What a file holds, by its first bytes: the one place that tells models apart.

use crate::checkpoint::CHECKPOINT;
use cc4dgs_core::archive::MAGIC;
use cc4dgs_core::spz::begins_as_spz;
use cc4dgs_core::{Error, Result};
use serde::Serialize;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

/// Bytes that tell all kinds apart.
const HEAD_BYTES: u64 = 9;

/// What a model may be, as the remedy of an error.
const REMEDY: &str = "Give the folder of a run, a checkpoint, a .cc4d archive, a PLY file of 3D Gaussian splatting or an SPZ file";

/// What a model is stored as.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SourceKind {
    /// A checkpoint of this program, or the folder of a run, which holds one.
    Checkpoint,
    /// A `.cc4d` archive.
    Archive,
    /// A PLY file in the layout of 3D Gaussian splatting: static Gaussians.
    Ply,
    /// Niantic's SPZ: static Gaussians.
    Spz,
}

impl SourceKind {
    /// The kind of a file that begins with `head`; `None` if no model begins so.
    pub fn of_bytes(head: &[u8]) -> Option<Self> {
        // A checkpoint is a safetensors file: the length of its JSON header in eight bytes, of which the upper four are zero, then the header.
        let safetensors = head.len() > 8 && head[4..8] == [0; 4] && head[8] == b'{';
        if head.starts_with(&MAGIC) {
            Some(Self::Archive)
        } else if head.starts_with(b"ply\n") || head.starts_with(b"ply\r") {
            Some(Self::Ply)
        } else if begins_as_spz(head) {
            Some(Self::Spz)
        } else {
            safetensors.then_some(Self::Checkpoint)
        }
    }
}

/// A model's file and what it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Source {
    /// What it is.
    pub kind: SourceKind,
    /// The file; for the folder of a run, its checkpoint.
    pub file: PathBuf,
}

impl Source {
    /// What lies at `path`: the folder of a run, or a file. `None` for everything that is no model, such as a dataset.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a path that does not exist, [`Error::Io`] for one that cannot be read.
    pub fn find(path: &Path) -> Result<Option<Self>> {
        let file = if path.is_dir() { path.join(CHECKPOINT) } else { path.to_path_buf() };
        if path.is_dir() && !file.is_file() {
            return Ok(None);
        }
        let mut head = Vec::new();
        std::fs::File::open(&file).and_then(|f| f.take(HEAD_BYTES).read_to_end(&mut head)).map_err(|e| match e.kind() {
            ErrorKind::NotFound => Error::parameter(format!("model {}", path.display()), "no such file or folder", REMEDY),
            _ => Error::io(&file, e),
        })?;
        Ok(SourceKind::of_bytes(&head).map(|kind| Self { kind, file }))
    }
    /// As [`Source::find`], where a model must be.
    ///
    /// # Errors
    /// As [`Source::find`], and [`Error::Data`] for a path that holds no model.
    pub fn expect(path: &Path) -> Result<Self> {
        let problem = if path.is_dir() { "the folder holds no checkpoint" } else { "it begins like no model" };
        Self::find(path)?.ok_or_else(|| Error::data(path.display().to_string(), problem, REMEDY))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_bytes_decide() {
        let of = |bytes: &[u8]| SourceKind::of_bytes(bytes);
        assert_eq!(of(b"\x89CC4D\r\n\x1a\x01"), Some(SourceKind::Archive));
        assert_eq!(of(b"ply\nformat binary_little_endian 1.0"), Some(SourceKind::Ply));
        assert_eq!(of(b"ply\r\nforma"), Some(SourceKind::Ply));
        assert_eq!(of(b"\x1f\x8b\x08\0\0\0\0\0\x02"), Some(SourceKind::Spz));
        assert_eq!(of(b"NGSP\x04\0\0\0\x01"), Some(SourceKind::Spz));
        assert_eq!(of(b"\x10\x02\0\0\0\0\0\0{"), Some(SourceKind::Checkpoint));
        for other in [&b""[..], b"ply", b"{\"frames\":", b"\x89PNG\r\n\x1a\n\0", b"\x10\x02\0\0\0\0\0\0", b"\x10\x02\0\0\0\0\x01\0{"] {
            assert_eq!(of(other), None, "{other:?}");
        }
    }

    #[test]
    fn folders_are_runs_if_they_hold_a_checkpoint() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(Source::find(folder.path()).unwrap(), None);
        assert!(Source::expect(folder.path()).unwrap_err().to_string().contains("no checkpoint"));
        let missing = Source::find(&folder.path().join("missing")).unwrap_err();
        assert!(matches!(missing, Error::Parameter { .. }) && missing.to_string().contains("SPZ"), "{missing}");
        let file = folder.path().join(CHECKPOINT);
        std::fs::write(&file, b"\x10\x02\0\0\0\0\0\0{").unwrap();
        assert_eq!(Source::find(folder.path()).unwrap(), Some(Source { kind: SourceKind::Checkpoint, file }));
    }
}
