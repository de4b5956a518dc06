//! The nouns, the three seams, the registry and the stored form of cc4dgs.
//!
//! A plug-in crate depends on this crate alone (burn, inventory, serde and toml are re-exported in the versions it speaks): implement [`Deformer`], [`AttributeCodec`] or [`Rasterizer`] and
//! `inventory::submit!` a [`DeformerPlugin`], [`CodecPlugin`] or [`RasterizerPlugin`].

mod adapters;
mod appearance;
pub mod archive;
mod camera;
mod codec;
pub mod config;
pub mod conformance;
mod deformer;
mod density;
mod device;
mod error;
mod events;
pub mod gaussians;
mod limits;
mod loss;
pub mod metrics;
mod module_deformer;
mod offsets;
mod optimizer;
mod plugin;
mod raster;
mod registry;
mod scene;
mod schedule;
mod seed;

pub use adapters::{Adapter, AdapterKind, adapters, auto_device};
pub use appearance::{Appearance, AppearanceContext, AppearancePlugin};
pub use camera::Camera;
pub use codec::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Stream};
pub use deformer::{
    AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Parameter, ParameterGroup, Part, Simplified, SpatialFeatures, SpatialInput,
    check_attributes,
};
pub use density::{DensityControl, DensityPlan, DensityPlugin, DensityReport, RowValues, Statistic, ViewStatistics};
pub use device::{DEVICE_NAMES, parse_device};
pub use error::{Error, Result};
pub use events::{Event, EventSink, Fanout, Recorder, Silent};
pub use gaussians::{ExtraAttribute, Gaussians, HostGaussians};
pub use limits::Limits;
pub use loss::{Fusion, LossInput, LossPlugin, LossTerm};
pub use module_deformer::ModuleDeformer;
pub use offsets::Offsets;
pub use optimizer::{Optimizer, OptimizerPlugin, OptimizerState, StepSettings, state_array};
pub use plugin::{Entries, Plugin, PluginEntry, split_kind, unknown_name};
pub use raster::{ParameterSpace, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, RenderStats, RenderWork, Rules, SplatColors, Splats};
pub use registry::Registry;
pub use scene::{FrameSource, Image8, PointCloud, Scene, Split, View};
pub use schedule::{REFERENCE_ITERATIONS, Schedule, Stage};
pub use seed::Seed;
pub use {burn, inventory, serde, toml};
