//! Loss terms.

mod dssim;
mod l1;
mod mask_bce;
mod opacity;
mod photometric;
mod scale;
