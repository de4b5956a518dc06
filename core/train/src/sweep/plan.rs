//! From a grid to trainings and cells, each named by what it is made of.

use super::facts::{fingerprint, listing, would_be_part};
use super::grid::{Grid, MethodAxis, SceneAxis, ScoredViews, SettingAxis};
use super::hash::{ContentHash, name_of};
use super::location::locate;
use super::overruled::refuse_minutes;
use super::result::{CodecChoice, DataFingerprint};
use super::settings::{Settings, laid_over};
use super::views::refuse_too_few;
use crate::code;
use crate::config::RunConfig;
use crate::layers::Layers;
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::exporter::refuse_other_content;
use cc4dgs_core::{Error, Registry, Result, config, plural};
use cc4dgs_play::field_weights::FieldWeights;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Value of [`Plan::kind`].
const KIND: &str = "cc4dgs-sweep";
/// Version of the file that this program writes and reads.
const SCHEMA: u32 = 1;
/// Name of the plan inside a sweep's folder.
pub const PLAN: &str = "plan.json";
/// Largest plan, bytes.
const MOST_BYTES: u64 = 1 << 30;

/// A training of a sweep; cells of several codecs share it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannedTraining {
    /// XXH3-64 of configuration, data fingerprint, code version and seed.
    pub id: String,
    /// Name of the scene.
    pub scene: String,
    /// Name of the method.
    pub method: String,
    /// Name of the setting.
    pub setting: String,
    /// Root of the seed tree.
    pub seed: u64,
    /// The preset.
    pub preset: String,
    /// Overrides of the preset, in order.
    pub sets: Vec<String>,
    /// Wall minutes that it is to take, where the grid is sized in minutes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub minutes: Option<f64>,
    /// The dataset.
    pub data: DataFingerprint,
    /// Names and sizes of its files.
    pub listing: String,
}

impl PlannedTraining {
    /// Its values on the axes of the grid, for messages.
    pub fn label(&self) -> String {
        format!("{} {} {} seed {}", self.scene, self.method, self.setting, self.seed)
    }
    /// What was said of it.
    ///
    /// # Errors
    /// As [`Layers::collect`].
    pub fn layers(&self, registry: &Registry) -> Result<Layers> {
        Layers::collect(registry, Some(&self.preset), None, &self.sets)
    }
}

/// A cell of a sweep.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlannedCell {
    /// XXH3-64 of training, codec and scored views.
    pub id: String,
    /// The training.
    pub training: String,
    /// Name of the codec.
    pub codec: String,
    /// The codec.
    pub choice: CodecChoice,
}

/// All trainings and cells of a grid.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// `cc4dgs-sweep`.
    pub kind: String,
    /// Version of this file.
    pub schema: u32,
    /// Name of the grid.
    pub name: String,
    /// Version of the program.
    pub version: String,
    /// Commit of the program; empty if unknown.
    pub commit: String,
    /// What cells are scored on.
    pub split: ScoredViews,
    /// Most images that are scored; 0 is all.
    pub max_views: usize,
    /// Images of each cell that are kept.
    pub images: usize,
    /// The trainings, in the order of their indices.
    pub trainings: Vec<PlannedTraining>,
    /// The cells, those of a training together.
    pub cells: Vec<PlannedCell>,
}

