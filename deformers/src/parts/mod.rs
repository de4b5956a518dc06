//! What fields are made of: each part is one idea that several fields share.

pub mod centres;
pub mod heads;
pub mod settings;
pub mod time;
pub mod voxels;
pub mod weights;
