//! Checkpoints of a training: the model ([`cc4dgs_play::checkpoint`]) and everything needed to resume to the same bytes.

use crate::config::RunConfig;
use crate::gaussian_set::GaussianSet;
use crate::schedule::StageLengths;
use crate::train::{APPEARANCE, Guard, Neighbours, POSES, Parts, RateFactors, Record, TrainState};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::Provenance;
use cc4dgs_core::{Error, Limits, OptimizerState, Registry, Result, SceneOptions, Similarity, Stage, config};
use cc4dgs_play::checkpoint::{CheckpointArrays, CheckpointFile, DeformerHeader, FORMAT, ModelHeader};
use cc4dgs_play::model::ModelSize;
use cc4dgs_play::{Model, Moving};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Everything about a checkpoint that is not an array.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Header {
    format: u32,
    model: ModelHeader,
    training: TrainingHeader,
}

/// What training needs to go on.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TrainingHeader {
    stage: Stage,
    iteration: usize,
    smooth: bool,
    /// Weights of the appearance model with their lengths.
    appearance: Vec<(String, usize)>,
    /// Weights of the pose model with their lengths.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    poses: Vec<(String, usize)>,
    /// Arrays of the density control with their lengths.
    density: Vec<(String, usize)>,
    /// Arrays of the guard of density control with their lengths.
    guard: Vec<(String, usize)>,
    /// Floats of the centres that strain is measured by.
    #[serde(default)]
    strain: usize,
    /// Arrays of the optimizer with their shapes.
    optimizer: Vec<(String, [usize; 2])>,
    /// The run's own numbers.
    #[serde(default)]
    record: Record,
    /// Step counts of the optimizer.
    optimizer_steps: BTreeMap<String, u64>,
    /// Learning rates that the watchdog lowered, by part.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    rates: BTreeMap<String, f64>,
}

/// Arrays of training by part.
#[derive(Default)]
struct TrainingArrays {
    appearance: Vec<Vec<f32>>,
    poses: Vec<Vec<f32>>,
    density: Vec<Vec<f32>>,
    guard: Vec<Vec<f32>>,
    strain: Vec<f32>,
    optimizer: Vec<Vec<f32>>,
}

/// A checkpoint read back.
pub struct Checkpoint {
    model: Model,
    training: TrainingHeader,
    arrays: TrainingArrays,
    device: Device,
}

