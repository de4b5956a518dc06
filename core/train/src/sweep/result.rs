//! The result of one cell of a sweep: what was measured, how, and where it came from. `docs/results.md` describes the file.
//!
//! Everything that differs between two equal runs (wall times, memory, clock) is in [`CellResult::cost`]; the rest of the file is the same to the byte.

use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Result, Split};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::path::Path;

/// Value of [`CellResult::kind`].
pub const KIND: &str = "cc4dgs-result";
/// The version of the schema that this program writes. It also reads version 1, in which every image was a table of its own.
pub const SCHEMA: u32 = 2;

/// One cell: a training, stored by a codec, decoded, and scored on one side of the split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CellResult {
    /// [`KIND`].
    pub kind: String,
    /// [`SCHEMA`].
    pub schema: u32,
    /// The cell: XXH3-64 of configuration, data fingerprint, code version, seed, codec and scored views; 16 hexadecimal digits.
    pub id: String,
    /// The training that the cell used, named in the same way; cells of several codecs share it.
    pub training: String,
    /// Name of the grid.
    pub sweep: String,
    /// Where the cell is in its grid.
    pub axes: Axes,
    /// Whether the training is worth having.
    pub outcome: Outcome,
    /// Why a training is hopeless.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub message: Option<String>,
    /// What it was made from.
    pub provenance: ResultProvenance,
    /// The scored side of the split.
    pub split: Split,
    /// Width and height in pixels of the first scored image.
    pub image_size: [u32; 2],
    /// Whether other scored images have another size; absent where they have not.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sizes_differ: bool,
    /// Pixels of all scored images together, where their sizes differ; absent in older results, too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scored_pixels: Option<u64>,
    /// Frames of the sequence.
    pub frames: usize,
    /// Training iterations of all stages.
    pub iterations: usize,
    /// Gaussians.
    pub gaussians: usize,
    /// Of which the deformer moves.
    pub dynamic_gaussians: usize,
    /// Means over the scored images by name: `psnr_db`, `ssim`, `ms_ssim`, `lpips`, `flip`, `psnr_dynamic_db`, …
    pub metrics: BTreeMap<String, Score>,
    /// Metrics that could not be computed, each with the reason.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub absent: BTreeMap<String, String>,
    /// Blocks of the images in which something moves, where there are any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocks: Option<Blocks>,
    /// Per scored image; columns in files.
    #[serde(with = "super::columns")]
    pub images: Vec<ImageResult>,
    /// Bytes by part.
    pub storage: Storage,
    /// How the training went; absent for runs that are too short to be judged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Value>,
    /// Training PSNR on the way.
    pub curve: Curve,
    /// Scores on the way of views that were kept out of the training, where some were; images are not rounded to 8 bits.
    #[serde(default, skip_serializing_if = "ValidationCurve::is_empty")]
    pub validation_curve: ValidationCurve,
    /// What it took: the only part that differs between equal runs.
    pub cost: Cost,
}

/// Coordinates of a cell in its grid, by the names that the grid gives.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Axes {
    /// The dataset.
    pub scene: String,
    /// The preset: how it is trained.
    pub method: String,
    /// Changes of that preset; `base` where the grid has none.
    pub setting: String,
    /// How it is stored.
    pub codec: String,
    /// Root of the seed tree.
    pub seed: u64,
}

/// Whether a training is worth having.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// Trained and scored.
    Done,
    /// Scored, but the training ended below simple baselines (exit code 6 of `cc4dgs train`).
    Hopeless,
}

/// What a result was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResultProvenance {
    /// Version of the program.
    pub version: String,
    /// Commit of the program; empty if unknown, with `-dirty-HASH` of the changes where files were changed.
    pub commit: String,
    /// XXH3-64 of `configuration`, 16 hexadecimal digits.
    pub configuration_hash: String,
    /// The whole configuration of the training, as `config.toml` has it.
    pub configuration: Value,
    /// How the model was stored.
    pub codec: CodecChoice,
    /// The dataset.
    pub data: DataFingerprint,
    /// What the cell was stored, read and scored on; [`Cost::training_devices`] has those of the training.
    pub device: DeviceFacts,
}

/// A codec with its settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CodecChoice {
    /// `NAME[:PROFILE]`.
    pub codec: String,
    /// Weight codec of the deformer: see [`cc4dgs_play::field_weights::FieldWeights::parse`].
    pub field_weights: String,
    /// Settings over the profile's.
    #[serde(default)]
    pub settings: toml::Table,
}

