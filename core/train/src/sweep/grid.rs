//! A grid: scenes x methods x settings x codecs x seeds, as a TOML file. `docs/sweeps.md` describes the keys.

use super::overruled::refuse_overruled;
use super::result::CodecChoice;
use super::settings::{Settings, of_file};
use crate::auto::PRESET as AUTO;
use cc4dgs_core::{Error, Result, Split, config};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Views that are kept out of training where cells are scored on them and the grid does not say how many.
const VALIDATION_VIEWS: usize = 12;
/// Most cells of a grid.
const MOST_CELLS: usize = 1_000_000;

/// The side of the split that cells are scored on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScoredViews {
    /// Views kept out of training, to choose settings by.
    Validation,
    /// Test views: once, at the end.
    Test,
}

impl From<ScoredViews> for Split {
    fn from(views: ScoredViews) -> Self {
        match views {
            ScoredViews::Validation => Self::Validation,
            ScoredViews::Test => Self::Test,
        }
    }
}

/// One value of an axis along which trainings differ: a name, settings, a factor of the grid's size, and the keys of its own kind.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "NamedTable", bound(deserialize = "T: DeserializeOwned"))]
pub struct Axis<T> {
    /// Its name in tables.
    pub name: String,
    /// A configuration file (a path, also one that starts with an environment variable), whose settings come before `set`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub config: Option<String>,
    /// Settings, `key=value`.
    pub set: Vec<String>,
    /// Multiplies the grid's size.
    pub size: f64,
    /// The keys of its kind.
    #[serde(flatten)]
    pub own: T,
}

/// A dataset.
pub type SceneAxis = Axis<SceneKeys>;
/// A way to train.
pub type MethodAxis = Axis<MethodKeys>;
/// Changes of a method.
pub type SettingAxis = Axis<SettingKeys>;

/// What a `[[scene]]` has beside the keys of every axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneKeys {
    /// A path, `procedural:NAME`, or a path that starts with an environment variable (`$CC4DGS_DATA/mutant`).
    pub path: String,
    /// The family of presets that methods starting with `+` are put on; see [`SceneKeys::family`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub family: Option<String>,
}

impl SceneKeys {
    /// The family that is stated, else `auto`.
    pub fn family(&self) -> &str {
        self.family.as_deref().unwrap_or(AUTO)
    }
}

/// What a `[[method]]` has beside the keys of every axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MethodKeys {
    /// A preset, such as `auto+hexplane`; `+hexplane` is put on the scene's family, `+` alone is that family. Empty: the program's defaults.
    pub preset: String,
}

/// A `[[setting]]` has nothing beside the keys of every axis.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SettingKeys {}

/// The common keys of an axis, and all others.
#[derive(Deserialize)]
struct NamedTable {
    name: String,
    #[serde(default)]
    config: Option<String>,
    #[serde(default)]
    set: Vec<String>,
    #[serde(default = "one")]
    size: f64,
    #[serde(flatten)]
    others: toml::Table,
}

// serde cannot refuse unknown keys of a flattened structure; the keys of a kind are therefore read by themselves.
impl<T: DeserializeOwned> TryFrom<NamedTable> for Axis<T> {
    type Error = toml::de::Error;
    fn try_from(table: NamedTable) -> std::result::Result<Self, Self::Error> {
        let NamedTable { name, config, set, size, others } = table;
        Ok(Self { name, config, set, size, own: others.try_into()? })
    }
}

impl<T> Axis<T> {
    fn names(axis: &[Self]) -> Vec<&str> {
        axis.iter().map(|value| value.name.as_str()).collect()
    }
    fn sizes(axis: &[Self]) -> impl Iterator<Item = f64> + '_ {
        axis.iter().map(|value| value.size)
    }
    /// The settings of its file, and its own.
    pub(super) fn settings(&self) -> Result<Settings<'_>> {
        Ok(Settings { file: self.config.as_deref().map_or(Ok(Vec::new()), of_file)?, set: &self.set })
    }
}

/// A way to store a model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CodecAxis {
    /// Its name in tables.
    pub name: String,
    /// `NAME[:PROFILE]`.
    pub codec: String,
    /// Weight codec of the deformer.
    #[serde(default = "fp32")]
    pub field_weights: String,
    /// Settings of the codec, `key=value`.
    #[serde(default)]
    pub set: Vec<String>,
}

impl CodecAxis {
    /// The codec with its settings.
    ///
    /// # Errors
    /// [`Error::Parameter`] for assignments without `=`.
    pub fn choice(&self) -> Result<CodecChoice> {
        let mut settings = toml::Table::new();
        config::set_all(&mut settings, &self.set)?;
        Ok(CodecChoice { codec: self.codec.clone(), field_weights: self.field_weights.clone(), settings })
    }
}

