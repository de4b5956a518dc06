//! An image of the player that a page asked for.

use cc4dgs_format::Image8;
use wasm_bindgen::prelude::*;

/// The pixels of a view.
#[wasm_bindgen]
pub struct Capture {
    pub(super) image: Image8,
}

#[wasm_bindgen]
impl Capture {
    /// Pixels per row.
    #[wasm_bindgen(getter)]
    pub fn width(&self) -> u32 {
        self.image.width
    }
    /// Rows.
    #[wasm_bindgen(getter)]
    pub fn height(&self) -> u32 {
        self.image.height
    }
    /// Red, green, blue, 255 per pixel.
    #[wasm_bindgen(getter)]
    pub fn rgba(&self) -> wasm_bindgen::Clamped<Vec<u8>> {
        wasm_bindgen::Clamped(self.image.data.chunks_exact(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect())
    }
}
