//! Opening a dataset as a model was trained on it.

use cc4dgs_core::{Error, Limits, Registry, Result, Scene, SceneOptions, config};
use cc4dgs_play::model::Model;
use cc4dgs_train::data;
use std::path::Path;

/// Keys of `[scene]` that a stored configuration must not set: programs to run, folders to write, memory to use.
const OURS_ALONE: [&str; 3] = ["ffmpeg", "video_cache", "cache_mb"];

/// Opens the dataset at `path` with the scene options that `model` was trained with, and `sets` (`scene.key=value`) laid over them. Other frames keep
/// the times that they have in the training.
///
/// # Errors
/// [`Error::Parameter`] for an assignment that is no scene option and frames outside of the time of training, and whatever the reader reports.
pub fn open_as_trained(path: &Path, model: &Model, sets: &[String], registry: &Registry, limits: &Limits) -> Result<Scene> {
    let stored = &model.provenance.config;
    let trained = data::Trained { normalisation: model.normalisation, frames: options_as_trained(stored, &[])?.frames };
    let scene = data::open_in(path, &options_as_trained(stored, sets)?, &trained, registry, limits)?;
    let count = stored.get("train").and_then(|t| t.get("validation")).and_then(toml::Value::as_integer).unwrap_or(0);
    // Another scene may be too small for it; it then has no validation views.
    Ok(data::hold_out(&scene, usize::try_from(count).unwrap_or(0)).unwrap_or(scene))
}

/// The scene options of a stored configuration, with `sets` (`scene.key=value`) laid over them. Models may come from untrusted sources: their configuration
/// never chooses programs to run, folders to write or memory to take.
///
/// # Errors
/// [`Error::Parameter`] for an assignment that is no scene option, and for stored options of another version.
pub fn options_as_trained(stored: &toml::Table, sets: &[String]) -> Result<SceneOptions> {
    let mut section = stored.get("scene").and_then(|s| s.as_table()).cloned().unwrap_or_default();
    for key in OURS_ALONE {
        section.remove(key);
    }
    let mut table = toml::Table::from_iter([("scene".to_string(), toml::Value::Table(section))]);
    config::set_all(&mut table, sets)?;
    if let Some(other) = table.keys().find(|k| *k != "scene") {
        return Err(Error::parameter(format!("--set {other}"), "only scene options can be changed here", "Write --set scene.key=value"));
    }
    match table.get("scene") {
        Some(toml::Value::Table(section)) => config::parse_section("scene", section),
        _ => Err(Error::parameter("--set scene", "it is a section", "Write --set scene.key=value")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_options_hold_unless_they_could_do_harm() {
        let stored: toml::Table = "[scene]\nwidth = 400\nffmpeg = \"/tmp/evil\"\ncache_mb = 999999\n[train]\nanything = 1".parse().unwrap();
        let options = options_as_trained(&stored, &["scene.frames=[0,5,1]".into()]).unwrap();
        assert_eq!((options.width, options.frames), (400, Some([0, 5, 1])));
        assert_eq!((options.ffmpeg, options.cache_mb), (SceneOptions::default().ffmpeg, SceneOptions::default().cache_mb));
        assert_eq!(options_as_trained(&stored, &["scene.width=200".into()]).unwrap().width, 200);
        for bad in ["train.iterations=3", "scene=3", "scene.widht=3"] {
            assert!(options_as_trained(&stored, &[bad.into()]).is_err(), "{bad}");
        }
        assert_eq!(options_as_trained(&toml::Table::new(), &[]).unwrap(), SceneOptions::default());
    }
}
