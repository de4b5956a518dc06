//! The layers of a configuration: preset, TOML file, overrides.

use crate::auto::PRESET as AUTO;
use crate::config::RunConfig;
use cc4dgs_core::{Error, Registry, Result, config};
use std::path::Path;

/// What a user said of a run, as one table; what was not said is absent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layers {
    /// All layers.
    table: toml::Table,
    /// The file over the preset, and the overrides over both.
    file: toml::Table,
    sets: Vec<String>,
}

impl Layers {
    /// Layers a preset, a TOML file and `key=value` overrides, in that order. Without `preset`, or with an empty one, the preset that the file names; else that
    /// name has no effect.
    ///
    /// # Errors
    /// [`Error::Parameter`] for unknown presets, text that is not TOML, a preset among the overrides and keys of earlier versions; [`Error::Io`] for the file.
    pub fn collect(registry: &Registry, preset: Option<&str>, file: Option<&Path>, sets: &[String]) -> Result<Self> {
        let mut from_file = match file {
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
                config::parse_table(&path.display().to_string(), &text)?
            }
            None => toml::Table::new(),
        };
        let named = from_file.get("preset").and_then(|p| p.as_str()).filter(|p| !p.is_empty()).map(str::to_string);
        let stated = preset.filter(|p| !p.is_empty()).map(str::to_string);
        if stated.is_some() {
            // Its name would take the place of the stated one, and decide whether there is a plan to make.
            from_file.remove("preset");
        }
        let preset = match stated.or(named) {
            Some(name) => registry.preset(&name)?,
            None => toml::Table::new(),
        };
        Self::of(preset, from_file, sets.to_vec())
    }
    fn of(preset: toml::Table, file: toml::Table, sets: Vec<String>) -> Result<Self> {
        let mut table = preset;
        config::merge(&mut table, &file);
        refuse_preset(&sets)?;
        config::set_all(&mut table, &sets)?;
        refuse_renamed(&table)?;
        Ok(Self { table, file, sets })
    }
    /// These layers where a graphics card computes: with the sizes that the preset's method, if any, has for `dataset`. Stated settings stay.
    ///
    /// # Errors
    /// As [`Layers::collect`].
    pub fn at_full_size(&self, registry: &Registry, dataset: &str) -> Result<Self> {
        let name = self.table.get("preset").and_then(|p| p.as_str()).unwrap_or_default();
        Self::of(registry.preset_at_full_size(name, dataset)?, self.file.clone(), self.sets.clone())
    }
    /// These layers with further overrides over them.
    ///
    /// # Errors
    /// [`Error::Parameter`] for text that is not `key=value`, and for a preset.
    pub fn with(&self, sets: &[String]) -> Result<Self> {
        refuse_preset(sets)?;
        let mut layers = self.clone();
        config::set_all(&mut layers.table, sets)?;
        layers.sets.extend_from_slice(sets);
        Ok(layers)
    }
    /// The configuration they make, read strictly; what they do not say has its default.
    ///
    /// # Errors
    /// [`Error::Parameter`] for unknown keys and values out of range.
    pub fn config(&self) -> Result<RunConfig> {
        let resolved: RunConfig = config::parse_section("configuration", &self.table)?;
        resolved.validate()?;
        match not_finite(&self.table) {
            // Checkpoints state numbers as JSON, which has neither.
            Some((key, value)) => {
                Err(Error::parameter(key, format!("{value} is no finite number"), "Give a finite number; a large one where nothing is to be bounded"))
            }
            None => Ok(resolved),
        }
    }
    /// These layers over `base`.
    pub fn over(&self, base: &toml::Table) -> Self {
        let mut table = base.clone();
        config::merge(&mut table, &self.table);
        Self { table, ..self.clone() }
    }
    /// What was said, as one table.
    pub fn table(&self) -> &toml::Table {
        &self.table
    }
    /// Whether they state the key at `path`, such as `train.iterations`.
    pub fn state(&self, path: &str) -> bool {
        let mut keys = path.split('.');
        let first = keys.next().and_then(|key| self.table.get(key));
        keys.fold(first, |value, key| value.and_then(|v| v.as_table()).and_then(|t| t.get(key))).is_some()
    }
    /// Whether the preset is `auto` (or `auto+METHOD`) and its plan is still to be made.
    pub fn want_plan(&self) -> bool {
        let preset = self.table.get("preset").and_then(|p| p.as_str()).unwrap_or_default();
        preset.split('+').next() == Some(AUTO) && !self.state("auto.plan")
    }
}

/// The path of a number that is not finite, also as the float32 that most settings are, and its value.
fn not_finite(table: &toml::Table) -> Option<(String, f64)> {
    fn within(value: &toml::Value) -> Option<(String, f64)> {
        match value {
            toml::Value::Float(v) if !(*v as f32).is_finite() => Some((String::new(), *v)),
            toml::Value::Array(values) => values.iter().find_map(within),
            toml::Value::Table(table) => not_finite(table),
            _ => None,
        }
    }
    table.iter().find_map(|(key, value)| within(value).map(|(rest, v)| (if rest.is_empty() { key.clone() } else { format!("{key}.{rest}") }, v)))
}

