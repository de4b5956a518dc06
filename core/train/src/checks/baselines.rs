//! What can be had without a model: the mean colour of an image, a blurred image, the mean image of a fixed camera. A model has to be better.

use crate::data::resample::resize;
use crate::masks::{PUBLISHED_SIGMA, over_time};
use crate::sample::{spread, spread_views};
use cc4dgs_core::metrics::{Metric, Rounding};
use cc4dgs_core::{Image8, Result, Scene, Split};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The most training views that are scored.
const VIEWS: usize = 24;
/// The blurred image is the image at this share of its size, scaled up again.
const BLUR: u32 = 16;
/// The most fixed cameras whose moving pixels are scored, and frames of each that the mean image is made of.
const MOVING_CAMERAS: usize = 4;
const MOVING_FRAMES: usize = 16;
/// Fewer frames say nothing of motion.
const FEWEST_FRAMES: usize = 4;
/// Views per fixed camera whose moving pixels are scored.
const MOVING_VIEWS: usize = 2;
/// Share of the pixels that must move.
const MOVING_SHARE: f64 = 0.003;

/// PSNR of the baselines in dB, means over the scored training views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Baselines {
    /// Each image replaced by its mean colour.
    pub mean_colour_db: f64,
    /// Each image at a sixteenth of its size, scaled up again.
    pub blur_db: f64,
    /// The mean image of a fixed camera over time, on the pixels that move; absent where no camera is fixed or nothing moves.
    pub mean_image_db: Option<f64>,
}

/// A view of a fixed camera with the pixels that move.
pub(super) struct MovingPixels {
    pub view: usize,
    /// `[H,W]`.
    pub mask: Vec<bool>,
}

/// The views a model is scored on, and what the baselines score there.
pub(super) struct Yardstick {
    pub views: Vec<usize>,
    pub moving: Vec<MovingPixels>,
    pub baselines: Baselines,
}

impl Yardstick {
    /// Chooses training views and scores the baselines. `threshold` is that of the dynamic masks.
    pub fn new(scene: &Scene, threshold: f32, background: [f32; 3]) -> Result<Self> {
        let views = spread_views(scene, &scene.split(Split::Train), VIEWS);
        let scores = views.par_iter().map(|&view| still_scores(scene, view, background)).collect::<Result<Vec<_>>>()?;
        let mean = |values: &dyn Fn(&[f64; 2]) -> f64| scores.iter().map(values).sum::<f64>() / scores.len().max(1) as f64;
        let (moving, mean_image_db) = moving_pixels(scene, threshold, background)?;
        Ok(Self { views, moving, baselines: Baselines { mean_colour_db: mean(&|s| s[0]), blur_db: mean(&|s| s[1]), mean_image_db } })
    }
}

/// PSNR of the mean colour and of the blurred image of a view.
fn still_scores(scene: &Scene, view: usize, background: [f32; 3]) -> Result<[f64; 2]> {
    let image = scene.frame(view)?;
    let (w, h) = (image.width, image.height);
    let planes = image.to_planes(background);
    let n = planes.len() / 3;
    let flat: Vec<f32> =
        planes.chunks_exact(n.max(1)).flat_map(|plane| vec![(plane.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64) as f32; n]).collect();
    Ok([psnr_db(&planes, &flat, [w, h], None)?, psnr_db(&planes, &blurred(&planes, [w, h]), [w, h], None)?])
}

/// Planes `[3,H,W]` of an image at a sixteenth of its size, scaled up again.
pub(super) fn blurred(planes: &[f32], [w, h]: [u32; 2]) -> Vec<f32> {
    let opaque = Image8::from_planes(planes, w, h);
    resize(&resize(&opaque, w.div_ceil(BLUR), h.div_ceil(BLUR)), w, h).to_planes([0.0; 3])
}

/// Views of fixed cameras with the pixels that move there, and the PSNR of the mean images on those.
fn moving_pixels(scene: &Scene, threshold: f32, background: [f32; 3]) -> Result<(Vec<MovingPixels>, Option<f64>)> {
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for view in scene.split(Split::Train) {
        of_camera.entry(scene.views[view].camera).or_default().push(view);
    }
    of_camera.retain(|_, views| views.len() >= FEWEST_FRAMES);
    let (mut moving, mut sum) = (Vec::new(), 0.0);
    for camera in spread(&of_camera.keys().copied().collect::<Vec<_>>(), MOVING_CAMERAS) {
        let frames = spread(&of_camera[&camera], MOVING_FRAMES);
        let over_time = over_time(scene, &frames, threshold, PUBLISHED_SIGMA, background)?;
        let mask = over_time.mask;
        if mask.iter().filter(|m| **m).count() as f64 <= MOVING_SHARE * mask.len() as f64 {
            continue;
        }
        let mean: Vec<f32> = over_time.sum.iter().map(|s| (s / frames.len() as f64) as f32).collect();
        for view in spread(&frames, MOVING_VIEWS) {
            let image = scene.frame(view)?;
            sum += psnr_db(&image.to_planes(background), &mean, [image.width, image.height], Some(&mask))?;
            moving.push(MovingPixels { view, mask: mask.clone() });
        }
    }
    let mean_image_db = (!moving.is_empty()).then(|| sum / moving.len() as f64);
    Ok((moving, mean_image_db))
}

/// PSNR of planes `[3,H,W]` in dB, images not rounded, over the pixels of `mask` if given.
pub(super) fn psnr_db(truth: &[f32], image: &[f32], [width, height]: [u32; 2], mask: Option<&[bool]>) -> Result<f64> {
    let metric = Metric::psnr(Rounding::Float);
    let metric = if mask.is_some() { metric.masked() } else { metric };
    metric.score(truth, image, [3, height as usize, width as usize], mask)
}
