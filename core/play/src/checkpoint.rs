//! Checkpoints: one safetensors file with a header and float32 arrays. This is the file, and the half of it that playback needs; what training needs to go on
//! lies beside it and is nobody's business here.
//!
//! The metadata of the file has one entry, `cc4dgs`: sixteen hexadecimal digits, a space, and the header as JSON. The digits are the XXH3-64 of the header and,
//! in the order of their names, of every array's name, type, shape and bytes.

use crate::archive::linked;
use crate::model::{Model, ModelDeformer, ModelSize};
use crate::{Moving, RenderConfig};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::{MOST_FRAMES, Provenance, write_atomically};
use cc4dgs_core::gaussians::{CORE_ATTRIBUTES, to_vec};
use cc4dgs_core::{DeformerContext, Error, ExtraAttribute, HostGaussians, Limits, Registry, Result, Similarity, split_kind};
use safetensors::tensor::{Dtype, Metadata, SafeTensors, TensorInfo, TensorView};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::path::Path;
use xxhash_rust::xxh3::Xxh3;

/// Name of the checkpoint inside a run's folder.
pub const CHECKPOINT: &str = "checkpoint";
/// The format this program writes and reads.
pub const FORMAT: u32 = 3;
/// The one entry of the metadata.
const ENTRY: &str = "cc4dgs";
/// Bytes before the safetensors header: its length.
const LENGTH_BYTES: usize = 8;

/// Arrays on their way into a checkpoint, by name.
#[derive(Default)]
pub struct CheckpointArrays(Vec<(String, Vec<usize>, Vec<f32>)>);

impl CheckpointArrays {
    /// Adds the values of `tensor`. Refuses values that are not finite: a checkpoint is there to go on from.
    pub fn add<const D: usize>(&mut self, name: String, tensor: &Tensor<D>) -> Result<()> {
        let values = to_vec(tensor.clone(), &name)?;
        self.add_values(name, tensor.dims().to_vec(), values)
    }
    /// Adds `values` of `shape`, as [`CheckpointArrays::add`].
    pub fn add_values(&mut self, name: String, shape: Vec<usize>, values: Vec<f32>) -> Result<()> {
        if values.iter().any(|v| !v.is_finite()) {
            return Err(Error::backend(
                format!("checkpoint array {name}"),
                "it holds a value that is not finite",
                "Start again in another folder with lower learning rates (train.lr)",
            ));
        }
        self.0.push((name, shape, values));
        Ok(())
    }
    /// Writes a checkpoint of these arrays and `header`, all or nothing, and returns its size in bytes. `header` should hold `format: FORMAT`.
    pub fn write(&self, path: &Path, header: &impl Serialize) -> Result<u64> {
        let failed = |e: &dyn std::fmt::Display| Error::backend("checkpoint", e.to_string(), "Report this: every state should have a stored form");
        let json = serde_json::to_string(header).map_err(|e| failed(&e))?;
        let views: Vec<(&str, TensorView)> = self
            .0
            .iter()
            .map(|(name, shape, values)| Ok((name.as_str(), TensorView::new(Dtype::F32, shape.clone(), bytemuck::cast_slice(values)).map_err(|e| failed(&e))?)))
            .collect::<Result<_>>()?;
        let arrays = views.iter().map(|(name, view)| (*name, view.dtype(), view.shape(), view.data())).collect();
        let entry = format!("{:016x} {json}", checksum(&json, arrays));
        let bytes = safetensors::serialize(views, Some(HashMap::from([(ENTRY.to_string(), entry)]))).map_err(|e| failed(&e))?;
        write_atomically(path, &bytes)?;
        Ok(bytes.len() as u64)
    }
}

/// Name, type, shape and bytes of an array.
type ArrayBytes<'a> = (&'a str, Dtype, &'a [usize], &'a [u8]);

fn checksum(json: &str, mut arrays: Vec<ArrayBytes>) -> u64 {
    arrays.sort_by_key(|(name, ..)| *name);
    let mut hash = Xxh3::new();
    // Every part is preceded by its length, so that no two different files are one sequence of bytes.
    let mut part = |bytes: &[u8]| {
        hash.update(&(bytes.len() as u64).to_le_bytes());
        hash.update(bytes);
    };
    part(json.as_bytes());
    for (name, dtype, shape, data) in arrays {
        part(name.as_bytes());
        part(format!("{dtype:?}{shape:?}").as_bytes());
        part(data);
    }
    hash.digest()
}

