//! The folder of a run: its settings, and the checkpoint that it goes on from.

use super::{Parts, TrainJob, TrainState};
use crate::checkpoint;
use crate::config::RunConfig;
use burn::tensor::Device;
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Result};
use cc4dgs_play::checkpoint::CHECKPOINT;
use std::path::Path;

/// Name of the configuration inside a run's folder.
pub const CONFIG: &str = "config.toml";

/// Writes the settings into the run's folder, where there is one. The checkpoint of a run that is overwritten goes: it has other settings.
pub(super) fn write_config(job: &TrainJob) -> Result<()> {
    let Some(out) = &job.out else { return Ok(()) };
    std::fs::create_dir_all(out).map_err(|e| Error::io(out, e))?;
    let old = out.join(CHECKPOINT);
    if !job.resume && old.exists() {
        std::fs::remove_file(&old).map_err(|e| Error::io(&old, e))?;
    }
    write_settings(out, job.config)
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
    write_config(job)?;
    Ok(state)
}
