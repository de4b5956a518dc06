//! Planes of 8-bit images on the CPU.

use cc4dgs_core::Image8;
use rayon::prelude::*;

/// Pixels per task.
const PIXELS: usize = 16384;

/// The same numbers as [`Image8::to_planes`].
pub fn planes(image: &Image8, background: [f32; 3]) -> Vec<f32> {
    let pixels = image.width as usize * image.height as usize;
    let mut planes = vec![0.0f32; 3 * pixels];
    let (red, rest) = planes.split_at_mut(pixels);
    let (green, blue) = rest.split_at_mut(pixels);
    let blocks = red.par_chunks_mut(PIXELS).zip(green.par_chunks_mut(PIXELS)).zip(blue.par_chunks_mut(PIXELS)).enumerate();
    blocks.for_each(|(block, ((red, green), blue))| image.composite(block * PIXELS, background, [red, green, blue]));
    planes
}
