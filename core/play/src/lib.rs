//! Models and their playback: what a program needs that shows a model and does not train one.
//!
//! A [`Model`] comes from the folder of a run, a checkpoint, a `.cc4d` archive, a PLY or an SPZ file; a [`Player`] draws it, through the cameras of an
//! [`Orbit`] or any others. The trainer depends on this crate, never
//! the other way.

mod archive;
pub mod bake;
pub mod checkpoint;
pub mod codec_services;
mod encoded_once;
pub mod field_weights;
mod layer_deformer;
pub mod model;
mod moving;
mod orbit;
mod orbit_views;
pub mod player;
pub mod presentation;
pub mod prune;
mod render;
pub mod source;
mod weight_importance;

pub use archive::{ArchiveOptions, ViewSource, attribute_width, load_weights, weights_of};
pub use cc4dgs_core::Moving;
pub use model::Model;
pub use moving::MovingRows;
pub use orbit::Orbit;
pub use orbit_views::OrbitViews;
pub use player::Player;
pub use render::{RenderConfig, default_rasterizer};
