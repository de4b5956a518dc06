//! The nouns, the three seams, the registry and the stored form of cc4dgs.
//!
//! A plug-in crate depends on this crate alone (burn, inventory, serde and toml are re-exported in the versions it speaks): implement [`Deformer`], [`AttributeCodec`] or [`Rasterizer`] and
//! `inventory::submit!` a [`DeformerPlugin`], [`CodecPlugin`] or [`RasterizerPlugin`].

mod adapters;
pub mod archive;
mod camera;
mod codec;
pub mod config;
pub mod conformance;
mod deformer;
mod device;
mod error;
mod events;
pub mod gaussians;
mod limits;
pub mod metrics;
mod module_deformer;
mod offsets;
mod plugin;
mod preset;
mod raster;
pub mod reader;
mod registry;
mod scene;
mod seed;

pub use adapters::{Adapter, AdapterKind, adapters, auto_device};
pub use camera::Camera;
pub use codec::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Stream};
pub use deformer::{AttributeSpec, Deformer, DeformerContext, DeformerPlugin, DeformerWork, Parameter, ParameterGroup, Part, Simplified, SpatialFeatures};
pub use device::{DEVICE_NAMES, parse_device};
pub use error::{Error, Result};
pub use events::{Event, EventSink, Fanout, Recorder, Silent};
pub use gaussians::{ExtraAttribute, Gaussians, HostGaussians};
pub use limits::Limits;
pub use module_deformer::ModuleDeformer;
pub use offsets::Offsets;
pub use plugin::{Entries, Plugin, PluginEntry, split_kind, unknown_name};
pub use preset::{PresetPlugin, PresetRole};
pub use raster::{ParameterSpace, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, RenderStats, RenderWork, Rules, SplatColors, Splats};
pub use reader::{Background, CameraRef, Distortion, ImageSource, RawCamera, RawPoints, RawScene, RawView, ReaderPlugin, SceneOptions};
pub use registry::Registry;
pub use scene::{FrameSource, Image8, PointCloud, Scene, Split, View};
pub use seed::Seed;
pub use {burn, inventory, serde, toml};
