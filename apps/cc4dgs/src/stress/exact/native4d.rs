//! `native-4d` (4D-GS, Yang et al. 2024): Gaussians of space and time, conditioned on a time.

use super::{Formula, Inputs, Rows};
use cc4dgs_core::Result;
use std::f64::consts::TAU;

/// Cosines of time by which colours change.
const HARMONICS: usize = 2;
/// Factors below this hide a Gaussian; the logarithm of its opacity factor then; the largest absolute logarithm of a duration.
const HIDDEN_BELOW: f64 = 0.05;
const HIDDEN: f64 = -30.0;
const MOST_LOG: f64 = 30.0;
/// Where the coefficients of the cosines begin.
const COLORS: usize = 5;

struct Native4d {
    /// Per Gaussian: T, ln d (the standard deviation in time), a velocity, per cosine a coefficient of every spherical-harmonics coefficient.
    attributes: Rows,
    /// Spherical-harmonics coefficients of all channels.
    coefficients: usize,
}

/// `native-4d`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    let coefficients = 3 * (inputs.context.sh_degree + 1).pow(2);
    Ok(Box::new(Native4d { attributes: inputs.attributes, coefficients }))
}

impl Formula for Native4d {
    /// The shift v (t - T), the logarithm of exp(-((t - T) / d)² / 2), and of each colour coefficient the sum over n of c_n cos(2π n (t - T)).
    fn offsets(&self, t: f64) -> Result<Rows> {
        let row = |own: &Vec<f64>| -> Vec<f64> {
            let since = t - own[0];
            let in_durations = since / own[1].clamp(-MOST_LOG, MOST_LOG).exp();
            let log_factor = -0.5 * in_durations * in_durations;
            let log_factor = if log_factor < HIDDEN_BELOW.ln() { HIDDEN } else { log_factor };
            let mut colors = vec![0.0; self.coefficients];
            for (n, of_cosine) in own[COLORS..].chunks_exact(self.coefficients).enumerate().take(HARMONICS) {
                let cosine = (TAU * (n + 1) as f64 * since).cos();
                colors.iter_mut().zip(of_cosine).for_each(|(sum, c)| *sum += c * cosine);
            }
            own[2..COLORS].iter().map(|v| v * since).chain([log_factor]).chain(colors).collect()
        };
        Ok(self.attributes.iter().map(row).collect())
    }
}