impl Checkpoint {
    /// From the coordinates of the dataset to those of the Gaussians.
    pub fn normalisation(&self) -> Similarity {
        self.model.normalisation
    }
    /// The state to go on from, with freshly built `parts`. Refuses a configuration other than the one the run was started with; a setting that
    /// did not exist yet when the run was started has its default.
    pub fn into_state(self, run: &RunConfig, registry: &Registry, mut parts: Parts) -> Result<TrainState> {
        let stored: RunConfig = config::parse_section("configuration of the checkpoint", &self.model.provenance.config)?;
        let lengths = StageLengths::new(&stored.train, matches!(self.model.moving, Moving::Scored { .. }), 1.0);
        let settled = self.training.stage == Stage::Main && self.training.iteration > lengths.settles_at();
        let comparable = |run: &RunConfig| {
            let mut run = run.completed(registry)?;
            // What a run says about itself does not change its result.
            (run.train.log_every, run.train.checkpoint_every, run.train.checks) = (0, 0, true);
            // Neither do limits, the memory for images, and where films are decoded.
            let other = SceneOptions::default();
            (run.limits, run.scene.cache_mb, run.scene.ffmpeg, run.scene.video_cache) = (Default::default(), other.cache_mb, other.ffmpeg, other.video_cache);
            // Nothing has depended on it yet: a checkpoint may be older than what the run found.
            if !settled {
                run.train.stretch = 1.0;
            }
            config::parse_table("configuration", &run.to_toml()?)
        };
        if let Some(difference) = first_difference("", &comparable(&stored)?, &comparable(run)?) {
            return Err(Error::parameter(
                "--resume",
                format!("the configuration differs from the checkpoint's: {difference}"),
                "Resume with the run's own config.toml, or start in another folder",
            ));
        }
        let (model, training) = (self.model, self.training);
        let one = |values: &[f32]| Tensor::<1>::from_data(TensorData::new(values.to_vec(), [values.len()]), &self.device);
        let damaged = |problem: String| Error::data("checkpoint", problem, "Use another checkpoint of the run");
        let of_cameras = [
            (APPEARANCE, parts.appearance.parameters_mut(), &training.appearance, &self.arrays.appearance),
            (POSES, parts.poses.parameters_mut(), &training.poses, &self.arrays.poses),
        ];
        for (part, mut weights, stored, arrays) in of_cameras {
            let found: Vec<(String, usize)> = weights.iter().map(|p| (p.name.clone(), p.value.dims()[0])).collect();
            if found != *stored {
                return Err(damaged(format!("the plug-in of {part} has the weights {found:?}, the checkpoint {stored:?}")));
            }
            weights.iter_mut().zip(arrays).for_each(|(parameter, values)| parameter.value = one(values));
        }
        let density = training.density.iter().zip(&self.arrays.density).map(|((name, _), values)| (name.clone(), one(values))).collect();
        parts.density.restore(density, model.gaussians.len())?;
        let guard = training.guard.iter().zip(self.arrays.guard).map(|((name, _), values)| (name.clone(), values)).collect();
        let guard = Guard::restore(guard, model.gaussians.len())?;
        let two = |((name, shape), values): (&(String, [usize; 2]), &Vec<f32>)| {
            (name.clone(), Tensor::<2>::from_data(TensorData::new(values.clone(), *shape), &self.device))
        };
        let arrays = training.optimizer.iter().zip(&self.arrays.optimizer).map(two).collect();
        parts.optimizer.restore(OptimizerState { arrays, steps: training.optimizer_steps })?;
        let mut state = TrainState::new(GaussianSet::new(&model.gaussians, &self.device), model.moving, model.normalisation, model.render.focal, parts);
        (state.stage, state.iteration, state.smooth, state.deformer) = (training.stage, training.iteration, training.smooth, model.field);
        (state.guard, state.record) = (guard, training.record);
        if let Some((part, rate)) = training.rates.iter().find(|(_, rate)| !(0.0..=1.0).contains(*rate)) {
            return Err(damaged(format!("the learning rate of {part} is lowered by the factor {rate}")));
        }
        state.rates = RateFactors(training.rates);
        if !self.arrays.strain.is_empty() {
            let moving = state.moving_rows(&self.device)?.count();
            if self.arrays.strain.len() != 3 * moving {
                return Err(damaged(format!("strain is measured by {} numbers for {moving} moving Gaussians", self.arrays.strain.len())));
            }
            state.neighbours = Some(Neighbours::of(&self.arrays.strain, &self.device));
        }
        Ok(state)
    }
}

/// The first setting that differs between two configurations, with both values: that of a plug-in before its settings.
fn first_difference(section: &str, then: &toml::Table, now: &toml::Table) -> Option<String> {
    let mut keys: Vec<&String> = then.keys().chain(now.keys()).collect();
    keys.sort_by_key(|key| (key.as_str() != "kind", *key));
    let shown = |value: Option<&toml::Value>| value.map_or("nothing".to_string(), ToString::to_string);
    keys.into_iter().filter(|key| then.get(*key) != now.get(*key)).find_map(|key| {
        let name = if section.is_empty() { key.clone() } else { format!("{section}.{key}") };
        match (then.get(key), now.get(key)) {
            (Some(toml::Value::Table(then)), Some(toml::Value::Table(now))) => first_difference(&name, then, now),
            (then, now) => Some(format!("{name} was {} and is {}", shown(then), shown(now))),
        }
    })
}

