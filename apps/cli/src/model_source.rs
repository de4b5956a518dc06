//! Finding what a command works on: models and the scenes they are measured against.

use cc4dgs_core::{EventSink, Limits, Registry, Result, Scene, SceneOptions, auto_device, config, parse_device};
use cc4dgs_engine::data;
use cc4dgs_engine::model::Model;
use std::path::Path;

/// A model on a device.
pub struct Loaded {
    pub model: Model,
    pub device: burn::tensor::Device,
    pub device_name: String,
}

/// Loads a run's folder, a checkpoint or an archive.
pub fn load_model(path: &Path, device_name: &str, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<Loaded> {
    let device = parse_device(device_name)?;
    let model = Model::load(path, registry, &device, limits, events)?;
    Ok(Loaded { model, device, device_name: resolved_device(device_name)?.to_string() })
}

/// The device a name stands for: `auto` becomes the one it takes, others stay.
pub fn resolved_device(name: &str) -> Result<&str> {
    parse_device(name)?;
    Ok(if name == "auto" { auto_device().0 } else { name })
}

/// Opens the dataset at `path` as the model was trained on it, with `--set scene.key=value` laid over.
pub fn open_scene(path: &Path, model: &Model, sets: &[String], registry: &Registry, limits: &Limits) -> Result<Scene> {
    data::open_in(path, &scene_options(&model.provenance.config, sets)?, &model.normalisation, registry, limits)
}

fn scene_options(stored: &toml::Table, sets: &[String]) -> Result<SceneOptions> {
    let mut section = stored.get("scene").and_then(|s| s.as_table()).cloned().unwrap_or_default();
    // A model may come from anyone: what it says must not choose programs to run, folders to write or memory to take.
    for key in ["ffmpeg", "video_cache", "cache_mb"] {
        section.remove(key);
    }
    let mut table = toml::Table::from_iter([("scene".to_string(), toml::Value::Table(section))]);
    for assignment in sets {
        config::set(&mut table, assignment)?;
    }
    if let Some(other) = table.keys().find(|k| *k != "scene") {
        return Err(cc4dgs_core::Error::parameter(format!("--set {other}"), "only scene options can be changed here", "Write --set scene.key=value"));
    }
    match table.get("scene") {
        Some(toml::Value::Table(section)) => config::parse_section("scene", section),
        _ => Err(cc4dgs_core::Error::parameter("--set scene", "it is a section", "Write --set scene.key=value")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_options_hold_unless_they_could_do_harm() {
        let stored: toml::Table = "[scene]\nwidth = 400\nffmpeg = \"/tmp/evil\"\ncache_mb = 999999\n[train]\nanything = 1".parse().unwrap();
        let options = scene_options(&stored, &["scene.frames=[0,5,1]".into()]).unwrap();
        assert_eq!((options.width, options.frames), (400, Some([0, 5, 1])));
        assert_eq!((options.ffmpeg, options.cache_mb), (SceneOptions::default().ffmpeg, SceneOptions::default().cache_mb));
        assert_eq!(scene_options(&stored, &["scene.width=200".into()]).unwrap().width, 200);
        for bad in ["train.iterations=3", "scene=3", "scene.widht=3"] {
            assert!(scene_options(&stored, &[bad.into()]).is_err(), "{bad}");
        }
        assert_eq!(scene_options(&toml::Table::new(), &[]).unwrap(), SceneOptions::default());
    }
}
