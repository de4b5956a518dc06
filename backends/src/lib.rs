//! Operations burn lacks, per device, and the rasterizers made of them.

pub mod bench;
pub mod cpu;
mod cube;
pub mod ops;
pub mod rasterizers;

pub use cube::{cap_bindings, cap_shared_memory};