/// A checkpoint in memory whose checksum holds.
pub struct CheckpointFile {
    object: String,
    header: String,
    bytes: Vec<u8>,
    /// Where the arrays begin.
    data: usize,
    metadata: Metadata,
}

impl CheckpointFile {
    /// Reads the checkpoint at `path` and checks its format and its checksum.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for other formats, [`Error::Data`] for files that are damaged or no checkpoints, [`Error::Limit`] for files over `limits`.
    pub fn read(path: &Path, limits: &Limits) -> Result<Self> {
        Self::from_bytes(path.display().to_string(), limits.read_file(path)?)
    }
    /// [`CheckpointFile::read`] of a file in memory; `object` names it in errors.
    pub fn from_bytes(object: String, bytes: Vec<u8>) -> Result<Self> {
        let (header_len, metadata) = SafeTensors::read_metadata(&bytes).map_err(|e| damaged(&object, e.to_string()))?;
        let entry = metadata.metadata().as_ref().and_then(|m| m.get(ENTRY));
        let entry = entry.ok_or_else(|| damaged(&object, "the safetensors file has no cc4dgs header".into()))?;
        let Some((stored, header)) = entry.split_once(' ').filter(|(digits, _)| digits.len() == 16) else {
            return Err(other_format(&object, entry));
        };
        let (stored, header) = (u64::from_str_radix(stored, 16).ok(), header.to_string());
        let file = Self { object, header, data: LENGTH_BYTES + header_len, metadata, bytes };
        let tensors = file.metadata.tensors();
        let arrays =
            tensors.iter().map(|(name, info)| Ok((name.as_str(), info.dtype, info.shape.as_slice(), file.data(name, info)?))).collect::<Result<_>>()?;
        if stored != Some(checksum(&file.header, arrays)) {
            return Err(file.damaged("its checksum does not match".into()));
        }
        #[derive(Deserialize)]
        struct Format {
            format: u32,
        }
        match file.header::<Format>()?.format {
            FORMAT => Ok(file),
            _ => Err(other_format(&file.object, &file.header)),
        }
    }
    /// The header, or those fields of it that `T` has.
    pub fn header<T: DeserializeOwned>(&self) -> Result<T> {
        serde_json::from_str(&self.header).map_err(|e| self.damaged(e.to_string()))
    }
    /// The array `name`, which must hold `len` finite float32 values; `None` is a claimed length that no memory could hold.
    pub fn array(&self, name: &str, len: Option<usize>) -> Result<Vec<f32>> {
        let len = len.ok_or_else(|| self.damaged(format!("{name} claims more values than there can be")))?;
        let info = self.metadata.info(name).ok_or_else(|| self.damaged(format!("the array {name} is missing")))?;
        let data = self.data(name, info)?;
        if info.dtype != Dtype::F32 || Some(data.len()) != len.checked_mul(4) {
            return Err(self.damaged(format!("{name} holds {} bytes of {:?}, {len} float32 values were expected", data.len(), info.dtype)));
        }
        let values: Vec<f32> = data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        match values.iter().position(|v| !v.is_finite()) {
            Some(i) => Err(self.damaged(format!("{name}[{i}] is {}", values[i]))),
            None => Ok(values),
        }
    }
    /// An error about this file.
    pub fn damaged(&self, problem: String) -> Error {
        damaged(&self.object, problem)
    }
    fn data(&self, name: &str, info: &TensorInfo) -> Result<&[u8]> {
        let (from, to) = info.data_offsets;
        let range = self.data.checked_add(from).zip(self.data.checked_add(to)).and_then(|(from, to)| self.bytes.get(from..to));
        range.ok_or_else(|| self.damaged(format!("the array {name} lies outside the file")))
    }
}

fn damaged(object: &str, problem: String) -> Error {
    Error::data(object, problem, "The checkpoint is damaged or not one of this program; use another")
}

/// A header that another program wrote: the error names its format.
fn other_format(object: &str, header: &str) -> Error {
    let format = serde_json::from_str::<serde_json::Value>(header).ok().and_then(|v| v.get("format").and_then(serde_json::Value::as_u64));
    match format {
        Some(format) => Error::unsupported(
            object,
            format!("checkpoint format {format}"),
            format!("This program reads format {FORMAT}; train again, or use the program that wrote it"),
        ),
        None => damaged(object, "its cc4dgs header is not understood".into()),
    }
}

