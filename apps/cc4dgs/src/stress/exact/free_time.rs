//! `free-time` (FreeTimeGS, with the gate of FreeTimeGS++ and the flat-topped life of SharpTimeGS): a velocity and a life per Gaussian.

use super::{Formula, Inputs, Rows};
use cc4dgs_core::{LIFE_GATE_STEEPNESS, Result};

/// Factors below this hide a Gaussian; the logarithm of its opacity factor then; the least falloff; the largest logarithm of a width.
const HIDDEN_BELOW: f64 = 0.01;
const HIDDEN: f64 = -30.0;
const LEAST_FALLOFF: f64 = 1e-3;
const MOST_LOG: f64 = 60.0;

struct FreeTime {
    /// Per Gaussian: T, ln r, ln s, the gate's logit over the steepness, a velocity.
    lives: Rows,
}

/// `free-time`.
pub fn build(inputs: Inputs) -> Result<Box<dyn Formula>> {
    Ok(Box::new(FreeTime { lives: inputs.attributes }))
}

impl Formula for FreeTime {
    fn offsets(&self, t: f64) -> Result<Rows> {
        Ok(self.lives.iter().map(|life| at(life, t)).collect())
    }
}

/// The shift v (t - T), and the logarithm of g + (1 - g) exp(-(max(|t - T| - r, 0) / s)²).
fn at(life: &[f64], t: f64) -> Vec<f64> {
    let since = t - life[0];
    let (half_width, falloff) = (life[1].min(MOST_LOG).exp(), life[2].min(MOST_LOG).exp().max(LEAST_FALLOFF));
    let gate = 1.0 / (1.0 + (-f64::from(LIFE_GATE_STEEPNESS) * life[3]).exp());
    let in_falloffs = (since.abs() - half_width).max(0.0) / falloff;
    let factor = gate + (1.0 - gate) * (-in_falloffs * in_falloffs).exp();
    let log_factor = if factor < HIDDEN_BELOW { HIDDEN } else { factor.ln() };
    life[4..7].iter().map(|v| v * since).chain([log_factor]).collect()
}
