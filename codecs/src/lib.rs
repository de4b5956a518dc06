//! Attribute codecs: Gaussians to bytes and back.
//!
//! * `raw`: float32, lossless; the baseline of size tables.
//! * `cca`: the compression of canonical attributes of CC-4DGS (paper Section IV-D).
//! * `quantize`: each component quantised separately; the baseline for lossy codecs.
//! * `vq`: codebooks for shape and colour, as in CompGS.
//! * `sorted-image`: Gaussians sorted into a square, their columns stored as images.
//! * `compact`: steps by the effect on images, entropy coding with stored distributions; the smallest files.
//! * `spz`: Niantic's format, which viewers read.
//!
//! Weight codecs for the weights of deformers: `fp32`, `fp16`, `int8`, `compact`.
//!
//! All register themselves; link this crate (`use cc4dgs_codecs as _;`, or [`link`] on wasm32) and look them up with [`cc4dgs_format::Entries`].

use cc4dgs_format::{Error, Result};

pub mod cca;
mod compact;
mod grid_sort;
mod jacobi;
pub mod kmeans;
pub mod morton;
mod quantize;
mod raw;
mod sorted_image;
mod spz;
mod vq;
mod weights;

/// The crate was built without the feature `encoders`.
pub(crate) struct NoEncoders;

impl From<NoEncoders> for Error {
    fn from(_: NoEncoders) -> Self {
        Self::parameter("codec", "this program was built to play models, without encoders", "Use the program cc4dgs, or the feature encoders of cc4dgs-codecs")
    }
}

/// Refuses where the crate was built without the feature `encoders`. The compiler then leaves out what follows. It must see that `Ok` is impossible: of an
/// [`Error`], which is built by a call, it does not, and encoders stay in the program.
#[inline(always)]
pub(crate) fn require_encoders() -> Result<(), NoEncoders> {
    if cfg!(feature = "encoders") { Ok(()) } else { Err(NoEncoders) }
}

/// Keeps every plug-in of this crate in the program. Linkers for wasm32 drop object files that nothing refers to, and no code refers to a plug-in. On other
/// targets `use cc4dgs_codecs as _;` is enough.
pub fn link() {
    let codecs = [cca::build, compact::build, quantize::build, raw::build, sorted_image::build, spz::build, vq::build];
    let weight_codecs: [fn(&_) -> _; 2] = [weights::build_fp32, compact::build_weights];
    std::hint::black_box((codecs, weight_codecs));
}
