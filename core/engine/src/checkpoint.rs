//! Checkpoints: one safetensors file with everything needed to resume to the same bytes.

use crate::config::RunConfig;
use crate::gaussian_set::GaussianSet;
use crate::model::ModelDeformer;
use crate::train::{Moving, Parts, TrainState};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::gaussians::{CORE_ATTRIBUTES, to_vec};
use cc4dgs_core::{DeformerContext, Error, ExtraAttribute, HostGaussians, Limits, OptimizerState, Registry, Result, Similarity, Stage, config};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

const FORMAT: u32 = 2;

/// Everything about a checkpoint that is not an array.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Header {
    format: u32,
    model: ModelHeader,
    training: TrainingHeader,
    config: RunConfig,
}

/// What playback needs.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct ModelHeader {
    gaussians: usize,
    sh_degree: usize,
    /// Attributes with their widths, the core ones first.
    attributes: Vec<(String, usize)>,
    moving: Moving,
    /// From the coordinates of the dataset to those of the model.
    #[serde(default)]
    normalisation: Similarity,
    deformer: Option<DeformerHeader>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct DeformerHeader {
    section: toml::Table,
    context: DeformerContext,
}

/// What training needs to go on.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct TrainingHeader {
    stage: Stage,
    iteration: usize,
    smooth: bool,
    /// Weights of the appearance model with their lengths.
    appearance: Vec<(String, usize)>,
    /// Arrays of the density control with their lengths.
    density: Vec<(String, usize)>,
    /// Arrays of the optimizer with their shapes.
    optimizer: Vec<(String, [usize; 2])>,
    /// Step counts of the optimizer.
    optimizer_steps: BTreeMap<String, u64>,
}

/// Arrays of training by part.
#[derive(Default)]
struct TrainingArrays {
    appearance: Vec<Vec<f32>>,
    density: Vec<Vec<f32>>,
    optimizer: Vec<Vec<f32>>,
}

/// A checkpoint read back.
pub struct Checkpoint {
    header: Header,
    host: HostGaussians,
    deformer: Option<ModelDeformer>,
    training: TrainingArrays,
    device: Device,
}

impl Checkpoint {
    /// The configuration the run was started with.
    pub fn config(&self) -> &RunConfig {
        &self.header.config
    }
    /// What may move.
    pub fn moving(&self) -> Moving {
        self.header.model.moving
    }
    /// From the coordinates of the dataset to those of the model.
    pub fn normalisation(&self) -> Similarity {
        self.header.model.normalisation
    }
    /// Frames in the sequence the deformer was built for (1 before the main stage).
    pub fn frame_count(&self) -> usize {
        self.header.model.deformer.as_ref().map_or(1, |d| d.context.frame_count)
    }
    /// The Gaussians.
    pub fn gaussians(&self) -> Result<HostGaussians> {
        Ok(self.host.clone())
    }
    /// The deformer, if the main stage had begun.
    pub fn into_deformer(self) -> Option<ModelDeformer> {
        self.deformer
    }
    /// The state to go on from, with freshly built `parts`. Refuses a configuration other than the one the run was started with.
    pub fn into_state(self, config: &RunConfig, mut parts: Parts) -> Result<TrainState> {
        let (mut now, mut then) = (config.clone(), self.header.config.clone());
        // How often to say something does not change a result.
        (now.train.log_every, now.train.checkpoint_every) = (0, 0);
        (then.train.log_every, then.train.checkpoint_every) = (0, 0);
        if now.to_toml()? != then.to_toml()? {
            return Err(Error::parameter(
                "--resume",
                "the configuration differs from the checkpoint's",
                "Resume with the run's own config.toml, or start in another folder",
            ));
        }
        let Header { model, training, .. } = self.header;
        let one = |values: &[f32]| Tensor::<1>::from_data(TensorData::new(values.to_vec(), [values.len()]), &self.device);
        let damaged = |problem: String| Error::data("checkpoint", problem, "Use another checkpoint of the run");
        let mut weights = parts.appearance.parameters_mut();
        let found: Vec<(String, usize)> = weights.iter().map(|p| (p.name.clone(), p.value.dims()[0])).collect();
        if found != training.appearance {
            return Err(damaged(format!("the appearance model has the weights {found:?}, the checkpoint {:?}", training.appearance)));
        }
        weights.iter_mut().zip(&self.training.appearance).for_each(|(parameter, values)| parameter.value = one(values));
        let density = training.density.iter().zip(&self.training.density).map(|((name, _), values)| (name.clone(), one(values))).collect();
        parts.density.restore(density, model.gaussians)?;
        let two = |((name, shape), values): (&(String, [usize; 2]), &Vec<f32>)| {
            (name.clone(), Tensor::<2>::from_data(TensorData::new(values.clone(), *shape), &self.device))
        };
        let arrays = training.optimizer.iter().zip(&self.training.optimizer).map(two).collect();
        parts.optimizer.restore(OptimizerState { arrays, steps: training.optimizer_steps })?;
        let mut state = TrainState::new(GaussianSet::new(&self.host, &self.device), model.moving, model.normalisation, parts);
        (state.stage, state.iteration, state.smooth, state.deformer) = (training.stage, training.iteration, training.smooth, self.deformer);
        Ok(state)
    }
}

