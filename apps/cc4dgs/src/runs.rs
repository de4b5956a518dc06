//! The folder of a training run.

use cc4dgs_core::{Error, Result};
use cc4dgs_play::checkpoint::CHECKPOINT;
pub use cc4dgs_train::event_log::EVENTS;
use cc4dgs_train::train::{CONFIG, check_unused};
use std::path::Path;

/// What to do where the folder holds a run already.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Existing {
    /// Refuse to touch it.
    #[default]
    Refuse,
    /// Go on from its checkpoint.
    Resume,
    /// Replace it by a new run.
    Overwrite,
}

/// Refuses a folder with a run unless it may be overwritten, a folder without a checkpoint if a run is to be resumed, one that a training writes into, a file,
/// and a folder that cannot be written. `remedy` says what to do instead. Nothing is created.
///
/// # Errors
/// [`Error::Parameter`] that names the folder and what is found there; [`Error::Io`] for a folder that cannot be written.
pub fn check_folder(folder: &Path, existing: Existing, remedy: &str) -> Result<()> {
    let object = format!("run folder {}", folder.display());
    if folder.is_file() {
        return Err(Error::parameter(object, "it is a file", "Give another name"));
    }
    let refuse = |problem: String| Err(Error::parameter(object, problem, remedy));
    let found = [CHECKPOINT, EVENTS, CONFIG].into_iter().find(|name| folder.join(name).exists());
    match (existing, found) {
        (Existing::Refuse, Some(name)) => refuse(format!("it holds a run already ({name})")),
        // The checkpoint is what is looked for first.
        (Existing::Resume, found) if found != Some(CHECKPOINT) => refuse("nothing to resume, it has no checkpoint".into()),
        // Before the log of the run is opened.
        _ => check_unused(folder).and_then(|()| check_writable(folder)),
    }
}

/// Refuses a `folder` that cannot be written: a file without a name is created in the nearest one that exists, `folder` itself or one of those around it.
///
/// # Errors
/// [`Error::Io`] that names the folder that exists.
pub fn check_writable(folder: &Path) -> Result<()> {
    let there = folder.ancestors().find(|path| path.exists()).unwrap_or(Path::new("."));
    tempfile::tempfile_in(there).map(drop).map_err(|e| Error::io(there, e))
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
        let file = check_folder(&folder.path().join("notes.txt"), Existing::Overwrite, "Pass --overwrite").unwrap_err().to_string();
        assert!(file.contains("notes.txt: it is a file"), "{file}");
        // Unlike missing permissions, a file in place of a folder stops administrators, too.
        let below = check_folder(&folder.path().join("notes.txt/deep/run"), Existing::Refuse, "Pass --overwrite").unwrap_err();
        assert!(matches!(below, Error::Io { .. }) && below.to_string().contains("notes.txt: "), "{below}");
        check_folder(&folder.path().join("deep/run"), Existing::Refuse, "Pass --overwrite").unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is created");
        // A run that ended before its first checkpoint.
        std::fs::write(folder.path().join(CONFIG), "").unwrap();
        assert!(check(Existing::Refuse).is_err());
        let message = check(Existing::Resume).unwrap_err().to_string();
        assert!(message.contains("nothing to resume") && message.contains("--overwrite"), "{message}");
        std::fs::write(folder.path().join(CHECKPOINT), "x").unwrap();
        let message = check(Existing::Refuse).unwrap_err().to_string();
        assert!(message.contains("checkpoint") && message.contains("--overwrite"), "{message}");
        check(Existing::Resume).unwrap();
        check(Existing::Overwrite).unwrap();
    }
}
