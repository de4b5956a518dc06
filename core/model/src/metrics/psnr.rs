//! Peak signal-to-noise ratio, mean squared and mean absolute error.

use super::Planes;
use crate::Result;
use rayon::prelude::*;

/// The PSNR of identical images in dB. Finite, so that means and JSON stay defined. Two different 8-bit images with fewer than 380 million
/// values always score less.
pub const PSNR_CEILING_DB: f64 = 134.0;

/// The mean over all channels and (masked) pixels of `term(a, b)`, summed row by row in a fixed order.
fn mean(a: &Planes, b: &Planes, mask: Option<&[bool]>, term: fn(f64, f64) -> f64) -> Result<f64> {
    a.check_pair(b, mask)?;
    let (width, height) = (a.width(), a.height());
    let rows: Vec<(f64, u64)> = (0..a.channels() * height)
        .into_par_iter()
        .map(|row| {
            let pairs = a.values()[row * width..(row + 1) * width].iter().zip(&b.values()[row * width..(row + 1) * width]);
            match mask {
                None => (pairs.map(|(&x, &y)| term(x, y)).sum(), width as u64),
                Some(mask) => {
                    let keep = &mask[(row % height) * width..(row % height + 1) * width];
                    let sum = pairs.zip(keep).filter(|(_, k)| **k).map(|((&x, &y), _)| term(x, y)).sum();
                    (sum, keep.iter().filter(|k| **k).count() as u64)
                }
            }
        })
        .collect();
    let (sum, count) = rows.iter().fold((0.0, 0), |(s, n), (rs, rn)| (s + rs, n + rn));
    Ok(sum / count as f64)
}

/// Mean squared error over all channels and pixels (those set in `mask` `[H,W]`, if given).
pub fn mean_squared_error(a: &Planes, b: &Planes, mask: Option<&[bool]>) -> Result<f64> {
    mean(a, b, mask, |x, y| (x - y) * (x - y))
}

/// Mean absolute error over all channels and pixels (those set in `mask` `[H,W]`, if given).
pub fn mean_absolute_error(a: &Planes, b: &Planes, mask: Option<&[bool]>) -> Result<f64> {
    mean(a, b, mask, |x, y| (x - y).abs())
}

/// 10 log10(1 / MSE) in dB for data range 1; at most [`PSNR_CEILING_DB`], which is that of an MSE of 0. Minus infinity of an MSE that is not a number.
pub fn psnr_of_mean_squared_error(mse: f64) -> f64 {
    if mse.is_nan() {
        f64::NEG_INFINITY
    } else if mse > 0.0 {
        (-10.0 * mse.log10()).min(PSNR_CEILING_DB)
    } else {
        PSNR_CEILING_DB
    }
}

/// 10 log10(1 / MSE) in dB for data range 1, the MSE taken over all channels and pixels at once; at most [`PSNR_CEILING_DB`].
pub fn psnr(a: &Planes, b: &Planes, mask: Option<&[bool]>) -> Result<f64> {
    Ok(psnr_of_mean_squared_error(mean_squared_error(a, b, mask)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_that_is_no_number_is_not_the_best_score() {
        assert_eq!([0.0, 1.0, f64::NAN].map(psnr_of_mean_squared_error), [PSNR_CEILING_DB, 0.0, f64::NEG_INFINITY]);
    }
}
