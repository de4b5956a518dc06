//! Presets: layers of settings by name.

use crate::{Error, Plugin, Registry, Result, config, plugin_kind, unknown_name};

/// The role of a preset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PresetRole {
    /// Settings for a family of datasets: a whole configuration.
    Family {
        /// The table of a method's layer that applies to this family (`dnerf` for any family of D-NeRF scenes).
        dataset: &'static str,
        /// Whether its sizes are for two cores, so that a method's `cpu` table applies too.
        small: bool,
    },
    /// Changes to a family by a method. The layer has a table `all` for all families, one per dataset that differs, and one for `cpu` sizes. Tables of the same
    /// names in `published` say how the method is published, beside its sizes: families that plan for themselves leave them out.
    Method,
}

/// A registered preset: `demo` is a family, `hexplane` a method, `demo+hexplane` both.
pub struct PresetPlugin {
    /// Facts for lists; `info.schema` is the layer itself, as TOML text with comments.
    pub info: Plugin,
    /// Its role.
    pub role: PresetRole,
}

plugin_kind!(PresetPlugin, "preset");

impl PresetPlugin {
    /// The layer as a table.
    pub fn layer(&self) -> Result<toml::Table> {
        config::parse_table(&format!("preset {}", self.info.name), self.info.schema)
    }
}

impl Registry {
    /// The settings called `name`: a family, or a family and a method joined by `+`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for an unknown family or method, for a method instead of a family, and for a layer that is not TOML.
    pub fn preset(&self, name: &str) -> Result<toml::Table> {
        self.resolve(name, None)
    }
    /// As [`Registry::preset`], with the sizes that the method has for `dataset` on a graphics card in place of those that it has for the family.
    ///
    /// # Errors
    /// As [`Registry::preset`].
    pub fn preset_at_full_size(&self, name: &str, dataset: &str) -> Result<toml::Table> {
        self.resolve(name, Some(dataset))
    }
    fn resolve(&self, name: &str, full_size: Option<&str>) -> Result<toml::Table> {
        let (family, method) = name.split_once('+').map_or((name, None), |(family, method)| (family, Some(method)));
        let plugin = self.presets().find(|p| p.info.name == family && p.role != PresetRole::Method);
        let Some((plugin, PresetRole::Family { dataset, small })) = plugin.map(|p| (p, p.role)) else {
            if self.presets().any(|p| p.info.name == family) {
                return Err(Error::parameter(
                    format!("preset '{family}'"),
                    "it is a method, which changes a family",
                    format!("Write FAMILY+{family}, such as demo+{family}"),
                ));
            }
            return Err(unknown_name("preset", family, self.preset_names(|role| role != PresetRole::Method)));
        };
        let (dataset, small) = full_size.map_or((dataset, small), |dataset| (dataset, false));
        let mut settings = plugin.layer()?;
        if let Some(method) = method {
            let Some(plugin) = self.presets().find(|p| p.info.name == method && p.role == PresetRole::Method) else {
                return Err(unknown_name("preset method", method, self.preset_names(|role| role == PresetRole::Method)));
            };
            let layers = plugin.layer()?;
            let table = |layers: &toml::Table, name: &str| match layers.get(name) {
                Some(toml::Value::Table(table)) => Ok(table.clone()),
                Some(_) => {
                    let problem = format!("{name} is not a table");
                    Err(Error::parameter(format!("preset method {method}"), problem, "Write the settings under a table header"))
                }
                None => Ok(toml::Table::new()),
            };
            for name in ["all", dataset].into_iter().chain(small.then_some("cpu")) {
                config::merge(&mut settings, &table(&layers, name)?);
            }
            if !small && full_size.is_none() {
                let published = table(&layers, "published")?;
                for name in ["all", dataset] {
                    config::merge(&mut settings, &table(&published, name)?);
                }
            }
        }
        settings.insert("preset".into(), name.into());
        Ok(settings)
    }
    fn preset_names(&self, keep: fn(PresetRole) -> bool) -> impl Iterator<Item = &'static str> + '_ {
        self.presets().filter(move |p| keep(p.role)).map(|p| p.info.name)
    }
}
