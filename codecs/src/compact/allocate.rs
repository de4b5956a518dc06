//! Steps of the columns relative to each other, from what a change of each costs and saves: at the best ratio all columns give the same bytes for the same
//! error of images. Derivatives give the steps to start with; this corrects for what they leave out, such as large steps and prediction.

use super::importance::budget;
use super::plan::Factors;
use super::{Job, bytes_of};
use cc4dgs_format::{RenderModel, Result, TrainingViews};
use std::ops::RangeInclusive;

/// Views on which the error is measured, by [`budget`].
const VIEWS: RangeInclusive<usize> = 4..=8;
const WORK: usize = 1_000_000;
/// The change of a step that is tried.
const CHANGE: f64 = 2.0;
/// Largest factor, and the inverse of the smallest.
const LARGEST: f64 = 8.0;

/// The factors of the columns at about the step factor `quality`.
pub fn allocate(job: &Job, quality: f64, views: &dyn TrainingViews, renderer: &dyn RenderModel) -> Result<Factors> {
    let gaussians = job.planner.gaussians;
    let chosen = views.len().min(budget(WORK, gaussians.len(), VIEWS));
    let view = |k: usize| views.view(k * views.len() / chosen);
    let originals = (0..chosen).map(|k| Ok(renderer.render(gaussians, view(k).0, view(k).1)?.planes)).collect::<Result<Vec<Vec<f32>>>>()?;
    let measure = |factors: &Factors| -> Result<(f64, f64)> {
        let (attempt, streams) = job.coded_attempt(&job.planner, quality, factors)?;
        let mut error = 0.0;
        for (k, original) in originals.iter().enumerate() {
            let drawn = renderer.render(&attempt.rounded, view(k).0, view(k).1)?;
            let colours = 3 * drawn.width as usize * drawn.height as usize;
            error += original.iter().zip(&drawn.planes).take(colours).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
        }
        Ok((error, bytes_of(&streams) as f64))
    };
    let mut factors: Factors = [1.0; 6];
    let (error, bytes) = measure(&factors)?;
    // With a factor f, the error of a column is a f² and its size b - c log2 f.
    let (mut errors, mut slopes) = ([0.0; 6], [0.0; 6]);
    for column in 0..factors.len() {
        let mut changed = factors;
        changed[column] = CHANGE;
        let (more, less) = measure(&changed)?;
        errors[column] = (more - error) / (CHANGE * CHANGE - 1.0);
        slopes[column] = (bytes - less) / libm::log2(CHANGE);
    }
    let sound: Vec<usize> = (0..6).filter(|&c| errors[c] > 0.0 && slopes[c] > 0.0).collect();
    let (total, slope) = (sound.iter().map(|&c| errors[c]).sum::<f64>(), sound.iter().map(|&c| slopes[c]).sum::<f64>());
    for column in sound {
        // The same error in all: the share of the error of each is its share of the slopes.
        factors[column] = (total * slopes[column] / (slope * errors[column])).sqrt().clamp(1.0 / LARGEST, LARGEST);
    }
    Ok(factors)
}
