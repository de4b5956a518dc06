//! Whether the images show anything.

use super::{Finding, Subject, listed};
use crate::sample::spread_views;
use cc4dgs_core::{Image8, Result, Scene, Split, plural};
use rayon::prelude::*;

/// The most images that are looked at.
const SAMPLE: usize = 32;
/// Standard deviation of an image's grey values, in 8-bit levels, below which it is of one colour.
const ONE_COLOUR: f64 = 1.0;
/// Mean grey value, in 8-bit levels, below which an image of one colour is black.
const BLACK: f64 = 8.0;

/// Images of one colour: all of them is a reason to refuse, some of them a doubt.
pub(super) fn check(scene: &Scene, background: [f32; 3]) -> Result<Vec<Finding>> {
    let sample = spread_views(scene, &scene.split(Split::Train), SAMPLE);
    let stats = sample.par_iter().map(|&view| Ok(gray_statistics(&*scene.frame(view)?, background))).collect::<Result<Vec<_>>>()?;
    let flat: Vec<(usize, f64)> = sample.iter().zip(&stats).filter(|(_, (_, deviation))| *deviation < ONE_COLOUR).map(|(&v, (mean, _))| (v, *mean)).collect();
    if flat.is_empty() {
        return Ok(Vec::new());
    }
    let what = if flat.iter().all(|(_, mean)| *mean < BLACK) { "black" } else { "of one colour" };
    let count = sample.len();
    let remedy = "Check how the images were written (bit depth, alpha, a lens cap) and that the paths lead to the right ones";
    if flat.len() == count {
        let looked =
            if count == 1 { "the training image that was looked at is".to_string() } else { format!("all {count} training images that were looked at are") };
        return Ok(vec![Finding::refuse(Subject::Images, format!("{looked} {what}"), remedy)]);
    }
    let names: Vec<String> = flat.iter().map(|&(v, _)| format!("{} at frame {}", scene.camera(v).name, scene.views[v].frame)).collect();
    let are = plural(flat.len(), "is", "are");
    let problem = format!("{} of {count} training images that were looked at {are} {what}: {}", flat.len(), listed(&names));
    Ok(vec![Finding::doubt(Subject::Images, problem, remedy)])
}

/// Mean and standard deviation of the grey values of at most about 100,000 pixels, in 8-bit levels.
fn gray_statistics(image: &Image8, background: [f32; 3]) -> (f64, f64) {
    let channels = image.channels as usize;
    let pixels = image.data.len() / channels.max(1);
    // An odd step does not fall into the rhythm of rows.
    let step = (pixels / 100_000) | 1;
    let (mut sum, mut squares, mut n) = (0.0, 0.0, 0.0);
    for px in image.data.chunks_exact(channels).step_by(step) {
        let alpha = if channels == 4 { f64::from(px[3]) / 255.0 } else { 1.0 };
        let value = (0..3).map(|k| alpha * f64::from(px[k]) + (1.0 - alpha) * 255.0 * f64::from(background[k])).sum::<f64>() / 3.0;
        (sum, squares, n) = (sum + value, squares + value * value, n + 1.0);
    }
    let mean = sum / f64::max(n, 1.0);
    (mean, (squares / f64::max(n, 1.0) - mean * mean).max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_see_through_alpha() {
        let image = Image8 { width: 2, height: 1, channels: 4, data: vec![100, 100, 100, 255, 0, 0, 0, 0] };
        assert_eq!(gray_statistics(&image, [1.0; 3]), (177.5, 77.5));
        let black = Image8 { width: 2, height: 1, channels: 3, data: vec![0; 6] };
        assert_eq!(gray_statistics(&black, [1.0; 3]), (0.0, 0.0));
    }
}
