//! The folder of a training run.

use cc4dgs_core::{Error, Result};
use cc4dgs_play::checkpoint::CHECKPOINT;
pub use cc4dgs_train::event_log::EVENTS;
use cc4dgs_train::train::CONFIG;
use std::path::Path;

/// What to do where the folder holds a run already.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Existing {
    /// Refuse to touch it.
    #[default]
    Refuse,
    /// Go on from its checkpoint.
    Resume,
    /// Start anew in its place.
    Overwrite,
}

/// Refuses a folder that holds a run which would be overwritten unasked. `remedy` says how to ask.
///
/// # Errors
/// [`Error::Parameter`] that names the folder and the file found there.
pub fn check_folder(folder: &Path, existing: Existing, remedy: &str) -> Result<()> {
    let found = [CHECKPOINT, EVENTS, CONFIG].into_iter().find(|name| folder.join(name).exists());
    match found {
        Some(name) if existing == Existing::Refuse => {
            Err(Error::parameter(format!("run folder {}", folder.display()), format!("it holds a run already ({name})"), remedy))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_not_overwritten_unasked() {
        let folder = tempfile::tempdir().unwrap();
        let check = |existing| check_folder(folder.path(), existing, "Pass --overwrite");
        check(Existing::Refuse).unwrap();
        std::fs::write(folder.path().join("notes.txt"), "mine").unwrap();
        check(Existing::Refuse).unwrap();
        std::fs::write(folder.path().join(CHECKPOINT), "x").unwrap();
        let message = check(Existing::Refuse).unwrap_err().to_string();
        assert!(message.contains("checkpoint") && message.contains("--overwrite"), "{message}");
        check(Existing::Resume).unwrap();
        check(Existing::Overwrite).unwrap();
    }
}
