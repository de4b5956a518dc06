//! Plug-ins that cc4dgs knows nothing of: two deformers, density control, an exporter, a loss term, a reader and presets.

mod csv;
mod faint;
mod preset;
mod relocate;
mod rig;
mod sway;
mod wobble;
