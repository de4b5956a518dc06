//! cc4dgs as a library: train a dynamic scene from calibrated images, store it in a few megabytes, play it back.
//!
//! This crate is what a program depends on. It re-exports the parts of the framework, links the plug-ins that come with it, and holds what programs
//! need around them. The `cc4dgs` command is built on it; a program that wants the whole command line depends on `cc4dgs-cli` instead.

pub mod orbit;
pub mod plugins;
pub mod runs;
pub mod scenes;
pub mod video;

pub use cc4dgs_backends as backends;
pub use cc4dgs_codecs as codecs;
pub use cc4dgs_core as core;
pub use cc4dgs_deformers as deformers;
pub use cc4dgs_engine as engine;
