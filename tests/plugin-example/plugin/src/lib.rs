//! A deformer, a codec, a reader and presets that cc4dgs knows nothing of.

mod half;
mod preset;
mod rig;
mod sway;
