//! Checkpoints: one safetensors file with everything needed to resume to the same bytes.

use crate::columns::{GaussianSet, HostColumn, host_gaussians};
use crate::config::RunConfig;
use crate::densify::ScreenStats;
use crate::schedule::Stage;
use crate::train::{FieldOptimizer, Moving, TrainState};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Deformer, DeformerContext, Error, HostGaussians, Limits, Registry, Result, config};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;

const FORMAT: u32 = 1;

/// Everything about a checkpoint that is not an array.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Header {
    format: u32,
    stage: Stage,
    iteration: usize,
    gaussians: usize,
    sh_degree: usize,
    gaussian_step: u64,
    columns: Vec<(String, usize)>,
    moving: Moving,
    smooth: bool,
    field: Option<FieldHeader>,
    config: RunConfig,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct FieldHeader {
    section: toml::Table,
    context: DeformerContext,
    step: u64,
}

/// A checkpoint read back.
pub struct Checkpoint {
    header: Header,
    columns: Vec<HostColumn>,
    stats: [Vec<f32>; 3],
    field: Option<FieldOptimizer>,
    device: Device,
}

impl Checkpoint {
    /// The configuration the run was started with.
    pub fn config(&self) -> &RunConfig {
        &self.header.config
    }
    /// What may move.
    pub fn moving(&self) -> Moving {
        self.header.moving
    }
    /// Frames in the sequence the field was built for (1 before the main stage).
    pub fn frame_count(&self) -> usize {
        self.header.field.as_ref().map_or(1, |f| f.context.frame_count)
    }
    /// The Gaussians.
    pub fn gaussians(&self) -> Result<HostGaussians> {
        host_gaussians(self.header.sh_degree, self.columns.iter().map(|c| Ok((c.name.clone(), c.width, c.arrays[0].clone()))))
    }
    /// The field with its section and context, if the main stage had begun.
    pub fn into_field(self) -> Option<(Box<dyn Deformer>, toml::Table, DeformerContext)> {
        self.field.map(|f| (f.field, f.section, f.context))
    }
    /// The state to go on from. Refuses a configuration other than the one the run was started with.
    pub fn into_state(self, config: &RunConfig) -> Result<TrainState> {
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
        let h = self.header;
        let set = GaussianSet::from_host(self.columns, h.gaussians, h.sh_degree, h.gaussian_step, &self.device);
        let [gradient_sum, seen, max_weight] = self.stats.map(|v| Tensor::<1>::from_data(TensorData::new(v, [h.gaussians]), &self.device));
        Ok(TrainState::restored(h.stage, h.iteration, set, ScreenStats { gradient_sum, seen, max_weight }, h.moving, self.field, h.smooth))
    }
}

