//! A deformer and a codec that cc4dgs knows nothing of.

mod half;
mod sway;
