//! Gaussians, cameras and scenes as tensors, the traits of plug-ins for training and playback, and the registry of cc4dgs.
//!
//! A plug-in crate depends on this crate alone (burn, glam, inventory, serde and toml are re-exported in the versions that it uses): implement a trait such as
//! [`Deformer`] or [`Rasterizer`] and submit a [`DeformerPlugin`] or [`RasterizerPlugin`] through `inventory::submit!`. Codecs need only `cc4dgs-format`, whose
//! items are re-exported here.

mod adapters;
mod appearance;
pub mod conformance;
mod deformer;
mod density;
mod depth;
mod device;
mod frame_cache;
pub mod gaussians;
mod life;
mod loss;
pub mod metrics;
mod module_deformer;
mod offsets;
mod optimizer;
mod poses;
mod preset;
mod raster;
pub mod reader;
mod registry;
pub mod sample;
mod scene;
mod schedule;
mod sum;

// burn draws its random numbers with it; the feature that this crate asks for makes it work in browsers.
#[cfg(target_arch = "wasm32")]
use getrandom as _;

pub use adapters::{Adapter, AdapterKind, adapters, auto_device};
pub use appearance::{Appearance, AppearanceContext, AppearancePlugin};
pub use burn;
pub use cc4dgs_format as format;
pub use cc4dgs_format::{
    AttributeCodec, BLUR, BLUR_RANGE, Camera, CodecContext, CodecPlugin, DeclaredLoss, DeformerContext, EncodedWeights, Entries, Error, EvaluateDeformer,
    Event, EventSink, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, ExtraAttribute, FIELD_STREAMS, Fanout, FileBytes,
    GaussianFile, HostGaussians, Image8, Limits, MOVING, Moving, NeededRows, Plugin, PluginEntry, Recorder, RenderModel, RenderedPlanes, Result, Rounding,
    Rules, Seed, Silent, Similarity, StoredModel, Stream, StreamStage, TrainingViews, TuneModel, TunedModel, Tuning, WeightArray, WeightCodec,
    WeightCodecPlugin, WeightSteps, archive, blur_at, by_likeness, canonical_stages, config, exporter, glam, inventory, playback, plugin_kind, plural, ply,
    psnr_of, psnr_on_views, read_gaussians, read_stage, read_weights, serde, split_kind, spz, storage, toml, unknown_name, weight_seed,
};
pub use deformer::{
    AttributeSpec, BuildLayer, Deformer, DeformerLayerPlugin, DeformerPlugin, DeformerWork, Parameter, ParameterGroup, Part, Simplified, SpatialFeatures,
    SpatialInput, check_attributes, check_parameters, start_deformer,
};
pub use density::{DensityControl, DensityPlan, DensityPlugin, DensityReport, RowValues, Statistic, ViewStatistics};
pub use depth::DepthImage;
pub use device::{DEVICE_NAMES, parse_device, resolved_device};
pub use gaussians::Gaussians;
pub use life::{LIFE_ATTRIBUTES, LIFE_GATE_STEEPNESS, SPACE_TIME_ATTRIBUTES, gate_value};
pub use loss::{Fusion, LossInput, LossPlugin, LossTerm};
pub use module_deformer::ModuleDeformer;
pub use offsets::Offsets;
pub use optimizer::{Optimizer, OptimizerPlugin, OptimizerState, StepSettings, path_holds, state_array};
pub use poses::{Posed, Poses, PosesContext, PosesPlugin};
pub use preset::{PresetPlugin, PresetRole};
pub use raster::{ParameterSpace, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, RenderStats, RenderWork, SplatColors, Splats};
pub use reader::{
    Background, CameraRef, DepthFile, Distortion, ImageSource, InitBox, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin, SAME_TIME, SceneOptions,
    SyncMode,
};
pub use registry::Registry;
pub use scene::{FrameSource, NoImages, PointCloud, Scene, Split, View};
pub use schedule::{REFERENCE_ITERATIONS, Schedule, Settled, Stage};
pub use sum::ordered_sum;
