//! The configuration of a run: presets, files and overrides, read strictly.

use crate::auto::AutoConfig;
pub use crate::field_box::FieldBox;
use crate::layers::Layers;
pub use crate::train_config::{CoarseFrames, Dynamic, GaussianRates, TrainConfig};
use cc4dgs_core::{BLUR_RANGE, Error, Limits, Registry, Result, Scene, SceneOptions, config, split_kind};
use cc4dgs_play::{RenderConfig, default_rasterizer};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Everything that decides a run. Written beside every result as `config.toml`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Name of the preset it started from, for the record.
    #[serde(default)]
    pub preset: String,
    /// What the preset `auto` was asked for and what it chose.
    #[serde(default)]
    pub auto: AutoConfig,
    /// Root of the seed tree.
    #[serde(default)]
    pub seed: u64,
    /// Device name; see [`cc4dgs_core::parse_device`].
    #[serde(default = "flex")]
    pub device: String,
    /// What readers may believe.
    #[serde(default)]
    pub limits: Limits,
    /// Limits of this machine, in a process that was given some: they decide in place of `limits` what is refused. Never in a file.
    #[serde(skip)]
    pub machine_limits: Option<Limits>,
    /// How the scene is read.
    #[serde(default)]
    pub scene: SceneOptions,
    /// How images are drawn.
    #[serde(default)]
    pub render: RenderConfig,
    /// The rasterizer plug-in: `kind` and its settings.
    #[serde(default = "default_rasterizer")]
    pub rasterizer: toml::Table,
    /// The deformer plug-in: `kind` and its settings.
    #[serde(default = "cdf")]
    pub deformer: toml::Table,
    /// The density control plug-in: `kind` and its settings.
    #[serde(default = "clone_split")]
    pub density: toml::Table,
    /// The loss terms: `kind`, `weight` (1 if absent) and their settings.
    #[serde(default = "l1_and_dssim")]
    pub loss: Vec<toml::Table>,
    /// The loss term of the score stage: `kind` and its settings. Its target is the mask of what moves, `[1,H,W]`.
    #[serde(default = "mask_bce")]
    pub score_loss: toml::Table,
    /// The appearance plug-in: `kind` and its settings.
    #[serde(default = "no_appearance")]
    pub appearance: toml::Table,
    /// The pose plug-in: `kind` and its settings.
    #[serde(default = "no_poses")]
    pub poses: toml::Table,
    /// The optimizer plug-in: `kind` and its settings.
    #[serde(default = "adam")]
    pub optimizer: toml::Table,
    /// Where the first Gaussians come from.
    #[serde(default)]
    pub init: InitConfig,
    /// The trainer.
    #[serde(default)]
    pub train: TrainConfig,
}

/// A plug-in section with nothing but its `kind`.
fn kind(name: &str) -> toml::Table {
    toml::Table::from_iter([("kind".into(), name.into())])
}
fn clone_split() -> toml::Table {
    kind("clone-split")
}
/// The paper's loss with lambda_c = 0.8.
fn l1_and_dssim() -> Vec<toml::Table> {
    [("l1", 0.8), ("dssim", 0.2)]
        .into_iter()
        .map(|(name, weight)| toml::Table::from_iter([("kind".into(), name.into()), ("weight".into(), weight.into())]))
        .collect()
}
fn mask_bce() -> toml::Table {
    kind("mask-bce")
}
fn no_appearance() -> toml::Table {
    kind("none")
}
fn no_poses() -> toml::Table {
    kind("none")
}
fn adam() -> toml::Table {
    kind("adam")
}

fn flex() -> String {
    "flex".into()
}
fn cdf() -> toml::Table {
    kind("cdf")
}

/// Where the points of the first Gaussians come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum InitSource {
    /// The dataset's points; where they are few or there are none, whatever the scene allows of the others, together.
    #[default]
    Auto,
    /// The dataset's points.
    Points,
    /// Photo-consistent points of cameras that share a time, or of a moving camera at neighbouring times.
    Photo,
    /// The visual hull of the foreground: by masks, transparency or a plain background.
    Hull,
    /// Random points in the volume that the cameras see.
    Random,
}

/// Where the first Gaussians come from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InitConfig {
    /// Where points come from.
    pub source: InitSource,
    /// The most Gaussians to start with.
    pub count: usize,
    /// Opacity of a new Gaussian, 0..1.
    pub opacity: f32,
    /// Take the first points as they are: their sizes and opacities are not limited, and random ones are grey (3DGS: true).
    pub plain: bool,
}

impl Default for InitConfig {
    fn default() -> Self {
        Self { source: InitSource::Auto, count: 40_000, opacity: 0.1, plain: false }
    }
}