impl Plan {
    /// Expands `grid`. Every configuration is read strictly; where it is known before the scene is looked at, `check` is asked about it too.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the section of the grid, the wrong key or value, and the remedy, also for scenes with too few views; [`Error::Io`] for
    /// unreadable datasets.
    pub fn expand(grid: &Grid, registry: &Registry, check: &dyn Fn(&RunConfig) -> Result<()>) -> Result<Self> {
        let (version, commit) = code::version();
        let codecs = codecs(grid, registry)?;
        let mut plan = Self {
            kind: KIND.into(),
            schema: SCHEMA,
            name: grid.name.clone(),
            version: version.into(),
            commit: commit.into(),
            split: grid.split,
            max_views: grid.max_views,
            images: grid.images,
            trainings: Vec::new(),
            cells: Vec::new(),
        };
        let mut labels: BTreeMap<String, String> = BTreeMap::new();
        for scene in &grid.scene {
            let data = fingerprint(&scene.own.path, registry)?;
            let listing = listing(&locate(&scene.own.path)?)?;
            for (method, setting) in grid.method.iter().flat_map(|method| grid.setting.iter().map(move |setting| (method, setting))) {
                for &seed in &grid.seeds {
                    let mut training = planned(grid, scene, method, setting, seed, data.clone(), listing.clone(), registry)?;
                    let stated = stated(grid, &training, registry, check).map_err(|error| at(&training, error))?;
                    training.id = name_of(&(&stated, &data.hash, version, commit, seed))?;
                    if let Some(other) = labels.insert(training.id.clone(), training.label()) {
                        let problem = format!("'{}' and '{other}' are the same training", training.label());
                        return Err(Error::parameter(format!("grid {}", grid.name), problem, "Remove one, or change its settings"));
                    }
                    for (name, choice) in &codecs {
                        let id = name_of(&(&training.id, choice, grid.split, grid.max_views, grid.images))?;
                        plan.cells.push(PlannedCell { id, training: training.id.clone(), codec: name.clone(), choice: choice.clone() });
                    }
                    plan.trainings.push(training);
                }
            }
        }
        refuse_minutes(grid, &plan.trainings, registry).map_err(|error| within(&format!("grid {}", grid.name), error))?;
        refuse_image_sizes(&plan.trainings, registry)?;
        refuse_too_few(grid, &plan.trainings, registry)?;
        Ok(plan)
    }
    /// A name of the trainings in their order: an index means the same training as long as it is the same.
    pub fn id(&self) -> String {
        let mut hash = ContentHash::default();
        self.trainings.iter().for_each(|training| hash.part(training.id.as_bytes()));
        hash.name()
    }
    /// Refuses an index of another plan than the one called `id`.
    ///
    /// # Errors
    /// [`Error::Parameter`].
    pub fn check_id(&self, id: &str) -> Result<()> {
        if self.id() == id {
            return Ok(());
        }
        let problem = format!("the folder now has the plan {}, whose indices may be other trainings", self.id());
        Err(Error::parameter(format!("--plan {id}"), problem, "Make the job file again (cc4dgs sweep emit), or run the sweep again"))
    }
    /// Wall minutes that all trainings together are to take, each by its size; `None` where the grid is not sized in minutes.
    pub fn minutes(&self) -> Option<f64> {
        self.trainings.iter().map(|training| training.minutes).sum()
    }
    /// The cells of a training.
    pub fn cells_of<'a>(&'a self, training: &'a str) -> impl Iterator<Item = &'a PlannedCell> {
        self.cells.iter().filter(move |cell| cell.training == training)
    }
    /// Writes the plan into the folder of a sweep, in place of an earlier one.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a file, for a folder in a dataset of the plan, and for one with a `plan.json` of another kind; [`Error::Io`].
    pub fn write(&self, folder: &Path) -> Result<()> {
        if folder.is_file() {
            return Err(Error::parameter(format!("--out {}", folder.display()), "it is a file, and a sweep is a folder", "Give the name of a folder"));
        }
        for dataset in self.trainings.iter().map(|training| training.data.path.as_str()).collect::<BTreeSet<_>>() {
            if would_be_part(folder, &locate(dataset)?) {
                let problem = format!("it lies in the dataset {dataset}, which would change with every file of the sweep");
                return Err(Error::parameter(format!("--out {}", folder.display()), problem, "Name a folder outside of the dataset"));
            }
        }
        refuse_other_content(&folder.join(PLAN), "the plan of a sweep", |head| {
            String::from_utf8_lossy(head).split_whitespace().collect::<String>().starts_with(&format!("{{\"kind\":\"{KIND}\""))
        })?;
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        let json = serde_json::to_string_pretty(self).map_err(|e| Error::backend("plan", e.to_string(), "Report this: every plan should have a JSON form"))?;
        write_atomically(folder.join(PLAN), (json + "\n").as_bytes())
    }
    /// Reads the plan of the sweep in `folder`.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a folder without one, [`Error::Unsupported`] for another version of the file, [`Error::Data`] for a damaged one.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(PLAN);
        let object = path.display().to_string();
        if !path.is_file() {
            return Err(Error::parameter(format!("sweep {}", folder.display()), "there is no plan.json", "Make one: cc4dgs sweep plan GRID.toml --out DIR"));
        }
        let bytes = std::fs::metadata(&path).map_err(|e| Error::io(&path, e))?.len();
        if bytes > MOST_BYTES {
            return Err(Error::limit(object, bytes, MOST_BYTES, "Make the plan again"));
        }
        let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
        let damaged = |problem: String| Error::data(&object, problem, "Make the plan again: cc4dgs sweep plan GRID.toml --out DIR");
        #[derive(Deserialize)]
        struct Head {
            kind: String,
            schema: u32,
        }
        let head: Head = serde_json::from_str(&text).map_err(|e| damaged(e.to_string()))?;
        if head.kind != KIND {
            let problem = format!("its kind is \"{}\", a plan has \"{KIND}\"", head.kind);
            return Err(Error::data(object, problem, "Name the folder of a sweep, or make one: cc4dgs sweep plan GRID.toml --out DIR"));
        }
        if head.schema != SCHEMA {
            let problem = format!("it has version {}, this program reads version {SCHEMA}", head.schema);
            return Err(Error::unsupported(object, problem, "Make the plan again with this program"));
        }
        let plan: Self = serde_json::from_str(&text).map_err(|e| damaged(e.to_string()))?;
        // Names become paths.
        let is_id = |id: &str| id.len() == 16 && id.bytes().all(|b| b.is_ascii_hexdigit());
        let ids = plan.trainings.iter().map(|t| &t.id).chain(plan.cells.iter().flat_map(|c| [&c.id, &c.training]));
        if let Some(id) = ids.into_iter().find(|id| !is_id(id)) {
            return Err(damaged(format!("'{id}' is no name of a training or cell")));
        }
        Ok(plan)
    }
    /// Refuses a plan of another version of the program: results would be of a mixture.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names both versions.
    pub fn check_program(&self) -> Result<()> {
        let (version, commit) = code::version();
        if (self.version.as_str(), self.commit.as_str()) == (version, commit) {
            return Ok(());
        }
        let problem = format!("it was planned by cc4dgs {} ({}), this program is {version} ({commit})", self.version, self.commit);
        Err(Error::parameter(format!("sweep {}", self.name), problem, "Plan again with this program (finished cells of the old one stay), or use the old one"))
    }
}

