//! Multi-scale structural similarity as pytorch-msssim computes it, with the window in float64.

use super::ssim::channel_means;
use super::{Padding, Planes};
use crate::{Error, Result};

/// Exponents of the five scales, finest first (Wang et al. 2003).
pub const MS_SSIM_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// The smallest side that still holds an 11-tap window after four halvings.
const SMALLEST_SIDE: usize = 161;

/// MS-SSIM of two images of data range 1: windows inside the image only, 2x2 mean pooling between scales, contrast terms of the first four
/// scales and SSIM of the last, negative terms set to 0, product per channel, mean over channels. Refuses sides below 161 pixels.
///
/// # Errors
/// [`Error::Parameter`] for small images or different shapes.
pub fn ms_ssim(a: &Planes, b: &Planes) -> Result<f64> {
    a.check_pair(b, None)?;
    if a.width().min(a.height()) < SMALLEST_SIDE {
        let problem = format!("the image is {}x{}; each side needs at least {SMALLEST_SIDE} pixels", a.width(), a.height());
        return Err(Error::parameter("MS-SSIM", problem, "Use SSIM, or larger images"));
    }
    let mut products = vec![1.0; a.channels()];
    let mut scale = (a.clone(), b.clone());
    for (level, weight) in MS_SSIM_WEIGHTS.into_iter().enumerate() {
        let last = level + 1 == MS_SSIM_WEIGHTS.len();
        let means = channel_means(&scale.0, &scale.1, Padding::Valid, None)?;
        for (product, m) in products.iter_mut().zip(means) {
            *product *= if last { m.ssim } else { m.contrast }.max(0.0).powf(weight);
        }
        if !last {
            scale = (halve(&scale.0)?, halve(&scale.1)?);
        }
    }
    Ok(products.iter().sum::<f64>() / products.len() as f64)
}

/// 2x2 mean pooling. An odd side gets one row (column) of zeros before its first, which counts in the mean.
fn halve(image: &Planes) -> Result<Planes> {
    let (width, height) = (image.width(), image.height());
    let (out_width, out_height) = (width.div_ceil(2), height.div_ceil(2));
    let mut values = Vec::with_capacity(image.channels() * out_width * out_height);
    for channel in 0..image.channels() {
        let plane = image.plane(channel);
        for y in 0..out_height {
            for x in 0..out_width {
                let mut sum = 0.0;
                for dy in 0..2 {
                    for dx in 0..2 {
                        let source = ((2 * y + dy).checked_sub(height % 2), (2 * x + dx).checked_sub(width % 2));
                        if let (Some(sy), Some(sx)) = source {
                            sum += plane[sy * width + sx];
                        }
                    }
                }
                values.push(0.25 * sum);
            }
        }
    }
    Planes::new(values, image.channels(), out_height, out_width)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_sides_are_padded_before_the_first_row_and_column() {
        let image = Planes::new((1..=9).map(f64::from).collect(), 1, 3, 3).unwrap();
        let half = halve(&image).unwrap();
        assert_eq!((half.width(), half.height()), (2, 2));
        assert_eq!(half.values(), [0.25, 1.25, 2.75, 7.0]);
    }
}
