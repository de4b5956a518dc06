//! Masks of what moves where no camera stands still: what a static reconstruction does not explain.
//!
//! After the coarse stage most of a scene is reconstructed. What moved while the camera went by is not, and leaves large differences in the images.

use super::{Context, TrainState};
use crate::masks::{DynamicMask, PUBLISHED_SIGMA, blur};
use crate::sample::spread;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Event, Result, Split};

/// The most views that are compared.
const VIEWS: usize = 64;
/// The most pixels of all differences that are kept at once, of 4 bytes each: 64 images of 1920x1080 are kept whole. Of larger ones every
/// second (third, …) pixel of every second (third, …) row is kept: the blur is wider than that.
const MOST_PIXELS: usize = 128 << 20;
/// A difference over this multiple of the typical one is motion: poor reconstruction is alike everywhere, motion is not.
const OVER_TYPICAL: f32 = 2.5;
/// The least difference that counts, of values in 0..1.
const LEAST: f32 = 0.03;

impl Context<'_> {
    /// Masks of training views, evenly spread over the sequence. The model of `state` is the static one of the coarse stage.
    pub(crate) fn residual_masks(&self, state: &mut TrainState) -> Result<Vec<DynamicMask>> {
        let scene = &self.job.scene;
        let views = spread(&scene.split(Split::Train), VIEWS);
        let background = self.job.config.background()?;
        let requests: Vec<(usize, f32)> = views.iter().map(|&view| (view, scene.views[view].time_norm)).collect();
        let gaussians = state.set.gaussians()?;
        let mut residuals: Vec<Vec<f32>> = Vec::with_capacity(views.len());
        self.draw(state, &gaussians, &requests, gaussians.sh_degree, |index, image| {
            let image = to_vec(image, "drawn view")?;
            let camera = scene.camera(views[index]);
            let (w, h) = (camera.width as usize, camera.height as usize);
            let truth = scene.frame(views[index])?.to_planes(background);
            let difference = |p: usize| (0..3).map(|k| (image[k * w * h + p] - truth[k * w * h + p]).abs()).sum::<f32>() / 3.0;
            let blurred = blur(&(0..w * h).map(difference).collect::<Vec<f32>>(), w, h, PUBLISHED_SIGMA);
            residuals.push(thinned(blurred, w, step(w, h, views.len())));
            Ok(())
        })?;
        let mut all: Vec<f32> = residuals.iter().flat_map(|r| r.iter().step_by(7)).copied().collect();
        all.sort_unstable_by(f32::total_cmp);
        let typical = all.get(all.len() / 2).copied().unwrap_or(0.0);
        let threshold = (OVER_TYPICAL * typical).max(LEAST);
        let moving = 1.0 - all.partition_point(|v| *v <= threshold) as f32 / all.len().max(1) as f32;
        let message = format!("{:.0} % of the pixels differ from the static reconstruction by more than {threshold:.3} (typical {typical:.3})", 100.0 * moving);
        self.job.events.emit(&Event::Note { object: "motion".into(), message });
        let count = views.len();
        let mask = |view: usize, residual: Vec<f32>| {
            let camera = scene.camera(view);
            let (w, h) = (camera.width as usize, camera.height as usize);
            over(&residual, w, h, step(w, h, count), threshold)
        };
        Ok(views.into_iter().zip(residuals).map(|(view, residual)| DynamicMask { view, mask: mask(view, residual) }).collect())
    }
}

/// The step at which `images` of `w` x `h` pixels have at most [`MOST_PIXELS`].
fn step(w: usize, h: usize, images: usize) -> usize {
    let most = (MOST_PIXELS / images.max(1)).max(1);
    (1..w.max(h)).find(|&step| w.div_ceil(step) * h.div_ceil(step) <= most).unwrap_or(w.max(h).max(1))
}

/// Every `step`-th value of every `step`-th row of an image that is `w` wide.
fn thinned(values: Vec<f32>, w: usize, step: usize) -> Vec<f32> {
    if step == 1 {
        return values;
    }
    values.chunks(w).step_by(step).flat_map(|row| row.iter().step_by(step)).copied().collect()
}

/// Which pixels of an image of `w` x `h` pixels are over `threshold`, by the values that [`thinned`] left.
fn over(values: &[f32], w: usize, h: usize, step: usize, threshold: f32) -> Vec<bool> {
    let width = w.div_ceil(step);
    (0..w * h).map(|p| values[p / w / step * width + p % w / step] > threshold).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_of_large_images_are_thinned() {
        assert_eq!([step(1920, 1080, 64), step(3840, 2160, 64), step(3840, 2160, 16), step(1, 1, 64), step(1, 1, usize::MAX)], [1, 2, 1, 1, 1]);
        for (w, h, images) in [(3840, 2160, 64), (7680, 4321, 64), (100_000, 3, 500), (17, 16_385, 10_000)] {
            let step = step(w, h, images);
            assert!(images * w.div_ceil(step) * h.div_ceil(step) <= MOST_PIXELS, "{w}x{h}, {images}");
        }
        // A square moves in an image whose sides are no multiples of the step.
        let (w, h) = (11, 7);
        let values: Vec<f32> = (0..w * h).map(|p| if p % w >= 4 && p / w >= 2 { 1.0 } else { 0.0 }).collect();
        let mask: Vec<bool> = values.iter().map(|&v| v > 0.5).collect();
        for step in [1, 2] {
            let thin = thinned(values.clone(), w, step);
            assert_eq!(thin.len(), w.div_ceil(step) * h.div_ceil(step));
            assert_eq!(over(&thin, w, h, step, 0.5), mask, "its corner is a multiple of the step");
        }
    }
}
