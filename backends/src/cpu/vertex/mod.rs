//! Voxel-grid vertices: which ones surround a point, their hash signatures, and interpolation between them (CC-4DGS, Section IV-B).

pub mod hash;
pub mod index;
pub mod interpolate;