/// A grid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Its name.
    pub name: String,
    /// What cells are scored on.
    #[serde(default = "test")]
    pub split: ScoredViews,
    /// Views kept out of training (`train.validation`); by default 12 where they are scored, else none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub validation: Option<usize>,
    /// Device of trainings and scores.
    #[serde(default = "flex")]
    pub device: String,
    /// Size: wall minutes of a training, for the preset `auto`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// Size: iterations of a training.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub iterations: Option<usize>,
    /// Score at most so many images, spread over cameras and frames; 0 scores all.
    #[serde(default)]
    pub max_views: usize,
    /// Images of each cell that are kept as PNG files beside their ground truth, spread in the same way.
    #[serde(default = "two")]
    pub images: usize,
    /// Settings of every training, `key=value`.
    #[serde(default)]
    pub set: Vec<String>,
    /// Roots of the seed trees.
    #[serde(default = "first_seed")]
    pub seeds: Vec<u64>,
    /// The datasets.
    pub scene: Vec<SceneAxis>,
    /// The methods.
    pub method: Vec<MethodAxis>,
    /// Changes of the methods; by default one that changes nothing, `base`.
    #[serde(default = "base")]
    pub setting: Vec<SettingAxis>,
    /// The codecs.
    pub codec: Vec<CodecAxis>,
}

fn one() -> f64 {
    1.0
}
fn two() -> usize {
    2
}
fn fp32() -> String {
    "fp32".into()
}
fn flex() -> String {
    "flex".into()
}
fn test() -> ScoredViews {
    ScoredViews::Test
}
fn first_seed() -> Vec<u64> {
    vec![0]
}
fn base() -> Vec<SettingAxis> {
    vec![SettingAxis { name: "base".into(), config: None, set: Vec::new(), size: 1.0, own: SettingKeys {} }]
}

impl Grid {
    /// Reads a grid strictly; `object` names it in errors.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the key or value and the remedy.
    pub fn parse(object: &str, text: &str) -> Result<Self> {
        Self::of_table(object, config::parse_table(object, text)?)
    }
    /// As [`Grid::parse`], from TOML that has been read.
    ///
    /// # Errors
    /// As [`Grid::parse`].
    pub fn of_table(object: &str, table: toml::Table) -> Result<Self> {
        let grid: Self = table.try_into().map_err(|e: toml::de::Error| {
            let keys = "docs/sweeps.md lists the keys of a grid and of its tables [[scene]], [[method]], [[setting]] and [[codec]]";
            Error::parameter(object, e.message().trim().to_string(), keys)
        })?;
        grid.validate(object)?;
        Ok(grid)
    }
    /// Views kept out of training.
    pub fn validation_views(&self) -> usize {
        self.validation.unwrap_or(if self.split == ScoredViews::Validation { VALIDATION_VIEWS } else { 0 })
    }
    fn validate(&self, object: &str) -> Result<()> {
        let bad = |key: &str, problem: String, remedy: &str| Err(Error::parameter(format!("{object}: {key}"), problem, remedy));
        if !is_name(&self.name) {
            return bad("name", format!("'{}' is no name", self.name), "Use letters, digits, '-', '_' and '.'");
        }
        if self.minutes.is_some() && self.iterations.is_some() {
            return bad("iterations", "minutes are given too".into(), "Keep one of the two: minutes for the preset auto, iterations for any");
        }
        if self.minutes.is_some_and(|minutes| !(minutes > 0.0 && minutes.is_finite())) || self.iterations == Some(0) {
            return bad("minutes or iterations", "a training of no length".into(), "Give a positive number");
        }
        if self.split == ScoredViews::Validation && self.validation_views() == 0 {
            return bad("validation", "no view is kept out of training, and validation views are to be scored".into(), "Give a positive number of views");
        }
        let axes: [(&str, Vec<&str>); 4] = [
            ("scene", Axis::names(&self.scene)),
            ("method", Axis::names(&self.method)),
            ("setting", Axis::names(&self.setting)),
            ("codec", self.codec.iter().map(|a| a.name.as_str()).collect()),
        ];
        for (axis, names) in &axes {
            if names.is_empty() {
                return bad(axis, "there is none".into(), &format!("Add a table [[{axis}]]"));
            }
            let mut seen = BTreeSet::new();
            for name in names {
                if !is_name(name) {
                    return bad(axis, format!("'{name}' is no name"), "Use letters, digits, '-', '_' and '.'");
                }
                if !seen.insert(name) {
                    return bad(axis, format!("the name '{name}' is there twice"), "Rename or remove one of them");
                }
            }
        }
        if self.seeds.is_empty() || self.seeds.iter().collect::<BTreeSet<_>>().len() < self.seeds.len() {
            return bad("seeds", format!("{:?} is empty or has one twice", self.seeds), "Give different numbers, such as [0, 1, 2]");
        }
        let mut sizes = Axis::sizes(&self.scene).chain(Axis::sizes(&self.method)).chain(Axis::sizes(&self.setting));
        if let Some(size) = sizes.find(|size| !(*size > 0.0 && *size <= 1e6)) {
            return bad("size", format!("{size} is no factor"), "Give a positive number of at most 1e6; 1 is the grid's own size");
        }
        let cells = axes.iter().map(|(_, names)| names.len()).chain([self.seeds.len()]).try_fold(1usize, |n, k| n.checked_mul(k)).unwrap_or(usize::MAX);
        if cells > MOST_CELLS {
            return bad("grid", format!("{cells} cells, at most {MOST_CELLS} are possible"), "Make several grids of it");
        }
        refuse_overruled(object, self)
    }
}

