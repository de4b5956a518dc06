//! Building blocks that several deformers share, one idea each.

pub mod centres;
pub mod heads;
pub mod lives;
pub mod neighbours;
pub mod settings;
pub mod tables;
pub mod vectors;
pub mod voxels;
pub mod weights;
