//! Attribute codecs: Gaussians to bytes and back.
//!
//! * `raw`: float32, nothing lost; the base line of every size table.
//! * `cca`: the compression of canonical attributes of CC-4DGS (paper Section IV-D).
//!
//! * `quantize`: every component by itself, in so many bits; the honest simple one.
//! * `vq`: codebooks for shape and colour, as CompGS has them.
//! * `sorted-image`: Gaussians sorted into a square, their columns stored as images.
//! * `spz`: Niantic's format, which viewers read.
//!
//! And weight codecs for the weights of deformation fields: `fp32`, `fp16`, `int8`.
//!
//! All register themselves; link this crate (`use cc4dgs_codecs as _;`, or [`link`] on wasm32) and look them up with [`cc4dgs_format::Entries`].

pub mod cca;
mod grid_sort;
pub mod kmeans;
pub mod morton;
mod quantize;
mod raw;
mod sorted_image;
mod spz;
mod vq;
mod weights;

/// Keeps every plug-in of this crate in the program. Linkers for wasm32 drop object files that nothing refers to, and plug-ins are found without being
/// referred to; elsewhere `use cc4dgs_codecs as _;` is enough.
pub fn link() {
    let codecs = [cca::build, quantize::build, raw::build, sorted_image::build, spz::build, vq::build];
    std::hint::black_box((codecs, weights::build_fp32 as fn(&_) -> _));
}