/// Names are parts of file names and of scheduler scripts.
fn is_name(text: &str) -> bool {
    !text.is_empty() && text.len() <= 100 && !text.starts_with(['.', '-']) && text.chars().all(|c| c.is_ascii_alphanumeric() || "-_.".contains(c))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str =
        "name = 'g'\n[[scene]]\nname = 's'\npath = 'procedural:tiny'\n[[method]]\nname = 'm'\npreset = '+'\n[[codec]]\nname = 'c'\ncodec = 'raw'\n";

    #[test]
    fn defaults_are_few() {
        let grid = Grid::parse("g.toml", SMALL).unwrap();
        assert_eq!((grid.split, grid.validation_views(), grid.seeds.as_slice(), grid.setting[0].name.as_str()), (ScoredViews::Test, 0, &[0][..], "base"));
        assert_eq!((grid.scene[0].own.family(), grid.codec[0].field_weights.as_str()), ("auto", "fp32"));
        let validation = Grid::parse("g.toml", &format!("split = 'validation'\n{SMALL}")).unwrap();
        assert_eq!(validation.validation_views(), VALIDATION_VIEWS);
        let again: Grid = toml::from_str(&toml::to_string(&grid).unwrap()).unwrap();
        assert_eq!(again, grid);
    }

    #[test]
    fn a_file_of_settings_comes_before_those_of_its_axis() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("reference.toml");
        std::fs::write(&file, "preset = 'auto'\nseed = 9\n[train]\niterations = 5\nbatch = 2\n[train.lr]\nmeans = 0.5\n[[loss]]\nkind = 'l1'\nweight = 1.0\n")
            .unwrap();
        let method = |config: &str| {
            let text = format!("[[method]]\nname = 'x'\npreset = ''\nconfig = '{config}'\nset = ['train.batch=3']\n");
            let method = Grid::parse("g.toml", &format!("{SMALL}{text}")).unwrap().method.remove(1);
            method.settings().map(|own| [own.file.as_slice(), own.set].concat())
        };
        let mut made = toml::Table::new();
        config::set_all(&mut made, &method(&file.display().to_string()).unwrap()).unwrap();
        let expected = "seed = 9\n[train]\niterations = 5\nbatch = 3\n[train.lr]\nmeans = 0.5\n[[loss]]\nkind = 'l1'\nweight = 1.0\n";
        assert_eq!(made, expected.parse().unwrap());
        assert!(matches!(method("no/such.toml").unwrap_err(), Error::Io { .. }));
        // Names of cameras have dots.
        let offsets = "[scene]\nwidth = 8\n[scene.offsets]\ncam01 = 1\n\"videos/a.mp4\" = -2\n";
        std::fs::write(&file, offsets).unwrap();
        let mut made = toml::Table::new();
        config::set_all(&mut made, &method(&file.display().to_string()).unwrap()).unwrap();
        assert_eq!(made, format!("{offsets}[train]\nbatch = 3\n").parse().unwrap());
    }

    #[test]
    fn mistakes_are_named_with_a_remedy() {
        let cases = [
            ("seed = 3\n", "", "seed"),
            ("minutes = 3.0\niterations = 5\n", "", "Keep one of the two"),
            ("minutes = 0.0\n", "", "positive"),
            ("split = 'train'\n", "", "train"),
            ("seeds = [1, 1]\n", "", "seeds"),
            ("split = 'validation'\nvalidation = 0\n", "", "validation"),
            ("", "[[codec]]\nname = 'c'\ncodec = 'vq'\n", "'c' is there twice"),
            ("", "[[codec]]\nname = 'a/b'\ncodec = 'vq'\n", "'a/b' is no name"),
            ("", "[[setting]]\nname = 'x'\nsize = 0.0\n", "0 is no factor"),
            ("", "[[setting]]\nname = 'x'\nsets = []\n", "sets"),
            ("", "[[method]]\nname = 'x'\npreset = '+'\npath = 'p'\n", "path"),
            ("", "[[method]]\nname = 'x'\n", "preset"),
        ];
        for (before, after, expected) in cases {
            let message = Grid::parse("g.toml", &format!("{before}{SMALL}{after}")).unwrap_err().to_string();
            assert!(message.contains("g.toml") && message.contains(expected), "{message}");
        }
        assert!(Grid::parse("g.toml", "name = 'g'").unwrap_err().to_string().contains("scene"));
    }
}
