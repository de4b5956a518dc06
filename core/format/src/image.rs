//! 8-bit images.

use crate::{Error, Result};

/// An 8-bit image, row-major, 3 (RGB) or 4 (RGBA, straight alpha) channels.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image8 {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// 3 or 4.
    pub channels: u32,
    /// `width * height * channels` bytes.
    pub data: Vec<u8>,
}

impl Image8 {
    /// Refuses an image without pixels, with other than 3 or 4 channels, or with a number of bytes that does not match its size. `object` names it in errors.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn validate(&self, object: &str) -> Result<()> {
        let bytes = u64::from(self.width).saturating_mul(u64::from(self.height)).saturating_mul(u64::from(self.channels));
        if bytes == 0 || !(3..=4).contains(&self.channels) || self.data.len() as u64 != bytes {
            return Err(Error::data(
                object,
                format!("{} bytes for {}x{} pixels of {} channels", self.data.len(), self.width, self.height, self.channels),
                "An image has 3 or 4 bytes per pixel; correct the program that made it",
            ));
        }
        Ok(())
    }
    /// Planes `[3,H,W]`, the values over 255, alpha composited over `background`.
    ///
    /// # Panics
    /// For an image without channels, which [`Image8::validate`] refuses.
    pub fn to_planes(&self, background: [f32; 3]) -> Vec<f32> {
        let pixels = self.width as usize * self.height as usize;
        let mut planes = vec![0.0f32; 3 * pixels];
        let (red, rest) = planes.split_at_mut(pixels);
        let (green, blue) = rest.split_at_mut(pixels);
        self.composite(0, background, [red, green, blue]);
        planes
    }
    /// Red, green and blue in 0..1 of the pixels from the index `from` on, as many as `out` has, alpha composited over `background`.
    pub fn composite(&self, from: usize, background: [f32; 3], out: [&mut [f32]; 3]) {
        let c = self.channels as usize;
        let data = self.data.get(from * c..).unwrap_or_default();
        let [red, green, blue] = out;
        for (((px, red), green), blue) in data.chunks_exact(c).zip(red).zip(green).zip(blue) {
            let a = if c == 4 { f32::from(px[3]) / 255.0 } else { 1.0 };
            let over = |k: usize| a * f32::from(px[k]) / 255.0 + (1.0 - a) * background[k];
            (*red, *green, *blue) = (over(0), over(1), over(2));
        }
    }
    /// The RGB image of planes `[3,H,W]`: clamped to 0..1, `value * 255 + 0.5` truncated (the protocol of published tables).
    ///
    /// # Panics
    /// For fewer values than three planes of `width * height` pixels have.
    pub fn from_planes(planes: &[f32], width: u32, height: u32) -> Self {
        let pixels = width as usize * height as usize;
        let mut data = vec![0u8; 3 * pixels];
        for (i, px) in data.chunks_exact_mut(3).enumerate() {
            for k in 0..3 {
                px[k] = (planes[k * pixels + i].clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
            }
        }
        Self { width, height, channels: 3, data }
    }
}
