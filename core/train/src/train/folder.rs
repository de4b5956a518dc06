//! The folder of a run: who writes into it, its settings, and the checkpoint that it goes on from.

use super::{Parts, TrainJob, TrainState};
use crate::checkpoint;
use crate::config::RunConfig;
use burn::tensor::Device;
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Result};
use cc4dgs_play::checkpoint::CHECKPOINT;
use std::fs::{File, TryLockError};
use std::path::Path;

/// Name of the configuration inside a run's folder.
pub const CONFIG: &str = "config.toml";

/// The lock of a run's folder, until it is dropped. It is one of the operating system on the folder itself, so that it ends with the process that holds it.
pub(super) struct FolderLock(File);

impl FolderLock {
    /// Takes the lock of the folder `out`. `None` where there is no such folder, and on systems that do not lock folders.
    ///
    /// # Errors
    /// [`Error::Parameter`] where another training has it.
    pub(super) fn take(out: &Path) -> Result<Option<Self>> {
        let Ok(folder) = File::open(out) else { return Ok(None) };
        match folder.try_lock() {
            Ok(()) => Ok(Some(Self(folder))),
            Err(TryLockError::WouldBlock) => Err(Error::parameter(
                format!("run folder {}", out.display()),
                "another training writes into it",
                "Wait until it ends, or choose another folder",
            )),
            Err(TryLockError::Error(_)) => Ok(None),
        }
    }
}

impl Drop for FolderLock {
    fn drop(&mut self) {
        // Closing the file is not enough while a child process that is just starting has it, too.
        self.0.unlock().ok();
    }
}

/// Refuses the folder `out` while a training writes into it. Nothing is created.
///
/// # Errors
/// [`Error::Parameter`] that names the folder.
pub fn check_unused(out: &Path) -> Result<()> {
    FolderLock::take(out).map(drop)
}

/// Begins a run in the folder `out`, which is created if missing, and takes its `lock` unless that was done. The checkpoint of a run that is overwritten goes,
/// because it has other settings, but not before the settings of the new run are written: a full disk leaves the run before.
///
/// # Errors
/// As [`FolderLock::take`], and [`Error::Io`].
pub(super) fn begin(out: &Path, config: &RunConfig, lock: &mut Option<FolderLock>) -> Result<()> {
    std::fs::create_dir_all(out).map_err(|e| Error::io(out, e))?;
    if lock.is_none() {
        *lock = FolderLock::take(out)?;
    }
    write_settings(out, config)?;
    let old = out.join(CHECKPOINT);
    if old.exists() {
        std::fs::remove_file(&old).map_err(|e| Error::io(&old, e))?;
    }
    Ok(())
}

/// Writes settings into the folder `out`, which exists.
pub(super) fn write_settings(out: &Path, config: &RunConfig) -> Result<()> {
    write_atomically(out.join(CONFIG), config.to_toml()?.as_bytes())
}

/// The state that the checkpoint at `path` holds. A continuation that is refused leaves the settings of the run as they were.
///
/// # Errors
/// [`Error::Parameter`] for a checkpoint of another scene, and whatever reading it reports.
pub(super) fn resumed(job: &TrainJob, path: &Path, device: &Device, parts: Parts) -> Result<TrainState> {
    let stored = checkpoint::load(path, job.registry, device, job.config.limits_here())?;
    let (now, then) = (job.scene.normalisation, stored.normalisation());
    if now != then {
        return Err(Error::parameter(
            "--resume",
            format!("the scene is normalised with {now}, that of the checkpoint with {then}"),
            "Resume on the dataset the run was started on, or start in another folder",
        ));
    }
    let state = stored.into_state(job.config, job.registry, parts)?;
    if let Some(out) = &job.out {
        write_settings(out, job.config)?;
    }
    Ok(state)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_cannot_begin_leaves_the_one_before() {
        let (folder, config) = (tempfile::tempdir().unwrap(), RunConfig::resolve(Some("demo"), None, &[]).unwrap());
        let (checkpoint, settings) = (folder.path().join(CHECKPOINT), folder.path().join(CONFIG));
        std::fs::write(&checkpoint, "of the run before").unwrap();
        // As on a full disk, the settings cannot be written: a folder has their name.
        std::fs::create_dir(&settings).unwrap();
        assert!(begin(folder.path(), &config, &mut None).is_err());
        assert_eq!(std::fs::read_to_string(&checkpoint).unwrap(), "of the run before");
        std::fs::remove_dir(&settings).unwrap();
        begin(folder.path(), &config, &mut None).unwrap();
        assert!(settings.is_file() && !checkpoint.exists());
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn one_training_at_a_time_writes_into_a_folder() {
        let (folder, config) = (tempfile::tempdir().unwrap(), RunConfig::resolve(Some("demo"), None, &[]).unwrap());
        let out = folder.path().join("run");
        // Both found no folder when they started.
        let (mut first, mut second) = (FolderLock::take(&out).unwrap(), FolderLock::take(&out).unwrap());
        assert!(first.is_none() && second.is_none() && !out.exists());
        begin(&out, &config, &mut first).unwrap();
        std::fs::write(out.join(CHECKPOINT), "of the first").unwrap();
        let refused = begin(&out, &config, &mut second).unwrap_err().to_string();
        assert!(refused.contains("run: another training writes into it"), "{refused}");
        assert!(check_unused(&out).is_err() && out.join(CHECKPOINT).exists());
        drop(first);
        check_unused(&out).unwrap();
        begin(&out, &config, &mut second).unwrap();
        assert!(second.is_some() && check_unused(&out).is_err());
    }
}
