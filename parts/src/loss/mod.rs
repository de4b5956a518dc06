//! Loss terms.

mod depth;
mod dssim;
mod l1;
mod mask_bce;
mod mse;
mod opacity;
mod photometric;
mod scale;