/// Arrays of a file, by name.
#[derive(Default)]
struct Arrays(Vec<(String, Vec<usize>, Vec<f32>)>);

impl Arrays {
    fn add<const D: usize>(&mut self, name: String, tensor: &Tensor<D>) -> Result<()> {
        let values = to_vec(tensor.clone(), &name)?;
        if values.iter().any(|v| !v.is_finite()) {
            return Err(Error::backend(
                format!("checkpoint array {name}"),
                "it holds a value that is not finite",
                "Resume from the checkpoint on disk with lower learning rates",
            ));
        }
        self.0.push((name, tensor.dims().to_vec(), values));
        Ok(())
    }
}

/// Writes `state` to `path` and returns its size in bytes.
pub fn save(path: &Path, state: &TrainState, config: &RunConfig) -> Result<u64> {
    let mut arrays = Arrays::default();
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
    let mut appearance = Vec::new();
    for parameter in state.appearance.parameters() {
        arrays.add(format!("appearance/{}", parameter.name), &parameter.value)?;
        appearance.push((parameter.name.clone(), parameter.value.dims()[0]));
    }
    let mut density = Vec::new();
    for (name, values) in state.density.state() {
        arrays.add(format!("density/{name}"), &values)?;
        density.push((name, values.dims()[0]));
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
            normalisation: state.normalisation,
            deformer: state.deformer.as_ref().map(|d| DeformerHeader { section: d.section.clone(), context: d.context.clone() }),
        },
        training: TrainingHeader {
            stage: state.stage,
            iteration: state.iteration,
            smooth: state.smooth,
            appearance,
            density,
            optimizer,
            optimizer_steps: optimizer_state.steps,
        },
        config: config.clone(),
    };
    let json = serde_json::to_string(&header).map_err(|e| Error::backend("checkpoint header", e.to_string(), "Report this"))?;
    let views: Vec<(&str, TensorView)> = arrays
        .0
        .iter()
        .map(|(name, shape, values)| {
            TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values))
                .map(|view| (name.as_str(), view))
                .map_err(|e| Error::backend(format!("checkpoint array {name}"), e.to_string(), "Report this"))
        })
        .collect::<Result<_>>()?;
    let bytes = safetensors::serialize(views, Some(HashMap::from([("cc4dgs".to_string(), json)])))
        .map_err(|e| Error::backend("checkpoint", e.to_string(), "Report this"))?;
    write_atomically(path, &bytes)?;
    Ok(bytes.len() as u64)
}

