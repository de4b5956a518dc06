//! Temporal-deviation masks: which pixels of a fixed camera see something move (Swift4D, Wu et al. 2025).

use cc4dgs_core::{Event, EventSink, Result, Scene, Split};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Standard deviation in pixels of the blur that published masks have: a 31x31 Gaussian with OpenCV's automatic sigma.
pub const PUBLISHED_SIGMA: f32 = 5.0;

/// The mask of one fixed camera over the whole sequence.
#[derive(Clone, Debug, PartialEq)]
pub struct DynamicMask {
    /// The view (the camera's first frame) it is rendered from.
    pub view: usize,
    /// Whether each pixel is dynamic, row-major `[H,W]`; a byte each.
    pub mask: Vec<bool>,
}

/// Masks of every camera of `split` that has at least two frames there: the population standard deviation over time, averaged over the channels,
/// blurred by a Gaussian of `sigma` pixels, over `threshold`.
pub fn dynamic_masks(scene: &Scene, split: Split, threshold: f32, sigma: f32, background: [f32; 3], events: &dyn EventSink) -> Result<Vec<DynamicMask>> {
    let mut views_of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for view in scene.split(split) {
        views_of_camera.entry(scene.views[view].camera).or_default().push(view);
    }
    views_of_camera.retain(|_, views| views.len() >= 2);
    let total = views_of_camera.len() as u64;
    let mut masks = Vec::new();
    for views in views_of_camera.into_values() {
        let mask = over_time(scene, &views, threshold, sigma, background)?.mask;
        masks.push(DynamicMask { view: views[0], mask });
        events.emit(&Event::Progress { task: "dynamic masks".into(), done: masks.len() as u64, total });
    }
    Ok(masks)
}

/// The images of one fixed camera over time.
pub(crate) struct OverTime {
    /// Sum of the images, planes `[3,H,W]`; over the number of images it is their mean.
    pub sum: Vec<f64>,
    /// Whether each pixel is dynamic, row-major `[H,W]`.
    pub mask: Vec<bool>,
}

/// Mean and mask of `views`, which are of one camera.
pub(crate) fn over_time(scene: &Scene, views: &[usize], threshold: f32, sigma: f32, background: [f32; 3]) -> Result<OverTime> {
    let camera = scene.camera(views[0]);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let (mut sum, mut squares) = (vec![0.0f64; 3 * w * h], vec![0.0f64; 3 * w * h]);
    // Images are decoded in parallel, and added in their order.
    for views in views.chunks(rayon::current_num_threads()) {
        let images = views.par_iter().map(|&view| scene.frame(view)).collect::<Result<Vec<_>>>()?;
        for image in images {
            let planes = image.to_planes(background);
            sum.par_iter_mut().zip(squares.par_iter_mut()).zip(planes.par_iter()).for_each(|((s, q), &v)| {
                *s += f64::from(v);
                *q += f64::from(v) * f64::from(v);
            });
        }
    }
    let n = views.len() as f64;
    let deviation: Vec<f32> = (0..w * h)
        .into_par_iter()
        .map(|i| {
            let per_channel = (0..3).map(|c| {
                let mean = sum[c * w * h + i] / n;
                (squares[c * w * h + i] / n - mean * mean).max(0.0).sqrt()
            });
            (per_channel.sum::<f64>() / 3.0) as f32
        })
        .collect();
    let mask = blur(&deviation, w, h, sigma).into_iter().map(|v| v > threshold).collect();
    Ok(OverTime { sum, mask })
}

/// Gaussian of `sigma` pixels (above 0), cut off at three of them, edges mirrored without repeating the border pixel.
pub(crate) fn blur(image: &[f32], w: usize, h: usize, sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil() as isize;
    let mut kernel: Vec<f32> = (-radius..=radius).map(|d| (-(d * d) as f32 / (2.0 * sigma * sigma)).exp()).collect();
    let norm: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= norm);
    let mirror = |i: isize, n: usize| -> usize {
        let period = 2 * (n as isize - 1).max(1);
        let i = i.rem_euclid(period);
        (if i >= n as isize { period - i } else { i }).clamp(0, n as isize - 1) as usize
    };
    let pass = |source: &[f32], along: usize, across: usize, stride: usize, step: usize| -> Vec<f32> {
        // Where the values lie that a line and its margins show: found once, because it takes a division.
        let shown: Vec<usize> = (-radius..along as isize + radius).map(|i| mirror(i, along) * step).collect();
        // Returns [across, along] row-major lines.
        (0..across)
            .into_par_iter()
            .flat_map_iter(|line| {
                let (kernel, shown, line) = (&kernel, &shown, &source[line * stride..]);
                (0..along).map(move |i| kernel.iter().zip(&shown[i..]).map(|(weight, &at)| weight * line[at]).sum::<f32>())
            })
            .collect()
    };
    let rows = pass(image, w, h, w, 1);
    let columns = pass(&rows, h, w, 1, w);
    (0..w * h).map(|i| columns[(i % w) * h + i / w]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_keeps_constants_and_mass() {
        let flat = blur(&vec![0.5; 40 * 20], 40, 20, 5.0);
        assert!(flat.iter().all(|v| (v - 0.5).abs() < 1e-5));
        let mut point = vec![0.0; 101 * 101];
        point[50 * 101 + 50] = 1.0;
        let blurred = blur(&point, 101, 101, 5.0);
        assert!((blurred.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        assert_eq!(blurred[50 * 101 + 47], blurred[47 * 101 + 50]);
        assert_eq!(blur(&[0.3], 1, 1, 5.0).len(), 1);
    }

    #[test]
    fn edges_are_mirrored_without_repeating_the_border_pixel() {
        let mirrored = |mut i: isize, n: usize| {
            let last = n as isize - 1;
            while !(0..=last).contains(&i) {
                i = if i < 0 { -i } else { 2 * last - i };
                // A single pixel is its own mirror image.
                i = if last == 0 { 0 } else { i };
            }
            i as usize
        };
        // The kernel reaches further than the image is wide, or high.
        for (w, h) in [(1, 1), (2, 5), (7, 3), (13, 11)] {
            let image: Vec<f32> = (0..w * h).map(|p| (p as f32 * 0.7).sin()).collect();
            let weights: Vec<f64> = (-6..=6).map(|d: i32| (-f64::from(d * d) / 8.0).exp()).collect();
            let norm = weights.iter().sum::<f64>().powi(2);
            for (p, found) in blur(&image, w, h, 2.0).into_iter().enumerate() {
                let mut sum = 0.0;
                for (dy, a) in weights.iter().enumerate() {
                    for (dx, b) in weights.iter().enumerate() {
                        let (x, y) = (mirrored((p % w + dx) as isize - 6, w), mirrored((p / w + dy) as isize - 6, h));
                        sum += a * b * f64::from(image[y * w + x]) / norm;
                    }
                }
                assert!((f64::from(found) - sum).abs() < 2e-6, "pixel {p} of {w}x{h}: {found} instead of {sum}");
            }
        }
    }
}
