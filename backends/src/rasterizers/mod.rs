//! The rasterizers made of the operations.

pub mod reference;
mod settings;
pub mod tile;
