//! Kernels for burn's CubeCL backend: one source for wgpu and cuda.

mod adam;
mod photometric;
pub(crate) mod tensor;