/// The codecs of a grid, built once to find mistakes.
fn codecs(grid: &Grid, registry: &Registry) -> Result<Vec<(String, CodecChoice)>> {
    let of = |axis: &super::grid::CodecAxis| {
        let choice = axis.choice()?;
        registry.build_codec(&choice.codec, &choice.settings)?;
        FieldWeights::parse(&choice.field_weights, registry)?;
        Ok((axis.name.clone(), choice))
    };
    let mut found: Vec<(String, CodecChoice)> = Vec::new();
    for axis in &grid.codec {
        let (name, choice) = of(axis).map_err(|error| within(&format!("grid {}, codec '{}'", grid.name, axis.name), error))?;
        if let Some((same, _)) = found.iter().find(|(_, other)| *other == choice) {
            let problem = format!("the codecs '{name}' and '{same}' are the same");
            return Err(Error::parameter(format!("grid {}", grid.name), problem, "Remove one, or change its settings"));
        }
        found.push((name, choice));
    }
    Ok(found)
}

/// Everything about a training but its name.
fn planned(
    grid: &Grid,
    scene: &SceneAxis,
    method: &MethodAxis,
    setting: &SettingAxis,
    seed: u64,
    data: DataFingerprint,
    listing: String,
    registry: &Registry,
) -> Result<PlannedTraining> {
    let preset = match method.own.preset.strip_prefix('+') {
        Some("") => scene.own.family().into(),
        Some(method) => format!("{}+{method}", scene.own.family()),
        None => method.own.preset.clone(),
    };
    let size = scene.size * method.size * setting.size;
    // A preset that does not exist is refused with the name of the training, when its layers are read.
    let below = registry.preset(&preset).unwrap_or_default();
    let mut sets = laid_over(below, vec![Settings { file: Vec::new(), set: &grid.set }, scene.settings()?, method.settings()?, setting.settings()?])?;
    if let Some(iterations) = grid.iterations {
        sets.push(format!("train.iterations={}", (iterations as f64 * size).round().max(1.0)));
    }
    let minutes = grid.minutes.map(|minutes| minutes * size);
    sets.extend(minutes.map(|minutes| format!("auto.minutes={minutes:?}")));
    if grid.validation_views() > 0 {
        sets.push(format!("train.validation={}", grid.validation_views()));
    }
    sets.extend([format!("device={}", grid.device), format!("seed={seed}")]);
    let (scene, method, setting) = (scene.name.clone(), method.name.clone(), setting.name.clone());
    Ok(PlannedTraining { id: String::new(), scene, method, setting, seed, preset, sets, minutes, data, listing })
}

