//! Plain-slice kernels (rayon and SIMD) that serve every CPU backend.

pub mod tensor;
pub mod adam;
pub mod mlp;
pub mod photometric;
pub mod scratch;
pub mod vertex;
pub mod raster;
pub mod simd;
