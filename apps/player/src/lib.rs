//! A player of dynamic Gaussians that needs neither burn nor the deformers: wgpu and WGSL, one source for desktop and browser.
//!
//! [`Content`] is what a file holds, [`Renderer`] draws it, [`Navigator`] and [`Clock`] are where the user looks from and when. In a browser, `web` wraps them
//! for the page in `web/`.
//!
//! A frame is projected by compute shaders, which add the motion of the playback layer on the way, sorted by 16 bits of depth, and blended as instanced quads.
//! Nothing is read back: the numbers of workgroups and of quads stay on the GPU. Static Gaussians cost no motion and invisible ones are not sorted.

mod clock;
mod content;
#[cfg(all(any(feature = "window", test), not(target_arch = "wasm32")))]
mod desktop;
#[cfg(not(target_arch = "wasm32"))]
pub mod exact;
mod memory;
mod navigator;
mod render;
mod scene;
#[cfg(target_arch = "wasm32")]
mod web;
#[cfg(all(feature = "window", not(target_arch = "wasm32")))]
pub mod window;

pub use clock::Clock;
pub use content::Content;
pub use navigator::{Navigator, Pose};
pub use render::{Mode, Renderer, View, device_of, request_device};
pub use scene::Scene;

/// The codecs and fields that archives may need. Linkers drop what nobody refers to, above all on wasm32.
pub fn link() {
    cc4dgs_codecs::link();
    cc4dgs_fields::link();
}