/// Writes `state` to `path` and returns its size in bytes.
pub fn save(path: &Path, state: &TrainState, config: &RunConfig) -> Result<u64> {
    let columns = state.set.to_host()?;
    let mut arrays: Vec<(String, Vec<usize>, Vec<f32>)> = Vec::new();
    let n = state.set.len();
    let names: Vec<(String, usize)> = columns.iter().map(|c| (c.name.clone(), c.width)).collect();
    for column in columns {
        for (kind, values) in ["value", "first_moment", "second_moment"].into_iter().zip(column.arrays) {
            arrays.push((format!("gaussians/{}/{kind}", column.name), vec![n, column.width], values));
        }
    }
    let stats = [("gradient_sum", &state.stats.gradient_sum), ("seen", &state.stats.seen), ("max_weight", &state.stats.max_weight)];
    for (name, tensor) in stats {
        arrays.push((format!("stats/{name}"), vec![n], to_vec(tensor.clone(), name)?));
    }
    if let Some(optimizer) = &state.field {
        for (parameter, [first, second]) in optimizer.field.parameters().into_iter().zip(&optimizer.moments) {
            for (kind, tensor) in [("value", &parameter.value), ("first_moment", first), ("second_moment", second)] {
                let values = to_vec(tensor.clone(), &parameter.name)?;
                arrays.push((format!("field/{}/{kind}", parameter.name), vec![values.len()], values));
            }
        }
    }
    if let Some((name, _, _)) = arrays.iter().find(|(_, _, values)| values.iter().any(|v| !v.is_finite())) {
        return Err(Error::backend(
            format!("checkpoint array {name}"),
            "it holds a value that is not finite",
            "Resume from the checkpoint on disk with lower learning rates",
        ));
    }
    let header = Header {
        format: FORMAT,
        stage: state.stage,
        iteration: state.iteration,
        gaussians: n,
        sh_degree: state.set.sh_degree,
        gaussian_step: state.set.step,
        columns: names,
        moving: state.moving,
        smooth: state.smooth,
        field: state.field.as_ref().map(|f| FieldHeader { section: f.section.clone(), context: f.context.clone(), step: f.step }),
        config: config.clone(),
    };
    let json = serde_json::to_string(&header).map_err(|e| Error::backend("checkpoint header", e.to_string(), "Report this"))?;
    let views: Vec<(&str, TensorView)> = arrays
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
    let json = metadata.metadata().as_ref().and_then(|m| m.get("cc4dgs")).ok_or_else(|| damaged("there is no cc4dgs header".into()))?;
    let version = serde_json::from_str::<serde_json::Value>(json).map_err(|e| damaged(e.to_string()))?;
    if version.get("format").and_then(serde_json::Value::as_u64) != Some(u64::from(FORMAT)) {
        return Err(Error::unsupported(object, format!("checkpoint format {:?}", version.get("format")), format!("This program reads format {FORMAT}")));
    }
    let header: Header = serde_json::from_str(json).map_err(|e| damaged(e.to_string()))?;
    limits.check_gaussians(&object, header.gaussians as u64)?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(|e| damaged(e.to_string()))?;
    let array = |name: &str, len: usize| -> Result<Vec<f32>> {
        let view = tensors.tensor(name).map_err(|e| damaged(format!("{name}: {e}")))?;
        if view.dtype() != Dtype::F32 || view.data().len() != 4 * len {
            return Err(damaged(format!("{name} holds {} bytes of {:?}, {len} float32 values were expected", view.data().len(), view.dtype())));
        }
        let values: Vec<f32> = view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(damaged(format!("{name}[{i}] is {}", values[i]))),
            None => Ok(values),
        }
    };
    let n = header.gaussians;
    let mut columns = Vec::new();
    for (name, width) in &header.columns {
        let kinds = ["value", "first_moment", "second_moment"];
        let len = n.checked_mul(*width).ok_or_else(|| damaged(format!("column {name} claims width {width}")))?;
        let arrays = [
            array(&format!("gaussians/{name}/{}", kinds[0]), len)?,
            array(&format!("gaussians/{name}/{}", kinds[1]), len)?,
            array(&format!("gaussians/{name}/{}", kinds[2]), len)?,
        ];
        columns.push(HostColumn { name: name.clone(), width: *width, arrays });
    }
    let host = host_gaussians(header.sh_degree, columns.iter().map(|c| Ok((c.name.clone(), c.width, c.arrays[0].clone()))))?;
    host.validate(&object, limits)?;
    if columns.len() < 7 || columns.iter().zip(crate::columns::CORE_COLUMNS).any(|(c, name)| c.name != name) {
        return Err(damaged("a core column is missing or out of order".into()));
    }
    let stats = [array("stats/gradient_sum", n)?, array("stats/seen", n)?, array("stats/max_weight", n)?];
    let field = match &header.field {
        None => None,
        Some(f) => {
            let field = registry.build_deformer(&f.section, &f.context, device)?;
            let mut optimizer = FieldOptimizer::new(field, f.section.clone(), f.context.clone());
            optimizer.step = f.step;
            let shapes: Vec<(String, usize)> = optimizer.field.parameters().iter().map(|p| (p.name.clone(), p.shape.iter().product())).collect();
            for (i, (name, len)) in shapes.iter().enumerate() {
                let [value, first, second] = ["value", "first_moment", "second_moment"].map(|kind| array(&format!("field/{name}/{kind}"), *len));
                let upload = |values: Vec<f32>| Tensor::<1>::from_data(TensorData::new(values, [*len]), device);
                optimizer.field.parameters_mut()[i].value = upload(value?);
                optimizer.moments[i] = [upload(first?), upload(second?)];
            }
            Some(optimizer)
        }
    };
    Ok(Checkpoint { header, columns, stats, field, device: device.clone() })
}

/// Reads only the configuration of a run's folder.
pub fn read_config(folder: &Path) -> Result<RunConfig> {
    let path = folder.join(crate::train::CONFIG);
    let text = std::fs::read_to_string(&path).map_err(|e| Error::io(&path, e))?;
    config::parse_section("configuration", &config::parse_table(&path.display().to_string(), &text)?)
}
