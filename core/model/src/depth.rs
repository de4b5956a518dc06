//! Recorded depth of an image.

use crate::{Error, Result};
use rayon::prelude::*;

/// Largest relative difference of the proportions of an image and its depth.
const PROPORTIONS: f64 = 0.01;

/// The recorded depth of every pixel of an image: how far what it shows is from the centre of the camera, along the z axis of the camera (not along the ray),
/// in world units. Lens distortion does not change it.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthImage {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[H,W]`, row by row; 0 where the depth is unknown.
    pub values: Vec<f32>,
}

impl DepthImage {
    /// Refuses an image without pixels, with a number of values that does not match its size, and values that are negative or not finite. `object` names it in
    /// errors.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn validate(&self, object: &str) -> Result<()> {
        let pixels = u64::from(self.width) * u64::from(self.height);
        if pixels == 0 || self.values.len() as u64 != pixels {
            let problem = format!("{} values of depth for {}x{} pixels", self.values.len(), self.width, self.height);
            return Err(Error::data(object, problem, "Depth has one value per pixel; correct the program that made it"));
        }
        if let Some(value) = self.values.iter().find(|value| !(value.is_finite() && **value >= 0.0)) {
            return Err(Error::data(object, format!("the depth {value} of a pixel is no distance"), "Write 0 where the depth is unknown"));
        }
        Ok(())
    }
    /// As [`DepthImage::validate`]; refuses also the depth of an image of `image` pixels (width, height) that has other proportions. Its size may be another.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn validate_for(&self, object: &str, image: [u32; 2]) -> Result<()> {
        self.validate(object)?;
        let [w, h] = image.map(f64::from);
        if (f64::from(self.width) / w / (f64::from(self.height) / h) - 1.0).abs() <= PROPORTIONS {
            return Ok(());
        }
        let problem = format!("{}x{} pixels of depth for an image of {w}x{h}", self.width, self.height);
        Err(Error::data(object, problem, "Give depth the proportions of its image, and show the same in it; its size may be another"))
    }
    /// An image of `width` x `height` pixels. The pixel with its centre at (u, v) has the value of this image at `source(u, v)`, in shares of this width and
    /// height, and is unknown where that lies outside. Depths are not averaged: the mean of two surfaces is no surface, and pixels may be unknown.
    pub fn resampled(&self, width: u32, height: u32, source: impl Fn(f64, f64) -> (f64, f64) + Sync) -> Self {
        let (w, h) = (f64::from(self.width), f64::from(self.height));
        let value = |x: u32, y: u32| {
            let (u, v) = source(f64::from(x) + 0.5, f64::from(y) + 0.5);
            let (column, row) = ((u * w).floor(), (v * h).floor());
            let inside = (0.0..w).contains(&column) && (0.0..h).contains(&row);
            if inside { self.values[row as usize * self.width as usize + column as usize] } else { 0.0 }
        };
        let line = |y: u32| {
            let value = &value;
            (0..width).map(move |x| value(x, y))
        };
        Self { width, height, values: (0..height).into_par_iter().flat_map_iter(line).collect() }
    }
    /// The image at another size: every pixel has the depth at its centre.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (w, h) = (f64::from(width), f64::from(height));
        self.resampled(width, height, |u, v| (u / w, v / h))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_values_that_are_no_depth_are_refused() {
        let of = |width: u32, height: u32, values: &[f32]| DepthImage { width, height, values: values.to_vec() }.validate("it").map_err(|e| e.to_string());
        assert_eq!(of(2, 1, &[0.0, 3.5]), Ok(()));
        for (width, height, count) in [(0, 0, 0), (2, 2, 3), (u32::MAX, u32::MAX, 1)] {
            let message = of(width, height, &vec![1.0; count]).unwrap_err();
            assert!(message.contains(&format!("{count} values of depth for {width}x{height} pixels")), "{message}");
        }
        for value in [-1.0, f32::NAN, f32::INFINITY] {
            let message = of(2, 1, &[1.0, value]).unwrap_err();
            assert!(message.contains(&format!("the depth {value} of a pixel")), "{message}");
        }
    }

    #[test]
    fn depth_has_the_proportions_of_its_image() {
        let of = |image: [u32; 2]| DepthImage { width: 4, height: 3, values: vec![1.0; 12] }.validate_for("it", image).map_err(|e| e.to_string());
        assert!([[4, 3], [2, 1], [1920, 1440], [404, 300]].map(of).iter().map(Result::is_ok).eq([true, false, true, true]));
        for image in [[3, 4], [420, 300], [0, 0]] {
            let message = of(image).unwrap_err();
            assert!(message.contains(&format!("4x3 pixels of depth for an image of {}x{}", image[0], image[1])), "{message}");
        }
        let short = DepthImage { width: 4, height: 3, values: vec![1.0; 11] };
        assert!(short.validate_for("it", [4, 3]).is_err(), "it has fewer values than pixels");
    }

    #[test]
    fn no_size_makes_up_a_depth() {
        // A near and a far surface, and a row of unknown pixels.
        let image = DepthImage { width: 4, height: 3, values: vec![1.0, 1.0, 9.0, 9.0, 1.0, 1.0, 9.0, 9.0, 0.0, 0.0, 0.0, 0.0] };
        assert_eq!(image.resized(4, 3), image);
        assert_eq!(image.resized(2, 3).values, [1.0, 9.0, 1.0, 9.0, 0.0, 0.0]);
        for (width, height) in [(1, 1), (3, 2), (5, 7), (8, 6)] {
            let other = image.resized(width, height);
            assert_eq!(other.values.len(), (width * height) as usize);
            assert!(other.values.iter().all(|value| [0.0, 1.0, 9.0].contains(value)), "{width}x{height}: {:?}", other.values);
        }
        let shifted = image.resampled(4, 3, |u, v| ((u + 2.0) / 4.0, v / 3.0));
        assert_eq!(shifted.values[..4], [9.0, 9.0, 0.0, 0.0], "outside it is unknown");
        assert!(image.resampled(1, 1, |_, _| (f64::NAN, 0.0)).values == [0.0]);
    }
}
