//! Kernels for burn's CubeCL backend: one source for wgpu and cuda.
// Kernels are translated, not run: iterators and joined conditions have no counterpart there.
#![allow(clippy::needless_range_loop, clippy::collapsible_if, clippy::collapsible_else_if, clippy::manual_range_contains)]

mod adam;
mod basis;
mod field;
mod lookup;
mod photometric;
mod picture;
mod raster;
mod sort;
pub(crate) mod tensor;

pub use tensor::{cap_bindings, cap_shared_memory};
