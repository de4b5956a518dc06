//! Plain-slice kernels (rayon and SIMD) that serve every CPU backend.

pub mod adam;
pub mod basis;
pub mod heads;
pub mod lookup;
pub mod mlp;
pub mod photometric;
pub mod raster;
pub mod scratch;
pub mod simd;
pub mod sort;
pub mod tensor;
pub mod vertex;
