//! Images as float64 planes, the input of every metric.

use crate::{Error, Image8, Result};

/// An image as planes `[C,H,W]` of finite float64 values; 0 is black, 1 is white.
#[derive(Clone, Debug, PartialEq)]
pub struct Planes {
    width: usize,
    height: usize,
    channels: usize,
    values: Vec<f64>,
}

impl Planes {
    /// Planes `[channels, height, width]`. Refuses empty images, a length that does not match, and values that are not finite.
    ///
    /// # Errors
    /// [`Error::Parameter`] for shapes, [`Error::Data`] for values.
    pub fn new(values: Vec<f64>, channels: usize, height: usize, width: usize) -> Result<Self> {
        let expected = channels.checked_mul(height).and_then(|n| n.checked_mul(width));
        if values.is_empty() || expected != Some(values.len()) {
            let problem = format!("{} values do not make [{channels}, {height}, {width}]", values.len());
            return Err(Error::parameter("metric input", problem, "Pass channels * height * width values, at least one"));
        }
        if let Some(i) = values.iter().position(|v| !v.is_finite()) {
            return Err(Error::data("metric input", format!("value {i} is {}", values[i]), "Only images with finite values can be scored"));
        }
        Ok(Self { width, height, channels, values })
    }
    /// Float32 planes `[channels, height, width]`, not rounded.
    ///
    /// # Errors
    /// As [`Planes::new`].
    pub fn from_f32(values: &[f32], channels: usize, height: usize, width: usize) -> Result<Self> {
        Self::new(values.iter().map(|&v| f64::from(v)).collect(), channels, height, width)
    }
    /// Float32 planes rounded to 8 bits first: clamped to 0..1, `value * 255 + 0.5` truncated, divided by 255. Values that are not numbers become 0.
    pub fn from_f32_rounded(values: &[f32], channels: usize, height: usize, width: usize) -> Result<Self> {
        let byte = |v: f32| f64::from((v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8) / 255.0;
        Self::new(values.iter().map(|&v| byte(v)).collect(), channels, height, width)
    }
    /// The colour channels of an 8-bit image, byte / 255; an alpha channel is ignored.
    ///
    /// # Errors
    /// [`Error::Parameter`] if the number of bytes does not match the size.
    pub fn from_image8(image: &Image8) -> Result<Self> {
        let (pixels, stride) = (image.width as usize * image.height as usize, image.channels.max(1) as usize);
        let channels = stride.min(3);
        if image.data.len() != pixels * stride {
            return Err(Error::parameter(
                "metric input",
                format!("{} bytes for {pixels} pixels of {stride} channels", image.data.len()),
                "Pass all pixels of the image",
            ));
        }
        let plane = |c: usize| image.data.iter().skip(c).step_by(stride).map(|&b| f64::from(b) / 255.0);
        Self::new((0..channels).flat_map(plane).collect(), channels, image.height as usize, image.width as usize)
    }
    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }
    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }
    /// Number of planes.
    pub fn channels(&self) -> usize {
        self.channels
    }
    /// All values, plane after plane, row-major.
    pub fn values(&self) -> &[f64] {
        &self.values
    }
    /// One plane, row-major.
    pub fn plane(&self, channel: usize) -> &[f64] {
        let pixels = self.width * self.height;
        &self.values[channel * pixels..(channel + 1) * pixels]
    }
    /// Refuses a pair of different shapes, and a mask that is not `[H,W]` or has no pixel set.
    pub(super) fn check_pair(&self, other: &Self, mask: Option<&[bool]>) -> Result<()> {
        let shape = |p: &Self| (p.channels, p.height, p.width);
        if shape(self) != shape(other) {
            let problem = format!("shapes {:?} and {:?} (channels, height, width) differ", shape(self), shape(other));
            return Err(Error::parameter("metric input", problem, "Compare images of the same size"));
        }
        match mask {
            Some(m) if m.len() != self.width * self.height => {
                Err(Error::parameter("metric mask", format!("{} entries for {} pixels", m.len(), self.width * self.height), "Pass one entry per pixel"))
            }
            Some(m) if !m.contains(&true) => Err(Error::parameter("metric mask", "no pixel is set", "Exclude such frames from the frame set")),
            _ => Ok(()),
        }
    }
}