/// Reads a checkpoint. Every claim of the file is checked against its bytes and `limits`.
pub fn load(path: &Path, registry: &Registry, device: &Device, limits: &Limits) -> Result<Checkpoint> {
    let object = path.display().to_string();
    let length = std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len();
    limits.check_bytes(&object, length)?;
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let damaged = |problem: String| Error::data(object.clone(), problem, "The checkpoint is damaged or not one of this program; use another");
    let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|e| damaged(e.to_string()))?;
    let json = metadata.metadata().as_ref().and_then(|m| m.get("cc4dgs")).ok_or_else(|| damaged("the safetensors file has no cc4dgs header".into()))?;
    let version = serde_json::from_str::<serde_json::Value>(json).map_err(|e| damaged(e.to_string()))?;
    let version = version.get("format").and_then(serde_json::Value::as_u64);
    if version != Some(u64::from(FORMAT)) {
        let found = version.map_or_else(|| "checkpoint without a format number".to_string(), |v| format!("checkpoint format {v}"));
        return Err(Error::unsupported(object, found, format!("This program reads format {FORMAT}; train again, or use the program that wrote it")));
    }
    let header: Header = serde_json::from_str(json).map_err(|e| damaged(e.to_string()))?;
    limits.check_gaussians(&object, header.model.gaussians as u64)?;
    header.model.normalisation.validate(&object)?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(e.to_string()))?;
    let array = |name: &str, len: Option<usize>| -> Result<Vec<f32>> {
        let len = len.ok_or_else(|| damaged(format!("{name} claims more values than there can be")))?;
        let view = tensors.tensor(name).map_err(|e| damaged(format!("{name}: {e}")))?;
        if view.dtype() != Dtype::F32 || Some(view.data().len()) != len.checked_mul(4) {
            return Err(damaged(format!("{name} holds {} bytes of {:?}, {len} float32 values were expected", view.data().len(), view.dtype())));
        }
        let values: Vec<f32> = view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(damaged(format!("{name}[{i}] is {}", values[i]))),
            None => Ok(values),
        }
    };
    let host = gaussians(&header.model, &object, limits, &array)?;
    let deformer = match &header.model.deformer {
        None => None,
        Some(d) => {
            let mut field = registry.build_deformer(&d.section, &d.context, device)?;
            for parameter in field.parameters_mut() {
                let len: usize = parameter.shape.iter().product();
                let values = array(&format!("deformer/{}", parameter.name), Some(len))?;
                parameter.value = Tensor::from_data(TensorData::new(values, [len]), device);
            }
            Some(ModelDeformer { field, section: d.section.clone(), context: d.context.clone() })
        }
    };
    let list = |part: &str, names: &[(String, usize)]| names.iter().map(|(name, len)| array(&format!("{part}/{name}"), Some(*len))).collect::<Result<Vec<_>>>();
    let training = TrainingArrays {
        appearance: list("appearance", &header.training.appearance)?,
        density: list("density", &header.training.density)?,
        optimizer: header
            .training
            .optimizer
            .iter()
            .map(|(name, [rows, width])| array(&format!("optimizer/{name}"), rows.checked_mul(*width)))
            .collect::<Result<_>>()?,
    };
    Ok(Checkpoint { header, host, deformer, training, device: device.clone() })
}

/// The array of a name and a length; `None` is a length that does not fit into memory.
type ReadArray<'a> = dyn Fn(&str, Option<usize>) -> Result<Vec<f32>> + 'a;

/// The Gaussians of a checkpoint, checked.
fn gaussians(header: &ModelHeader, object: &str, limits: &Limits, array: &ReadArray) -> Result<HostGaussians> {
    if header.sh_degree > 4 {
        return Err(Error::data(object, format!("spherical-harmonics degree {} is over 4", header.sh_degree), "Use another checkpoint"));
    }
    let mut host = HostGaussians { sh_degree: header.sh_degree, ..Default::default() };
    for (name, width) in &header.attributes {
        let values = array(&format!("gaussians/{name}"), header.gaussians.checked_mul(*width))?;
        if CORE_ATTRIBUTES.contains(&name.as_str()) {
            host.columns_mut().into_iter().filter(|(known, _, _)| known == name).for_each(|(_, _, slot)| slot.clone_from(&values));
        } else {
            host.extra.insert(name.clone(), ExtraAttribute::exact(*width, values));
        }
    }
    host.validate(object, limits)?;
    if host.len() != header.gaussians {
        return Err(Error::data(object, format!("the header says {} Gaussians, the arrays hold {}", header.gaussians, host.len()), "Use another checkpoint"));
    }
    Ok(host)
}

/// Reads only the configuration of a run's folder.
pub fn read_config(folder: &Path) -> Result<RunConfig> {
    let path = folder.join(crate::train::CONFIG);
    let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
    config::parse_section("configuration", &config::parse_table(&path.display().to_string(), &text)?)
}
