//! Tensor operations that burn lacks, per device, and the rasterizers made of them.
//!
//! An operation has a file in each of three folders: `ops` (what it is: trait, shapes, derivative, public function), `cpu` (its kernel on slices) and `cube`
//! (its kernel on a GPU). All three are listed here, so that a new operation is three files and their three lines in this one.

pub mod bench;
pub mod rasterizers;

/// The tensor operations burn lacks. Each is a `backend_extension` trait with an implementation per device and a hand-written derivative. Shapes and
/// constants that several devices need are here too.
pub mod ops {
    pub mod adam;
    mod autodiff;
    pub mod basis;
    pub mod colors;
    pub mod columns;
    pub mod corners;
    pub mod field;
    pub mod image;
    pub mod life;
    mod limits;
    pub mod lookup;
    pub mod photometric;
    pub mod rasterize;
    mod shared;
    pub mod sort;
    pub mod split;
    pub mod view_sums;
}

/// Plain-slice kernels (rayon and SIMD) that serve every CPU backend.
pub mod cpu {
    pub mod adam;
    pub mod basis;
    pub mod colors;
    pub mod columns;
    pub mod cross_entropy;
    pub mod heads;
    pub mod image;
    pub mod life;
    pub mod lookup;
    pub mod mlp;
    pub mod photometric;
    pub mod raster;
    pub mod scratch;
    pub mod simd;
    pub mod sort;
    pub mod tensor;
    pub mod vertex;
    pub mod view_sums;
}

/// Kernels for burn's CubeCL backend: one source for wgpu and CUDA.
// Kernels are translated, not run: iterators and joined conditions have no counterpart there.
#[cfg(feature = "cube")]
#[allow(clippy::needless_range_loop, clippy::collapsible_if, clippy::collapsible_else_if, clippy::manual_range_contains)]
mod cube {
    mod adam;
    mod basis;
    mod colors;
    mod cross_entropy;
    pub(crate) mod field;
    mod image;
    mod kept_images;
    mod life;
    mod lookup;
    mod photometric;
    mod raster;
    mod sort;
    pub(crate) mod tensor;
    mod view_sums;

    pub use tensor::{cap_bindings, cap_shared_memory};
}

#[cfg(feature = "cube")]
pub use cube::{cap_bindings, cap_shared_memory};
