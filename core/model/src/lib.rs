//! The nouns, the three seams, the registry and the stored form of cc4dgs.
//!
//! A plug-in crate depends on this crate alone (burn, inventory, serde and toml are re-exported in the versions it speaks): implement [`DeformationField`], [`AttributeCodec`] or [`Rasterizer`] and
//! `inventory::submit!` a [`FieldPlugin`], [`CodecPlugin`] or [`RasterizerPlugin`].

mod adapters;
pub mod archive;
mod camera;
mod codec;
pub mod config;
pub mod conformance;
mod device;
mod error;
mod events;
mod field;
pub mod gaussians;
mod limits;
pub mod metrics;
mod module_field;
mod offsets;
mod plugin;
mod raster;
mod registry;
mod scene;
mod seed;

pub use adapters::{Adapter, AdapterKind, adapters, auto_device};
pub use camera::Camera;
pub use codec::{AttributeCodec, CodecContext, CodecPlugin, DeclaredLoss, Stream};
pub use device::{DEVICE_NAMES, parse_device};
pub use error::{Error, Result};
pub use events::{Event, EventSink, Fanout, Recorder, Silent};
pub use field::{AttributeSpec, DeformationField, FieldContext, FieldPlugin, FieldWork, Parameter, ParameterGroup, Part, Simplified, SpatialFeatures};
pub use gaussians::{ExtraAttribute, Gaussians, HostGaussians};
pub use limits::Limits;
pub use module_field::ModuleField;
pub use offsets::Offsets;
pub use plugin::Plugin;
pub use raster::{ParameterSpace, Rasterizer, RasterizerPlugin, RenderOutput, RenderSettings, RenderStats, RenderWork, Rules, SplatColors, Splats};
pub use registry::{Registry, split_kind, unknown_name};
pub use scene::{FrameSource, Image8, PointCloud, Scene, Split, View};
pub use seed::Seed;
pub use {burn, inventory, serde, toml};