/// What a checkpoint says of its model. The arrays are `gaussians/NAME` `[N,width]` per attribute and `deformer/NAME` per weight array.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ModelHeader {
    /// Gaussians N.
    pub gaussians: usize,
    /// Spherical-harmonics degree, 0 to 4.
    pub sh_degree: usize,
    /// Attributes with their widths, those of every Gaussian first.
    pub attributes: Vec<(String, usize)>,
    /// What may move.
    pub moving: Moving,
    /// Frames in the sequence; 1 before the main stage.
    pub frame_count: usize,
    /// From the coordinates of the dataset to those of the model.
    pub normalisation: Similarity,
    /// Colour behind everything, RGB in 0..1.
    pub background: [f32; 3],
    /// How it wants to be drawn.
    pub render: RenderConfig,
    /// The `[rasterizer]` section.
    pub rasterizer: toml::Table,
    /// The deformer, if the main stage had begun.
    pub deformer: Option<DeformerHeader>,
    /// Where it comes from, with the whole configuration of the run.
    pub provenance: Provenance,
}

/// What builds the deformer again.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct DeformerHeader {
    /// Its `[deformer]` section.
    pub section: toml::Table,
    /// What it was told of the scene.
    pub context: DeformerContext,
}

impl ModelHeader {
    /// The model of `file`. Every claim is checked against the bytes and `limits`.
    pub fn read(self, file: &CheckpointFile, registry: &Registry, device: &Device, limits: &Limits) -> Result<Model> {
        let gaussians = self.host_gaussians(file, limits)?;
        self.normalisation.validate(&file.object)?;
        let field = match self.deformer {
            None => None,
            Some(DeformerHeader { section, context }) => {
                context.validate(&file.object)?;
                let (kind, _) = split_kind("deformer", &section).map_err(|e| e.of_file(&file.object))?;
                linked(&file.object, "deformer", &kind, None, registry)?;
                let mut field = registry.build_deformer(&section, &context, device).map_err(|e| e.of_file(&file.object))?;
                for parameter in field.parameters_mut() {
                    let len: usize = parameter.shape.iter().product();
                    let values = file.array(&format!("deformer/{}", parameter.name), Some(len))?;
                    parameter.value = Tensor::from_data(TensorData::new(values, [len]), device);
                }
                Some(ModelDeformer { field, section, context })
            }
        };
        if !self.background.iter().all(|v| v.is_finite()) || !(1..=MOST_FRAMES).contains(&self.frame_count) {
            return Err(file.damaged(format!("the background is {:?}, frame_count {}", self.background, self.frame_count)));
        }
        Ok(Model {
            size: ModelSize::float32(&gaussians, field.as_ref()),
            gaussians,
            field,
            moving: self.moving,
            render: self.render,
            background: Some(self.background),
            rasterizer: self.rasterizer,
            frame_count: self.frame_count,
            normalisation: self.normalisation,
            provenance: self.provenance,
        })
    }
    fn host_gaussians(&self, file: &CheckpointFile, limits: &Limits) -> Result<HostGaussians> {
        limits.check_gaussians(&file.object, self.gaussians as u64)?;
        if self.sh_degree > 4 {
            return Err(file.damaged(format!("spherical-harmonics degree {} is over 4", self.sh_degree)));
        }
        let mut host = HostGaussians { sh_degree: self.sh_degree, ..Default::default() };
        for (name, width) in &self.attributes {
            let values = file.array(&format!("gaussians/{name}"), self.gaussians.checked_mul(*width))?;
            if CORE_ATTRIBUTES.contains(&name.as_str()) {
                host.columns_mut().into_iter().filter(|(known, _, _)| known == name).for_each(|(_, _, slot)| slot.clone_from(&values));
            } else {
                host.extra.insert(name.clone(), ExtraAttribute::exact(*width, values));
            }
        }
        host.validate_read(&file.object, limits)?;
        if host.len() != self.gaussians {
            return Err(file.damaged(format!("the header says {} Gaussians, the arrays hold {}", self.gaussians, host.len())));
        }
        Ok(host)
    }
}

/// The model of the checkpoint at `path`, without what training needs.
pub fn read_model(path: &Path, registry: &Registry, device: &Device, limits: &Limits) -> Result<Model> {
    #[derive(Deserialize)]
    struct Header {
        model: ModelHeader,
    }
    let file = CheckpointFile::read(path, limits)?;
    file.header::<Header>()?.model.read(&file, registry, device, limits)
}
