//! cc4dgs as a library: train a dynamic scene from calibrated images, store it in a few megabytes, play it back.
//!
//! A [`Session`] is where everything begins. This program opens a model (the folder of a run, a checkpoint, an archive, a PLY or an SPZ file) and writes one
//! image of it:
//!
//! ```no_run
//! use cc4dgs::{Orbit, Result, Session, write_png};
//!
//! fn main() -> Result<()> {
//!     let session = Session::new()?;
//!     let model = session.open("mutant.cc4d")?;
//!     let camera = Orbit::default().around(&model.gaussians)?.remove(0);
//!     let image = session.player(&model)?.frame(&camera, 0.5)?;
//!     write_png("mutant.png", &image)
//! }
//! ```
//!
//! Errors are sentences: what it was about, what was seen, what to do. They print as such when `main` returns them.
//!
//! The crate re-exports the parts of the framework and links the plug-ins that come with it; plug-ins of your own are found as soon as their crate is
//! linked. The `cc4dgs` command is built on this crate; a program that wants the whole command line depends on `cc4dgs-cli` instead.

pub mod export;
mod model;

pub mod playable;
pub mod plugins;
pub mod runs;
pub mod scenes;
mod session;
pub mod stress;
pub mod video;

pub use cc4dgs_play::Orbit;
pub use model::Model;
pub use session::{Session, SessionBuilder};

pub use cc4dgs_core::{Camera, Error, Event, EventSink, HostGaussians, Image8, Limits, Registry, Result, Scene, SceneOptions, Split};
pub use cc4dgs_play::player::Player;
pub use cc4dgs_train::config::RunConfig;
pub use cc4dgs_train::images::write_png;

pub use cc4dgs_backends as backends;
pub use cc4dgs_codecs as codecs;
pub use cc4dgs_core as core;
pub use cc4dgs_deformers as deformers;
pub use cc4dgs_exporters as exporters;
pub use cc4dgs_parts as parts;
pub use cc4dgs_play as play;
pub use cc4dgs_train as train;
