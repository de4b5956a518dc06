//! Deformation fields without burn: their shapes and settings, and for fields that are linear in functions of time their evaluation, so that players can play
//! them from the weights alone. The deformers build on the same parts.

pub mod basis;
pub mod forward;
pub mod hash;
pub mod heads;
pub mod lookup;
pub mod networks;
pub mod settings;
pub mod tables;
pub mod time;
pub mod voxels;

/// Keeps every plug-in of this crate in the program: linkers for wasm32 drop object files that nothing refers to.
pub fn link() {
    let motion: [fn(&cc4dgs_format::playback::MotionSource) -> _; 2] = [basis::computed, basis::stored];
    std::hint::black_box(motion);
}
