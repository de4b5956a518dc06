//! Attribute codecs: Gaussians to bytes and back.
//!
//! * `raw`: float32, nothing lost; the base line of every size table.
//! * `cca`: the compression of canonical attributes of CC-4DGS (paper Section IV-D).
//!
//! * `quantize`: every component by itself, in so many bits; the honest simple one.
//! * `vq`: codebooks for shape and colour, as CompGS has them.
//! * `sorted-image`: Gaussians sorted into a square, their columns stored as pictures.
//! * `spz`: Niantic's format, which viewers read.
//!
//! All register themselves; link this crate and ask the [`cc4dgs_core::Registry`].

pub mod cca;
mod column;
mod grid_sort;
pub mod kmeans;
pub mod morton;
pub mod mulaw;
mod quantize;
mod raw;
mod rows;
mod sorted_image;
pub mod spz;
mod streams;
mod vq;
