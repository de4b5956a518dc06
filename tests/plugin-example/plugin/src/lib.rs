//! Plug-ins that cc4dgs knows nothing of: two deformers, density control, a loss term, a reader and presets.

mod faint;
mod preset;
mod relocate;
mod rig;
mod sway;
mod wobble;