/// A dataset by its content.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DataFingerprint {
    /// The dataset as the grid names it.
    pub path: String,
    /// XXH3-64 of the names and contents of all files, 16 hexadecimal digits; of the name alone for built-in scenes.
    pub hash: String,
    /// Number of files; 0 for built-in scenes.
    pub files: u64,
    /// Their bytes together.
    pub bytes: u64,
}

/// What a result was computed on: in [`ResultProvenance`], what it was stored, read and scored on. Results of different devices are not put into one table;
/// times of trainings on different devices are marked in one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceFacts {
    /// Name of the device: `flex`, `ndarray`, `wgpu`, `cuda`.
    pub name: String,
    /// The graphics adapter, where one computes.
    pub adapter: Option<String>,
    /// Its driver with version.
    pub driver: Option<String>,
    /// Model of the processor, as the system names it; empty if unknown.
    pub processor: String,
    /// Threads of the processor that computed.
    pub threads: usize,
    /// Operating system and architecture, such as `linux x86_64`.
    pub system: String,
}

/// What a training was computed on. The process that scores its cells may be another one.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TrainingDevice {
    /// The device.
    #[serde(flatten)]
    pub device: DeviceFacts,
    /// Name of the machine; empty if unknown.
    pub host: String,
}

/// The mean of a metric over the scored images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Score {
    /// The mean.
    pub value: f64,
    /// Everything it depends on besides the images ([`cc4dgs_core::metrics::Protocol`]): formula, convention, range, rounding, window, padding, mask, frames.
    pub protocol: Map<String, Value>,
}

/// Blocks of the images in which something moves ([`crate::blocks`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Blocks {
    /// PSNR of the worst moving block of an image, mean over images, dB.
    pub worst_psnr_db: f64,
    /// Share of the moving blocks whose render is nearer to what the camera usually sees than to the truth.
    pub lost: f64,
}

/// One scored image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageResult {
    /// Name of the camera.
    pub camera: String,
    /// Frame, 0-based.
    pub frame: usize,
    /// Time in 0..1.
    pub time_norm: f32,
    /// Scores by the names of [`CellResult::metrics`], to five decimals; what an image cannot have is missing.
    pub scores: BTreeMap<String, f64>,
    /// Moving blocks, of which lost, and PSNR of the worst in dB.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocks: Option<(usize, usize, f64)>,
    /// Ground truth as a PNG file relative to the sweep's folder. These files stay local.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub truth: Option<String>,
    /// The render, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render: Option<String>,
}

/// Bytes by part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Storage {
    /// The archive on disk.
    pub total_bytes: u64,
    /// Streams of the deformer.
    pub deform_bytes: u64,
    /// Streams of the Gaussians.
    pub point_cloud_bytes: u64,
    /// Float32 size of the deformer's spatial encoding (the paper's Deform-Grid).
    pub deform_grid_f32_bytes: u64,
    /// Float32 size of the rest of the deformer (the paper's Deform-Net).
    pub deform_net_f32_bytes: u64,
    /// Float32 size of the Gaussians.
    pub point_cloud_f32_bytes: u64,
    /// The streams of the archive.
    pub streams: Vec<StreamBytes>,
}

/// One stream of an archive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StreamBytes {
    /// Its name.
    pub name: String,
    /// `canonical`, `field`, `meta`, `playback`, `poster` or `other`.
    pub kind: String,
    /// On disk.
    pub stored_bytes: u64,
    /// Decoded.
    pub decoded_bytes: u64,
}

/// Training PSNR on the way, at most [`Curve::MOST_POINTS`] points: columns of equal length.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Iteration over all stages, from 1.
    pub iteration: Vec<usize>,
    /// PSNR of the training views of recent iterations, smoothed, dB; images are not rounded to 8 bits.
    pub psnr_db: Vec<f64>,
    /// Gaussians.
    pub gaussians: Vec<usize>,
}

impl Curve {
    /// Most points of a curve.
    pub const MOST_POINTS: usize = 100;
}

/// PSNR on the way of views that are kept out of a training: columns of equal length.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ValidationCurve {
    /// Iteration over all stages, from 1.
    pub iteration: Vec<usize>,
    /// Mean PSNR of at most eight views, dB.
    pub psnr_db: Vec<f64>,
}

impl ValidationCurve {
    fn is_empty(&self) -> bool {
        self.iteration.is_empty()
    }
}

