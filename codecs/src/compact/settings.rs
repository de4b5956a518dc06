//! Settings, and the profiles that are short for them.

use super::layers::MOST as MOST_LAYERS;
use cc4dgs_format::{Error, Result, config, unknown_name};
use serde::Deserialize;

pub(super) const SCHEMA: &str = "\
max_drop_db = 0.05       # with --scene: the smallest file whose PSNR on validation views, else training views, is at most so much lower; `compact:max-drop=0.05dB` for short. Without fine-tuning the deformer's weights are not counted. 0: psnr_db
max_size_mb = 0.0        # the best Gaussians in a file of at most so many MB, all included; `compact:max-size=5MB` for short. 0: no limit
finetune = 500           # with --scene: iterations in which Gaussians and deformer are trained further with rounded values, in larger steps; 0: none
size_weight = 4.0        # how much bits count in fine-tuning; 0 trains for accuracy alone
psnr_db = 50.0           # PSNR between images before and after, measured with --scene or --orbit (the deformer's weights are not counted), else estimated; `compact:psnr=50dB` for short. It counts where no size is bounded, and no loss, or where no images measure a loss
rate_weight = 0.0        # how much bits count when colour coefficients above degree 0 are rounded; 0 rounds to the nearest, which is best for images
measured = true          # with --scene or --orbit: weights from derivatives of renders; false: from sizes and opacities
adaptive = true          # steps of their own for Gaussians that are seen more or less
shapes = true            # with --scene or --orbit: steps of shapes by the weights of shapes; false: by those of colours
allocate = true          # with --scene or --orbit: correct the steps of the columns by what a change of each costs and saves
transform = true         # transform the colour coefficients of each degree
joint = true             # with --scene or --orbit, without fine-tuning: round the colour coefficients of a Gaussian together, for the directions that views see
canonical = true         # sort the axes of Gaussians whose shape does not change
layers = 0               # sets of Gaussians by falling weight, which a player draws one by one while they arrive, up to 6; 0: 3 from 131,072 Gaussians on, else 1
";

/// Settings of the codec.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Largest loss of PSNR in dB on the views that judge; 0 chooses by `psnr_db`.
    pub max_drop_db: f64,
    /// Largest size of the file in MB; 0 is no limit.
    pub max_size_mb: f64,
    /// Iterations of fine-tuning.
    pub finetune: usize,
    /// How much bits count in fine-tuning.
    pub size_weight: f64,
    /// PSNR between images before and after, in dB: measured where there are views, else estimated.
    pub psnr_db: f64,
    /// How much bits count when colour coefficients are rounded.
    pub rate_weight: f64,
    /// Measure weights where the context can render.
    pub measured: bool,
    /// Classes of steps.
    pub adaptive: bool,
    /// Weights of their own for shapes.
    pub shapes: bool,
    /// Measure what the steps of each column cost and save.
    pub allocate: bool,
    /// Transform colour coefficients.
    pub transform: bool,
    /// Round coefficients of colours together.
    pub joint: bool,
    /// Sort axes.
    pub canonical: bool,
    /// Sets of Gaussians by falling weight; 0 chooses by their number.
    pub layers: usize,
    /// Whether the user asked for a loss of PSNR, which needs a scene.
    #[serde(skip)]
    pub drop_wanted: bool,
    /// Whether the user asked for a PSNR between images.
    #[serde(skip)]
    pub psnr_wanted: bool,
    /// Whether the user asked for iterations of fine-tuning, which need a scene.
    #[serde(skip)]
    pub finetune_wanted: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_drop_db: 0.05,
            max_size_mb: 0.0,
            finetune: 500,
            size_weight: 4.0,
            psnr_db: 50.0,
            rate_weight: 0.0,
            measured: true,
            adaptive: true,
            shapes: true,
            allocate: true,
            transform: true,
            joint: true,
            canonical: true,
            layers: 0,
            drop_wanted: false,
            psnr_wanted: false,
            finetune_wanted: false,
        }
    }
}

/// Name of a profile in front of `=`, the setting, its unit, and the settings that it switches off.
const PROFILES: [(&str, &str, &str, &[&str]); 3] =
    [("max-drop", "max_drop_db", "dB", &["max_size_mb"]), ("max-size", "max_size_mb", "MB", &[]), ("psnr", "psnr_db", "dB", &["max_drop_db", "max_size_mb"])];

