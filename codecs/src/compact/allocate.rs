//! Steps of the columns relative to each other, from the error and the bytes that a change of each gives: at the best ratio all columns give the same bytes
//! for the same error of images. Derivatives give the first steps; this corrects for what derivatives leave out, such as large steps and prediction.

use super::bytes_of;
use super::images::Images;
use super::importance::budget;
use super::job::Job;
use super::plan::{Factors, Plan};
use cc4dgs_format::{HostGaussians, RenderModel, Result, TrainingViews};
use std::ops::RangeInclusive;

/// Views on which the error is measured, by [`budget`].
const VIEWS: RangeInclusive<usize> = 4..=8;
const WORK: usize = 1_000_000;
/// The factor by which a step is changed to measure its effect.
const CHANGE: f64 = 2.0;
/// Largest factor, and the inverse of the smallest.
const LARGEST: f64 = 8.0;

/// The factors of the columns at about the step factor `quality`. `known` are the plan and the bytes without factors, where these have been found before;
/// `whole` are the Gaussians to encode, as renderers take them.
pub fn allocate(
    job: &Job,
    quality: f64,
    known: Option<(&Plan, usize)>,
    whole: &HostGaussians,
    views: &dyn TrainingViews,
    renderer: &dyn RenderModel,
) -> Result<Factors> {
    let images = Images::of(whole, views, renderer, views.len().min(budget(WORK, whole.len(), VIEWS)))?;
    let measure = |factors: &Factors| -> Result<(f64, f64)> {
        let (streams, rounded) = job.coded_and_restored(quality, factors)?;
        Ok((images.error(rounded)?, bytes_of(&streams) as f64))
    };
    let mut factors: Factors = [1.0; 6];
    let (error, bytes) = match known {
        Some((plan, bytes)) => (images.error(job.restored(job.planner.gaussians, plan))?, bytes as f64),
        None => measure(&factors)?,
    };
    // With a factor f, the error of a column is a f² and its size b - c log2 f.
    let (mut errors, mut slopes) = ([0.0; 6], [0.0; 6]);
    // Without harmonics the last column is empty.
    let columns = if job.planner.gaussians.sh_degree == 0 { factors.len() - 1 } else { factors.len() };
    for column in 0..columns {
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
