//! The engine: readers, initialisation, the three-stage trainer, checkpoints, playback, evaluation. It names no concrete plug-in.

pub mod agreement;
pub mod checkpoint;
pub mod codec_services;
pub mod config;
pub mod data;
pub mod eval;
pub mod gaussian_set;
pub mod images;
pub mod init;
pub mod knn;
pub mod masks;
pub mod model;
pub mod play;
pub use cc4dgs_core::ply;
pub mod presets;
pub mod schedule;
pub mod source;
pub mod train;
pub mod trajectory;