impl RunConfig {
    /// Layers a preset, a TOML file and `key=value` overrides, in that order, and reads the result strictly.
    ///
    /// # Errors
    /// As [`Layers::collect`] and [`Layers::config`].
    pub fn resolve(preset: Option<&str>, file: Option<&Path>, sets: &[String]) -> Result<Self> {
        Layers::collect(&Registry::collect()?, preset, file, sets)?.config()
    }
    /// This configuration with every setting of its plug-ins, defaults included.
    pub fn completed(&self, registry: &Registry) -> Result<Self> {
        let mut full = self.clone();
        let kind = |section: &toml::Table, object: &str| split_kind(object, section).map(|(kind, _)| kind);
        full.deformer = registry.complete_deformer(&self.deformer)?;
        full.rasterizer = config::filled(registry.rasterizer(&kind(&self.rasterizer, "rasterizer")?)?.info.schema, &self.rasterizer)?;
        full.density = config::filled(registry.density(&kind(&self.density, "density")?)?.info.schema, &self.density)?;
        full.appearance = config::filled(registry.appearance(&kind(&self.appearance, "appearance")?)?.info.schema, &self.appearance)?;
        full.poses = config::filled(registry.poses(&kind(&self.poses, "poses")?)?.info.schema, &self.poses)?;
        full.optimizer = config::filled(registry.optimizer(&kind(&self.optimizer, "optimizer")?)?.info.schema, &self.optimizer)?;
        for section in full.loss.iter_mut().chain([&mut full.score_loss]) {
            *section = config::filled(registry.loss(&kind(section, "loss")?)?.info.schema, section)?;
        }
        Ok(full)
    }
    /// The configuration as TOML text; reading it back gives the same run.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|e| Error::parameter("configuration", e.to_string(), "Report this: every configuration should be printable"))
    }
    /// The colour behind everything: `scene.background`, else `render.background`, else white.
    pub fn background(&self) -> Result<[f32; 3]> {
        self.scene.background.as_ref().map_or(Ok(self.render.background.unwrap_or([1.0; 3])), |b| b.rgb())
    }
    /// This configuration with its background settled for `scene`, whose own counts when nothing else was asked for.
    pub fn settled_for(&self, scene: &Scene) -> Result<Self> {
        let mut settled = self.clone();
        let wanted = self.scene.background.as_ref().map(|b| b.rgb()).transpose()?.or(self.render.background).or(scene.background);
        settled.render.background = Some(wanted.unwrap_or([1.0; 3]));
        Ok(settled)
    }
    /// What readers may believe in this process.
    pub(crate) fn limits_here(&self) -> &Limits {
        self.machine_limits.as_ref().unwrap_or(&self.limits)
    }
    pub(crate) fn validate(&self) -> Result<()> {
        self.scene.validate()?;
        self.auto.validate()?;
        self.train.validate()?;
        if let Some(near) = self.render.near.filter(|near| !near.is_finite() || *near < 0.0) {
            return Err(Error::parameter(
                "render.near",
                format!("{near} is not a depth"),
                "Give a finite depth of 0 or more, in units of the normalised frame (cameras are about 4 from what they see)",
            ));
        }
        if !BLUR_RANGE.contains(&self.render.blur) {
            let problem = format!("{} is not between {} and {}", self.render.blur, BLUR_RANGE.start(), BLUR_RANGE.end());
            return Err(Error::parameter("render.blur", problem, "Give a variance in square pixels, such as 0.3 or 0.1"));
        }
        if let Some(focal) = self.render.focal.filter(|focal| !focal.is_finite() || *focal <= 0.0) {
            return Err(Error::parameter("render.focal", format!("{focal} is not a focal length"), "Give the longest one of the training images, in pixels"));
        }
        if let Some(background) = self.render.background.filter(|b| b.iter().any(|c| !(0.0..=1.0).contains(c))) {
            return Err(Error::parameter("render.background", format!("{background:?} is not RGB in 0..1"), "Give three numbers in 0..1"));
        }
        if !(self.init.opacity > 0.0 && self.init.opacity < 1.0) || self.init.count == 0 {
            return Err(Error::parameter(
                "init",
                format!("opacity {} count {}", self.init.opacity, self.init.count),
                "Opacity lies between 0 and 1, the count is positive",
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::PresetRole;

    #[test]
    fn every_preset_parses_and_round_trips() {
        for plugin in Registry::collect().unwrap().presets().filter(|p| p.role != PresetRole::Method) {
            let name = plugin.info.name;
            let config = RunConfig::resolve(Some(name), None, &["train.iterations=7".into()]).unwrap();
            assert_eq!(config.train.iterations, 7);
            let text = config.to_toml().unwrap();
            let again: RunConfig = config::parse_section("again", &text.parse().unwrap()).unwrap();
            assert_eq!(again.to_toml().unwrap(), text);
        }
    }

    #[test]
    fn mistakes_are_named() {
        let e = RunConfig::resolve(Some("dnref"), None, &[]).unwrap_err().to_string();
        assert!(e.contains("dnerf"), "{e}");
        let e = RunConfig::resolve(Some("demo"), None, &["train.densify.every=3".into()]).unwrap_err().to_string();
        assert!(e.contains("[density]"), "{e}");
        let e = RunConfig::resolve(Some("demo"), None, &["init.source=pionts".into()]).unwrap_err().to_string();
        assert!(e.contains("pionts") && e.contains("points"), "{e}");
        let e = RunConfig::resolve(Some("demo"), None, &["train.iteratons=3".into()]).unwrap_err().to_string();
        assert!(e.contains("iteratons"), "{e}");
        for blur in ["0", "-0.1", "nan", "101"] {
            let e = RunConfig::resolve(Some("demo"), None, &[format!("render.blur={blur}")]).unwrap_err().to_string();
            assert!(e.contains("render.blur") && e.contains("0.01 and 100"), "{e}");
        }
        for focal in ["0", "-1", "inf"] {
            let e = RunConfig::resolve(Some("demo"), None, &[format!("render.focal={focal}")]).unwrap_err().to_string();
            assert!(e.contains("render.focal"), "{e}");
        }
    }
}
