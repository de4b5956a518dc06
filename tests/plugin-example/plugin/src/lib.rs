//! Plug-ins that cc4dgs knows nothing of: three deformers, density control, an exporter, three loss terms (one with a tensor operation of its own), a reader
//! and presets.

mod charbonnier;
mod control_points;
mod csv;
mod faint;
mod keep_size;
mod preset;
mod relocate;
mod rig;
mod sway;
mod wobble;
