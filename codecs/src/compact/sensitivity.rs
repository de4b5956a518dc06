//! How much errors of the attributes of plug-ins change images, measured by changing them.

use super::columns::Columns;
use super::encode::Classes;
use super::images::Images;
use super::importance::{budget, median, middle_log_scale};
use cc4dgs_format::{CodecContext, ExtraAttribute, Result};
use std::ops::RangeInclusive;

/// Views on which errors are measured, by [`budget`].
const VIEWS: RangeInclusive<usize> = 4..=8;
const WORK: usize = 500_000;
/// The first change of the values, in their standard deviations.
const CHANGE: f64 = 0.02;
/// Largest step, in standard deviations.
pub const LARGEST: f64 = 0.5;

/// How steps grow from row to row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Growth {
    /// Not at all.
    None,
    /// By the class of the shape.
    Class,
    /// As the steps of centres: by class and size.
    Size,
}

impl Growth {
    pub const ALL: [Self; 3] = [Self::None, Self::Class, Self::Size];
    /// Octaves of a row; `middle` is the middle log-scale.
    fn octaves(self, shape: u8, middle: f64) -> f64 {
        match self {
            Self::None => 0.0,
            Self::Class => f64::from(shape),
            Self::Size => f64::from(shape) + middle.clamp(-60.0, 60.0) / std::f64::consts::LN_2,
        }
    }
}

/// How much errors of an attribute change images.
#[derive(Clone, Debug)]
pub struct Sensitivity {
    pub name: String,
    pub growth: Growth,
    /// Root of the sum over pixels and channels of squared derivatives, mean over images and values, for values whose octaves are 0.
    pub weight: f64,
}

/// The rows of an attribute that must be stored.
pub fn needed(attribute: &ExtraAttribute, count: usize) -> Vec<bool> {
    attribute.needed.as_ref().map_or_else(|| vec![true; count], |needed| needed.rows.clone())
}

/// Means of the columns over `rows`, and the standard deviation of all values from them.
pub fn moments(attribute: &ExtraAttribute, rows: &[bool]) -> (Vec<f32>, f64) {
    let width = attribute.width;
    let stored = || attribute.values.chunks_exact(width.max(1)).zip(rows).filter(|(_, stored)| **stored).map(|(row, _)| row);
    let count = stored().count().max(1) as f64;
    let means: Vec<f32> = (0..width).map(|k| (stored().map(|row| f64::from(row[k])).sum::<f64>() / count) as f32).collect();
    let squares: f64 = stored().flat_map(|row| row.iter().zip(&means)).map(|(v, m)| (f64::from(*v) - f64::from(*m)).powi(2)).sum();
    (means, (squares / (count * width.max(1) as f64)).sqrt())
}

/// Measures the attributes of canonical Gaussians at about the step factor `quality`; empty where the context cannot render them.
pub fn measure(gaussians: Columns, classes: &Classes, context: &CodecContext, quality: f64) -> Result<Vec<Sensitivity>> {
    let services = context.views.zip(context.renderer).filter(|(views, _)| !views.is_empty() && context.deformer.is_some());
    let Some((views, renderer)) = services.filter(|_| !gaussians.is_empty() && !gaussians.extra.is_empty()) else { return Ok(Vec::new()) };
    let gaussians = gaussians.to_host();
    let images = Images::of(&gaussians, views, renderer, views.len().min(budget(WORK, gaussians.len(), VIEWS)))?;
    let middles: Vec<f64> = gaussians.log_scales.chunks_exact(3).map(middle_log_scale).collect();
    let mut out = Vec::new();
    for (name, attribute) in gaussians.extra.iter().filter(|(_, attribute)| attribute.width > 0) {
        let rows = needed(attribute, gaussians.len());
        let spread = moments(attribute, &rows).1;
        let seed = context.seed.child("attributes").child(name);
        // The weight of values that are changed by `change` times a number drawn from the seed, at most by `most`.
        let weight = |octaves: &[f64], change: f64, most: f64, draws: u64| -> Result<f64> {
            let (mut changed, mut sum) = (gaussians.clone(), 0.0);
            let values = changed.extra.get_mut(name).map(|a| a.values.chunks_exact_mut(attribute.width)).into_iter().flatten();
            for (i, row) in values.enumerate().filter(|(i, _)| rows[*i]) {
                for (k, value) in row.iter_mut().enumerate() {
                    let word = seed.index(draws).index(i as u64).index(k as u64).value();
                    // Two values for a change, all between them for a rounding error.
                    let part = if draws == 0 { if word >> 63 == 0 { 1.0 } else { -1.0 } } else { (word >> 11) as f64 / (1u64 << 52) as f64 - 1.0 };
                    let unit = libm::exp2(octaves[i]);
                    let by = part * (change * unit).min(most);
                    *value += by as f32;
                    sum += (by / unit).powi(2);
                }
            }
            let squared = images.error(changed)? / (images.len() as f64 * sum);
            Ok(if squared.is_finite() { squared.sqrt() } else { 0.0 })
        };
        let mut best: Option<(f64, Sensitivity, Vec<f64>)> = None;
        for growth in Growth::ALL {
            let octaves: Vec<f64> = classes.shapes.iter().zip(&middles).map(|(&shape, &middle)| growth.octaves(shape, middle)).collect();
            let of_rows: Vec<f64> = octaves.iter().zip(&rows).filter(|(_, stored)| **stored).map(|(o, _)| *o).collect();
            let found = weight(&octaves, CHANGE * spread / libm::exp2(median(&of_rows)), LARGEST * spread, 0)?;
            // At equal error, larger steps are fewer bits.
            let bits = -of_rows.iter().sum::<f64>() / of_rows.len().max(1) as f64 + libm::log2(found.max(1e-300));
            if best.as_ref().is_none_or(|(least, ..)| bits < *least) {
                best = Some((bits, Sensitivity { name: name.clone(), growth, weight: found }, octaves));
            }
        }
        let Some((_, mut found, octaves)) = best else { continue };
        // Again with errors as large as those of rounding.
        let rounded = weight(&octaves, 0.5 * quality / found.weight, 0.5 * LARGEST * spread, 1)?;
        if rounded > 0.0 {
            found.weight = rounded;
        }
        out.push(found);
    }
    Ok(out)
}
