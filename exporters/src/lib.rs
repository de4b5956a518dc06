//! Exporters: models in the file formats of other programs.
//!
//! * `ply`: one PLY in the layout of 3D Gaussian splatting; `ply-sequence`: one per frame.
//! * `spz`: Niantic's SPZ.
//! * `sog`: PlayCanvas' SOG, images in a ZIP file.
//! * `gltf`: binary glTF with `KHR_gaussian_splatting`.
//! * `splatv`: moving Gaussians as cubic curves, for splaTV and gsplat.js.
//! * `web`: a page that plays the model.
//!
//! All register themselves; link this crate (`use cc4dgs_exporters as _;`, or [`link`] on wasm32). Formats that hold one instant take the canonical model or
//! the instant that is asked for. All but `web` are in the coordinates of the dataset.

mod gltf;
mod ply;
mod ply_sequence;
pub mod sog;
mod splatv;
mod spz;
mod still;
pub mod web;

/// Keeps every exporter of this crate in the program. Linkers for wasm32 drop object files that nothing refers to, and no code refers to a plug-in. On other
/// targets `use cc4dgs_exporters as _;` is enough.
pub fn link() {
    std::hint::black_box([gltf::build, ply::build, ply_sequence::build, sog::build, splatv::build, spz::build, web::build] as [fn(&_) -> _; 7]);
}