/// Writes `state` to `path` and returns its size in bytes.
pub fn save(path: &Path, state: &TrainState, config: &RunConfig) -> Result<u64> {
    let mut arrays = CheckpointArrays::default();
    let mut attributes = Vec::new();
    for (name, values) in state.set.iter() {
        arrays.add(format!("gaussians/{name}"), values)?;
        attributes.push((name.to_string(), values.dims()[1]));
    }
    if let Some(deformer) = &state.deformer {
        for parameter in deformer.field.parameters() {
            arrays.add(format!("deformer/{}", parameter.name), &parameter.value)?;
        }
    }
    let mut of_cameras: [Vec<(String, usize)>; 2] = Default::default();
    for (names, (part, parameters)) in of_cameras.iter_mut().zip(state.of_cameras()) {
        for parameter in parameters {
            arrays.add(format!("{part}/{}", parameter.name), &parameter.value)?;
            names.push((parameter.name.clone(), parameter.value.dims()[0]));
        }
    }
    let [appearance, poses] = of_cameras;
    let mut density = Vec::new();
    for (name, values) in state.density.state() {
        arrays.add(format!("density/{name}"), &values)?;
        density.push((name, values.dims()[0]));
    }
    let mut guard = Vec::new();
    for (name, values) in state.guard.state() {
        let count = values.len();
        arrays.add_values(format!("guard/{name}"), vec![count], values)?;
        guard.push((name, count));
    }
    let strain = state.neighbours.as_ref().map_or(&[][..], Neighbours::means);
    if !strain.is_empty() {
        arrays.add_values("strain".into(), vec![strain.len()], strain.to_vec())?;
    }
    let optimizer_state = state.optimizer.state();
    let mut optimizer = Vec::new();
    for (name, values) in &optimizer_state.arrays {
        arrays.add(format!("optimizer/{name}"), values)?;
        optimizer.push((name.clone(), values.dims()));
    }
    let header = Header {
        format: FORMAT,
        model: ModelHeader {
            gaussians: state.set.len(),
            sh_degree: state.set.sh_degree,
            attributes,
            moving: state.moving,
            frame_count: frame_count(state),
            normalisation: state.normalisation,
            background: config.background()?,
            render: state.render(config),
            rasterizer: config.rasterizer.clone(),
            deformer: state.deformer.as_ref().map(|d| DeformerHeader { section: d.section.clone(), context: d.context.clone() }),
            provenance: provenance(config)?,
        },
        training: TrainingHeader {
            stage: state.stage,
            iteration: state.iteration,
            smooth: state.smooth,
            appearance,
            poses,
            density,
            guard,
            strain: strain.len(),
            record: state.record.clone(),
            optimizer,
            optimizer_steps: optimizer_state.steps,
            rates: state.rates.0.clone(),
        },
    };
    arrays.write(path, &header)
}

/// Reads a checkpoint. Every claim of the file is checked against its bytes and `limits`.
pub fn load(path: &Path, registry: &Registry, device: &Device, limits: &Limits) -> Result<Checkpoint> {
    let file = CheckpointFile::read(path, limits)?;
    let Header { model, training, .. } = file.header()?;
    let model = model.read(&file, registry, device, limits)?;
    let list =
        |part: &str, names: &[(String, usize)]| names.iter().map(|(name, len)| file.array(&format!("{part}/{name}"), Some(*len))).collect::<Result<Vec<_>>>();
    let optimizer = training.optimizer.iter().map(|(name, [rows, width])| file.array(&format!("optimizer/{name}"), rows.checked_mul(*width)));
    let arrays = TrainingArrays {
        appearance: list(APPEARANCE, &training.appearance)?,
        poses: list(POSES, &training.poses)?,
        density: list("density", &training.density)?,
        guard: list("guard", &training.guard)?,
        strain: if training.strain > 0 { file.array("strain", Some(training.strain))? } else { Vec::new() },
        optimizer: optimizer.collect::<Result<_>>()?,
    };
    Ok(Checkpoint { model, training, arrays, device: device.clone() })
}

/// The model that a run ends with.
pub fn trained_model(state: TrainState, config: &RunConfig) -> Result<Model> {
    let (gaussians, frame_count) = (state.set.host_gaussians()?, frame_count(&state));
    Ok(Model {
        render: state.render(config),
        size: ModelSize::float32(&gaussians, state.deformer.as_ref()),
        gaussians,
        field: state.deformer,
        moving: state.moving,
        background: Some(config.background()?),
        rasterizer: config.rasterizer.clone(),
        frame_count,
        normalisation: state.normalisation,
        provenance: provenance(config)?,
    })
}

/// Frames in the sequence the deformer was built for; 1 before the main stage.
fn frame_count(state: &TrainState) -> usize {
    state.deformer.as_ref().map_or(1, |d| d.context.frame_count)
}

fn provenance(config: &RunConfig) -> Result<Provenance> {
    let table = config.to_toml()?.parse().unwrap_or_default();
    Ok(Provenance { commit: crate::code::version().1.into(), seed: config.seed, device: config.device.clone(), config: table })
}

/// Reads only the configuration of a run's folder.
pub fn read_config(folder: &Path) -> Result<RunConfig> {
    let path = folder.join(crate::train::CONFIG);
    let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
    config::parse_section("configuration", &config::parse_table(&path.display().to_string(), &text)?)
}
