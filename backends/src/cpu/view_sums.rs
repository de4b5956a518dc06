//! Sums over views on the CPU: one pass over the rows.

use crate::ops::view_sums::MOST_LOGIT;
use rayon::prelude::*;

/// Rows per task.
const ROWS: usize = 4096;

/// Adds the norm of `gradient` `[N,2]` times `scale`, and 1, to the `sums` `[N,2]` of every Gaussian with a radius. Norms that are not finite are left out.
pub fn add_gradients(sums: &mut [f32], radii: &[i64], gradient: &[f32], scale: [f32; 2]) {
    let sums = sums.as_chunks_mut::<2>().0.par_chunks_mut(ROWS);
    let rows = sums.zip(radii.par_chunks(ROWS)).zip(gradient.as_chunks::<2>().0.par_chunks(ROWS));
    rows.for_each(|((sums, radii), gradient)| {
        for (([sum, seen], radius), [x, y]) in sums.iter_mut().zip(radii).zip(gradient) {
            let (x, y) = (x * scale[0], y * scale[1]);
            let norm = (x * x + y * y).sqrt();
            if *radius > 0 && norm.is_finite() {
                *sum += norm;
                *seen += 1.0;
            }
        }
    });
}

/// Adds `weights` `[N]`, their squares, and 1 where a Gaussian has a radius, to `sums` `[N,3]`.
pub fn add_weights(sums: &mut [f32], radii: &[i64], weights: &[f32]) {
    let sums = sums.as_chunks_mut::<3>().0.par_chunks_mut(ROWS);
    let rows = sums.zip(radii.par_chunks(ROWS)).zip(weights.par_chunks(ROWS));
    rows.for_each(|((sums, radii), weights)| {
        for (([sum, squares, shown], radius), weight) in sums.iter_mut().zip(radii).zip(weights) {
            *sum += weight;
            *squares += weight * weight;
            *shown += if *radius > 0 { 1.0 } else { 0.0 };
        }
    });
}

/// The `logits` `[N]` of opacities of which those with a radius are smaller by `share`.
pub fn fade(logits: &[f32], radii: &[i64], share: f32) -> Vec<f32> {
    let mut out = logits.to_vec();
    out.par_chunks_mut(ROWS).zip(radii.par_chunks(ROWS)).for_each(|(logits, radii)| {
        for (logit, _) in logits.iter_mut().zip(radii).filter(|(_, radius)| **radius > 0) {
            // o' / (1 - o') = (1 - share) / (e^-l + share), where o' = (1 - share) o.
            let odds = (1.0 - share) / ((-logit.clamp(-MOST_LOGIT, MOST_LOGIT)).exp() + share);
            *logit = odds.ln();
        }
    });
    out
}