/// The configuration as far as it is known before the scene is looked at: all of it, or what the preset `auto` is told.
fn stated(grid: &Grid, training: &PlannedTraining, registry: &Registry, check: &dyn Fn(&RunConfig) -> Result<()>) -> Result<toml::Table> {
    let layers = training.layers(registry)?;
    let mut known = layers.config()?;
    if layers.want_plan() {
        if layers.state("deformer.kind") {
            // Settings may be stated of plug-ins that the plan will name.
            let usual: RunConfig = config::parse_section("configuration", &toml::Table::new())?;
            let sections = [
                ("density.kind", &mut known.density, usual.density),
                ("appearance.kind", &mut known.appearance, usual.appearance),
                ("poses.kind", &mut known.poses, usual.poses),
            ];
            for (key, section, usual) in sections {
                if !layers.state(key) {
                    *section = usual;
                }
            }
            check(&known)?;
        }
        return Ok(layers.table().clone());
    }
    if grid.minutes.is_some() {
        let problem = format!("preset '{}' cannot be sized in minutes", training.preset);
        return Err(Error::parameter("minutes", problem, "Use a preset auto or auto+METHOD, or size the grid in iterations"));
    }
    check(&known)?;
    config::parse_table("configuration", &known.completed(registry)?.to_toml()?)
}

/// Refuses trainings of one scene whose images would have different sizes, of which no table is made: where no size is stated, `auto` chooses it by the
/// minutes.
fn refuse_image_sizes(trainings: &[PlannedTraining], registry: &Registry) -> Result<()> {
    let mut chosen: BTreeMap<&str, (&PlannedTraining, Option<f64>)> = BTreeMap::new();
    for training in trainings {
        let layers = training.layers(registry)?;
        let config = layers.config()?;
        let scene = &config.scene;
        if !layers.want_plan() || scene.width > 0 || scene.height > 0 || scene.downscale != 1.0 {
            continue;
        }
        let minutes = config.auto.minutes;
        let (first, of_first) = *chosen.entry(&training.scene).or_insert((training, minutes));
        if of_first != minutes {
            let of = |training: &PlannedTraining, minutes: Option<f64>| match minutes {
                Some(minutes) => format!("'{}' has {minutes} {}", training.label(), plural(minutes, "minute", "minutes")),
                None => format!("'{}' has the minutes of its preset", training.label()),
            };
            let both = format!("{} and {}", of(first, of_first), of(training, minutes));
            let problem = format!("{both}: `auto` may choose another image size for each, and no table compares these");
            let remedy =
                "State scene.width, scene.height or scene.downscale in `set` of the grid or of the scene, or the same time for all (`size`, auto.minutes)";
            return Err(Error::parameter("size", problem, remedy));
        }
    }
    Ok(())
}

/// `error` with the training it is about.
pub(super) fn at(training: &PlannedTraining, error: Error) -> Error {
    within(&format!("training '{}' (preset '{}')", training.label(), training.preset), error)
}

/// `error` with where it happened.
pub(super) fn within(section: &str, error: Error) -> Error {
    match error {
        Error::Parameter { object, problem, remedy } => Error::parameter(format!("{section}: {object}"), problem, remedy),
        other => other,
    }
}

#[cfg(test)]
pub(super) mod tests;