/// What a result took. Seconds of wall time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// The training with all that belongs to it, repeated work after interruptions included.
    pub training_seconds: f64,
    /// What [`Cost::training_seconds`] were spent on: a device per process that worked on the training, each different one once. Empty in older results.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub training_devices: Vec<TrainingDevice>,
    /// Stages of the training: `coarse`, `score`, `main`.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Times at which the training went on after an interruption.
    pub resumed: usize,
    /// Seconds since the training began, for each point of [`CellResult::curve`].
    pub curve_seconds: Vec<f64>,
    /// The same for each point of [`CellResult::validation_curve`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub validation_seconds: Vec<f64>,
    /// Codec and writing of the archive.
    pub encode_seconds: f64,
    /// Reading the archive back into a model.
    pub decode_seconds: f64,
    /// Rendering and scoring the images.
    pub evaluation_seconds: f64,
    /// Milliseconds of a frame.
    pub frame_ms: FrameMs,
    /// Milliseconds of each scored image, deformer and rasterizer together, in the order of [`CellResult::images`].
    pub frame_ms_each: Vec<f64>,
    /// Most resident memory of the process while it trained, from the last interruption on, MB (10^6 bytes); absent where the system does not tell. Results
    /// of version 1 call it `peak_memory_mb`.
    #[serde(default, alias = "peak_memory_mb")]
    pub training_peak_memory_mb: Option<f64>,
    /// The same while the cell was stored, read back and scored; images of the scene count as well.
    #[serde(default)]
    pub cell_peak_memory_mb: Option<f64>,
    /// When the result was written, seconds since 1970.
    pub finished_unix: u64,
}

/// Milliseconds of a frame on the device, synchronised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FrameMs {
    /// Mean of all frames but the first.
    pub mean: f64,
    /// Deformer, first frame: spatial features are computed.
    pub field_first: f64,
    /// Rasterizer, first frame.
    pub raster_first: f64,
    /// Deformer, median of the other frames.
    pub field: f64,
    /// Rasterizer, median of the other frames.
    pub raster: f64,
}

impl CellResult {
    /// The result as one line of JSON.
    ///
    /// # Errors
    /// [`Error::Backend`] for numbers that JSON cannot write.
    pub fn to_line(&self) -> Result<String> {
        serde_json::to_string(self).map_err(|e| Error::backend("result", e.to_string(), "Report this: every result should have a JSON form"))
    }
    /// Writes the result to `path`, all or nothing.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        write_atomically(path, (self.to_line()? + "\n").as_bytes())
    }
    /// Reads one result from JSON text; `object` names it in errors.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for another version of the schema, [`Error::Data`] for text that is no result.
    pub fn from_json(object: &str, text: &str) -> Result<Self> {
        let value = serde_json::from_str(text).map_err(|e| Error::data(object, e.to_string(), "Remove the file and run the cell again"))?;
        Self::from_value(object, value)
    }
    /// As [`CellResult::from_json`], from JSON that has been read.
    pub(super) fn from_value(object: &str, value: Value) -> Result<Self> {
        let damaged = |problem: String| Error::data(object, problem, "Remove the file and run the cell again");
        let schema = value.get("schema").and_then(Value::as_u64);
        match (value.get("kind").and_then(Value::as_str).unwrap_or_default(), schema) {
            (KIND, Some(version)) if (1..=u64::from(SCHEMA)).contains(&version) => {}
            (KIND, Some(other)) => {
                let problem = format!("it has version {other} of the result schema, this program reads versions 1 to {SCHEMA}");
                return Err(Error::unsupported(object, problem, "Use the program that wrote it, or run the cell again"));
            }
            (KIND, None) => return Err(damaged("it states no version of the result schema".into())),
            (other, _) => {
                let problem = format!("its kind is \"{other}\", a result has \"{KIND}\"");
                return Err(Error::data(object, problem, "Name a result of a sweep, or the folder of one: docs/results.md describes them"));
            }
        }
        let result: Self = serde_json::from_value(value).map_err(|e| damaged(e.to_string()))?;
        // Older forms are brought to this one by reading them.
        let result = Self { schema: SCHEMA, ..result };
        let points = result.curve.iteration.len();
        if [result.curve.psnr_db.len(), result.curve.gaussians.len(), result.cost.curve_seconds.len()].iter().any(|len| *len != points) {
            return Err(damaged("the columns of its training curve differ in length".into()));
        }
        let points = result.validation_curve.iteration.len();
        if [result.validation_curve.psnr_db.len(), result.cost.validation_seconds.len()].iter().any(|len| *len != points) {
            return Err(damaged("the columns of its validation curve differ in length".into()));
        }
        Ok(result)
    }
    /// The size of its images for people.
    pub fn image_sizes(&self) -> String {
        if self.sizes_differ { "various sizes".into() } else { format!("{}x{} pixels", self.image_size[0], self.image_size[1]) }
    }
    /// Megabytes (10^6 bytes) of the archive.
    pub fn size_mb(&self) -> f64 {
        self.storage.total_bytes as f64 / 1e6
    }
}
