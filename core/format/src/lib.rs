//! The stored form of cc4dgs: Gaussians as plain arrays, the `.cc4d` archive, the codec and exporter traits, PLY and SPZ.
//!
//! This crate does not depend on burn, and on `wasm32` not on C libraries. It is all that a codec or a small player needs. To add a codec, implement
//! [`AttributeCodec`] (or [`WeightCodec`]) and submit a [`CodecPlugin`] ([`WeightCodecPlugin`]) through `inventory::submit!`. [`storage`] has building blocks
//! that most codecs share, [`conformance`] the suites that every codec must pass. glam, inventory, serde and toml are re-exported in the versions that this
//! crate uses.

pub mod archive;
mod camera;
mod codec;
mod codec_context;
pub mod config;
pub mod conformance;
mod deformer_context;
mod error;
mod events;
pub mod exporter;
mod extent;
pub mod gaussians;
mod image;
pub mod installed;
mod limits;
mod moving;
pub mod playback;
mod plugin;
mod plural;
pub mod ply;
mod rules;
mod seed;
mod similarity;
pub mod spz;
pub mod storage;
mod stored_model;
mod tuning;
mod weight_codec;

pub use camera::Camera;
pub use codec::{AttributeCodec, CodecPlugin, DeclaredLoss, Stream, StreamStage};
pub use codec_context::{CodecContext, EvaluateDeformer, FileBytes, RenderModel, RenderedPlanes, TrainingViews, psnr_of, psnr_on_views};
pub use deformer_context::DeformerContext;
pub use error::{Error, Result};
pub use events::{Event, EventSink, Fanout, Recorder, Silent};
pub use exporter::{ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin};
pub use extent::{LEAST_NEAR, near_without_units};
pub use gaussians::{ExtraAttribute, GaussianFile, HostGaussians, NeededRows};
pub use image::Image8;
pub use limits::Limits;
pub use moving::Moving;
pub use plugin::{Entries, Plugin, PluginEntry, by_likeness, check_linked, split_kind, unknown_name};
pub use plural::plural;
pub use rules::{BLUR, BLUR_RANGE, Rules, blur_at};
pub use seed::Seed;
pub use similarity::Similarity;
pub use stored_model::{FIELD_STREAMS, MOVING, StoredModel, canonical_stages, read_gaussians, read_stage, read_weights, weight_seed};
pub use tuning::{EncodedWeights, Rounding, TuneModel, TunedModel, Tuning};
pub use weight_codec::{WeightArray, WeightCodec, WeightCodecPlugin, WeightSteps};
pub use {glam, inventory, serde, toml};
