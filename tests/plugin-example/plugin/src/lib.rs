//! A deformer, a reader and presets that cc4dgs knows nothing of.

mod preset;
mod rig;
mod sway;
