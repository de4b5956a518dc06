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
            residuals.push(blur(&(0..w * h).map(difference).collect::<Vec<f32>>(), w, h, PUBLISHED_SIGMA));
            Ok(())
        })?;
        let mut all: Vec<f32> = residuals.iter().flat_map(|r| r.iter().step_by(7)).copied().collect();
        all.sort_unstable_by(f32::total_cmp);
        let typical = all.get(all.len() / 2).copied().unwrap_or(0.0);
        let threshold = (OVER_TYPICAL * typical).max(LEAST);
        let moving = 1.0 - all.partition_point(|v| *v <= threshold) as f32 / all.len().max(1) as f32;
        let message = format!("{:.0} % of the pixels differ from the static reconstruction by more than {threshold:.3} (typical {typical:.3})", 100.0 * moving);
        self.job.events.emit(&Event::Note { object: "motion".into(), message });
        let mask = |residual: Vec<f32>| residual.into_iter().map(|v| f32::from(u8::from(v > threshold))).collect();
        Ok(views.into_iter().zip(residuals).map(|(view, residual)| DynamicMask { view, mask: mask(residual) }).collect())
    }
}