impl Settings {
    /// The settings of a profile (`max-drop=0.05dB`), with `table` laid over them.
    pub fn parse(profile: &str, table: &toml::Table) -> Result<Self> {
        let mut section = toml::Table::new();
        let drop_wanted = profile.starts_with("max-drop") || table.contains_key("max_drop_db");
        let psnr_wanted = profile.starts_with("psnr") || table.contains_key("psnr_db");
        if !matches!(profile, "" | "default") {
            let (name, value) = profile.split_once('=').unwrap_or((profile, ""));
            let Some((_, setting, unit, off)) = PROFILES.iter().find(|p| p.0 == name) else {
                return Err(unknown_name("profile of codec compact", name, ["default"].into_iter().chain(PROFILES.iter().map(|p| p.0))));
            };
            let number = value.strip_suffix(unit).unwrap_or(value).trim().parse::<f64>().ok().filter(|v| *v > 0.0 && v.is_finite());
            let Some(number) = number else {
                let remedy = format!("Write a positive number of {unit}, such as compact:{name}={}{unit}", if *unit == "MB" { "5" } else { "0.05" });
                return Err(Error::parameter(format!("profile of codec compact '{profile}'"), format!("'{value}' is no number of {unit}"), remedy));
            };
            section.insert((*setting).into(), number.into());
            off.iter().for_each(|key| drop(section.insert((*key).into(), 0.0.into())));
        }
        config::merge(&mut section, table);
        let parsed: Self = config::parse_section("codec compact", &section)?;
        let (drop_wanted, finetune_wanted) = (drop_wanted && parsed.max_drop_db > 0.0, table.contains_key("finetune") && parsed.finetune > 0);
        let settings = Self { drop_wanted, psnr_wanted, finetune_wanted, ..parsed };
        let bounds = [
            ("max_drop_db", settings.max_drop_db, 0.0..=20.0),
            ("max_size_mb", settings.max_size_mb, 0.0..=1e6),
            ("psnr_db", settings.psnr_db, 15.0..=90.0),
            ("rate_weight", settings.rate_weight, 0.0..=4.0),
            ("finetune", settings.finetune as f64, 0.0..=1e6),
            ("size_weight", settings.size_weight, 0.0..=100.0),
            ("layers", settings.layers as f64, 0.0..=MOST_LAYERS as f64),
        ];
        if settings.max_size_mb > 0.0 && settings.drop_wanted {
            let problem = format!("a loss of {} dB and a size of {} MB are both bounded", settings.max_drop_db, settings.max_size_mb);
            return Err(Error::parameter("codec compact", problem, "Bound one of them: max_drop_db or max_size_mb"));
        }
        if finetune_wanted && settings.max_drop_db == 0.0 && settings.max_size_mb == 0.0 {
            let problem = "fine-tuning belongs to the search for a loss or a size, and neither is bounded";
            return Err(Error::parameter("codec compact.finetune", problem, "Choose compact:max-drop=0.05dB or compact:max-size=5MB, or leave it out"));
        }
        match bounds.into_iter().find(|(_, value, range)| !range.contains(value)) {
            Some((name, value, range)) => {
                Err(Error::parameter(format!("codec compact.{name}"), value.to_string(), format!("Choose {} to {}", range.start(), range.end())))
            }
            None => Ok(settings),
        }
    }
    /// Refuses a loss that the user asked for, where no views measure it.
    pub fn check_without_views(&self) -> Result<()> {
        if !self.drop_wanted {
            return Ok(());
        }
        let problem = format!("a loss of {} dB of PSNR is measured on images of a scene, and there is none", self.max_drop_db);
        let remedy = "Give the dataset to `cc4dgs compress` (--scene), or choose --codec compact:psnr=50dB or compact:max-size=5MB";
        Err(Error::parameter("codec compact.max_drop_db", problem, remedy))
    }
    /// Refuses fine-tuning that the user asked for, where nothing can train the model further.
    pub fn check_without_tuner(&self) -> Result<()> {
        if !self.finetune_wanted {
            return Ok(());
        }
        let problem = format!("{} iterations of fine-tuning need the images of a scene, and there is none", self.finetune);
        Err(Error::parameter("codec compact.finetune", problem, "Give the dataset to `cc4dgs compress` (--scene), or leave --set finetune out"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn profiles_are_short_for_settings() {
        let parse = |profile: &str| Settings::parse(profile, &toml::Table::new());
        assert_eq!(parse("max-drop=0.1dB").unwrap().max_drop_db, 0.1);
        assert_eq!(parse("max-size=5MB").unwrap().max_size_mb, 5.0);
        let psnr = parse("psnr=44").unwrap();
        assert_eq!((psnr.psnr_db, psnr.max_drop_db), (44.0, 0.0));
        for bad in ["max-drop", "max-drop=x", "max-size=-1MB", "max-size=nanMB", "psnr=1000dB", "lowest"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
        assert!(Settings::parse("max-size=5MB", &"max_drop_db = 0.1".parse().unwrap()).unwrap_err().to_string().contains("both"));
        assert!(parse("max-dorp=1dB").unwrap_err().to_string().contains("max-drop"));
        let schema: toml::Table = SCHEMA.parse().unwrap();
        let (read, default) = (Settings::parse("", &schema).unwrap(), parse("").unwrap());
        assert_eq!(format!("{:?}", Settings { drop_wanted: false, psnr_wanted: false, finetune_wanted: false, ..read }), format!("{default:?}"));
    }

    #[test]
    fn what_was_asked_for_and_needs_a_scene_is_refused_without_one() {
        let parse = |profile: &str, table: &str| Settings::parse(profile, &table.parse().unwrap());
        let without_scene = |profile: &str, table: &str| {
            let settings = parse(profile, table).unwrap();
            settings.check_without_tuner().and_then(|()| settings.check_without_views()).map_err(|e| e.to_string())
        };
        // A value of 0 asks for nothing.
        for (profile, table) in [("", ""), ("", "max_drop_db = 0.0\nfinetune = 0"), ("psnr=50dB", ""), ("max-size=5MB", "finetune = 0")] {
            assert_eq!(without_scene(profile, table), Ok(()), "{profile} {table}");
        }
        for (profile, table, setting) in [("max-drop=0.1dB", "", "max_drop_db"), ("", "max_drop_db = 0.1", "max_drop_db"), ("", "finetune = 9", "finetune")] {
            let refused = without_scene(profile, table).unwrap_err();
            assert!(refused.starts_with(&format!("codec compact.{setting}: ")) && refused.contains("--scene"), "{refused}");
        }
        // Nothing is searched, with a scene or without.
        assert!(parse("psnr=50dB", "finetune = 9").unwrap_err().to_string().contains("neither is bounded"));
        parse("psnr=50dB", "finetune = 0").unwrap();
    }
}