/// Refuses a preset among overrides: it would give the run its name and none of its settings, and decide whether a plan is made.
fn refuse_preset(sets: &[String]) -> Result<()> {
    let name = |set: &String| set.split_once('=').filter(|(key, _)| key.trim() == "preset").map(|(_, name)| name.trim().to_string());
    let Some(name) = sets.iter().find_map(name) else { return Ok(()) };
    Err(Error::parameter(
        "preset",
        format!("{name} is set as an override, which cannot choose a preset"),
        "State it as the preset: --preset, or preset in --config FILE",
    ))
}

/// Keys of earlier versions and what replaces them.
const RENAMED: [(&str, &str); 3] = [
    ("train.densify", "[density], such as density.max_gaussians"),
    ("train.lambda_c", "the weights of [[loss]] kind = \"l1\" and kind = \"dssim\""),
    ("density.reset_in_main", "density.reset_main_every, the iterations between two resets; 3000 where it was true"),
];

/// Refuses keys of earlier versions; the error names the new ones.
fn refuse_renamed(table: &toml::Table) -> Result<()> {
    for (old, new) in RENAMED {
        let (section, key) = old.split_once('.').unwrap_or((old, ""));
        if table.get(section).and_then(|s| s.as_table()).is_some_and(|s| s.contains_key(key)) {
            return Err(Error::parameter(old, "this key was replaced", format!("Use {new}")));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plans_are_asked_for_once() {
        let registry = Registry::collect().unwrap();
        let layers = |preset, sets: &[&str]| {
            let sets: Vec<String> = sets.iter().map(ToString::to_string).collect();
            Layers::collect(&registry, preset, None, &sets).unwrap()
        };
        assert!(layers(Some("auto"), &[]).want_plan() && layers(Some("auto+hexplane"), &[]).want_plan());
        assert!(!layers(Some("demo"), &[]).want_plan() && !layers(None, &[]).want_plan());
        let done = layers(Some("auto"), &["auto.plan=['chosen']", "train.iterations=7"]);
        assert!(!done.want_plan() && done.state("train.iterations") && !done.state("train.batch") && !done.state("train.iterations.x"));
        let base = "[train]\niterations = 3\nbatch = 4".parse().unwrap();
        let config = done.over(&base).config().unwrap();
        assert_eq!((config.train.iterations, config.train.batch), (7, 4));
    }

    #[test]
    fn a_stated_preset_takes_the_place_of_the_one_that_the_file_names() {
        let (folder, registry) = (tempfile::tempdir().unwrap(), Registry::collect().unwrap());
        let file = folder.path().join("config.toml");
        std::fs::write(&file, "preset = 'demo'\n[train]\nbatch = 3\n").unwrap();
        for (stated, name, plans) in [(Some("auto+hexplane"), "auto+hexplane", true), (Some(""), "demo", false), (None, "demo", false)] {
            let layers = Layers::collect(&registry, stated, Some(file.as_path()), &[]).unwrap();
            assert_eq!((layers.table()["preset"].as_str(), layers.want_plan()), (Some(name), plans), "{stated:?}");
            assert!(layers.state("train.batch"), "the file's settings hold");
        }
    }

    #[test]
    fn an_override_chooses_no_preset() {
        let registry = Registry::collect().unwrap();
        let auto = Layers::collect(&registry, Some("auto"), None, &[]).unwrap();
        for set in ["preset=demo", " preset = 'auto' "] {
            let sets = ["train.batch=3".to_string(), set.to_string()];
            for refused in [Layers::collect(&registry, Some("auto"), None, &sets), auto.with(&sets)] {
                let message = refused.unwrap_err().to_string();
                assert!(message.starts_with("preset: ") && message.contains("--preset"), "{message}");
            }
        }
    }

    #[test]
    fn methods_have_their_full_size_on_graphics_cards() {
        let registry = Registry::collect().unwrap();
        let layers = Layers::collect(&registry, Some("auto+hexplane"), None, &["deformer.features=7".into()]).unwrap();
        let integer = |layers: &Layers, key: &str| layers.table()["deformer"].get(key).and_then(toml::Value::as_integer);
        let full = layers.at_full_size(&registry, "dnerf").unwrap();
        assert_eq!((integer(&layers, "resolution"), integer(&full, "resolution")), (Some(32), None));
        assert_eq!((integer(&layers, "time_resolution"), integer(&full, "time_resolution")), (Some(30), Some(75)));
        assert_eq!((integer(&layers, "features"), integer(&full, "features")), (Some(7), Some(7)));
        assert!(full.want_plan());
        let (published, demo) = (registry.preset("dnerf+grid4d").unwrap(), registry.preset("demo+grid4d").unwrap());
        let iterations = |table: &toml::Table| table["train"].get("iterations").and_then(toml::Value::as_integer);
        assert_eq!(iterations(&published), Some(50_000));
        assert!(iterations(&demo) < Some(50_000) && !demo.contains_key("published"));
        let planned = Layers::collect(&registry, Some("auto+grid4d"), None, &[]).unwrap().at_full_size(&registry, "dnerf").unwrap();
        assert!(!planned.state("train.iterations") && !planned.state("render.background"), "plans decide, not how a method is published");
        let alone = Layers::collect(&registry, Some("auto"), None, &[]).unwrap();
        assert_eq!(alone.at_full_size(&registry, "n3dv").unwrap(), alone);
    }
}
