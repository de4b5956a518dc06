//! Fits the motion that splatV can hold to samples of a model.

use crate::still::{sigmoid, unit};
use cc4dgs_format::{Error, HostGaussians, Result};
use rayon::prelude::*;

/// A width in time that changes no opacity within the sequence: the largest half float.
const FOREVER: f32 = 65504.0;
/// Opacities that vary less than this over time, relative to the largest, are constant.
const CONSTANT: f32 = 0.01;
/// Weight of instants at which a Gaussian cannot be seen, relative to the instant at which it is seen best.
const UNSEEN: f64 = 1e-3;
/// Centres and widths that are tried for the bell of the opacity.
const CENTERS: usize = 33;
const WIDTHS: usize = 40;
/// Narrowest and widest bell of the first search, in units of the sequence.
const NARROWEST: f32 = 0.01;
const WIDEST: f32 = 4.0;
/// Searches around the best bell, each with half the step of the last.
const REFINEMENTS: usize = 6;

/// The motion of one Gaussian.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// Coefficients of dt, dt² and dt³ of the centre.
    pub powers: [[f32; 3]; 3],
    /// Change of the quaternion (w,x,y,z) per unit of time.
    pub turn: [f32; 4],
    /// The time at which dt is zero.
    pub center: f32,
    /// Width of the bell of the opacity.
    pub width: f32,
    /// Mean and largest distance of the fitted centre from the samples, weighted as the fit.
    error: (f64, f64),
}

impl Motion {
    /// No motion.
    pub fn resting() -> Self {
        Self { powers: [[0.0; 3]; 3], turn: [0.0; 4], center: 0.5, width: FOREVER, error: (0.0, 0.0) }
    }
}

/// Mean and largest error of the centres.
pub fn errors(motions: &[Motion]) -> (f64, f64) {
    let mean = motions.iter().map(|m| m.error.0).sum::<f64>() / motions.len().max(1) as f64;
    (mean, motions.iter().fold(0.0, |a, m| a.max(m.error.1)))
}

/// A moving Gaussian at one instant.
#[derive(Clone, Copy)]
struct Instant {
    mean: [f32; 3],
    rotation: [f32; 4],
    log_scales: [f32; 3],
    opacity: f32,
    color: [f32; 3],
}

/// The moving Gaussians at several instants.
pub struct Samples {
    moving: usize,
    times: Vec<f32>,
    /// By time, then by Gaussian.
    instants: Vec<Vec<Instant>>,
}

impl Samples {
    /// No samples yet of the first `moving` Gaussians.
    pub fn new(moving: usize) -> Self {
        Self { moving, times: Vec::new(), instants: Vec::new() }
    }
    /// Adds the Gaussians at `time`.
    pub fn add(&mut self, time: f32, gaussians: &HostGaussians) -> Result<()> {
        if gaussians.len() < self.moving {
            let problem = format!("{} Gaussians at time {time}, {} move", gaussians.len(), self.moving);
            return Err(Error::data("Gaussians to write as splatV", problem, "Report this as a defect of the source"));
        }
        let instant = |i: usize| Instant {
            mean: gaussians.means.as_chunks::<3>().0[i],
            rotation: unit(&gaussians.quaternions.as_chunks::<4>().0[i]).unwrap_or_default(),
            log_scales: gaussians.log_scales.as_chunks::<3>().0[i],
            opacity: sigmoid(gaussians.opacity_logits[i]),
            color: gaussians.sh_dc.as_chunks::<3>().0[i],
        };
        self.times.push(time);
        self.instants.push((0..self.moving).map(instant).collect());
        Ok(())
    }
    /// Fits all moving Gaussians, and writes what does not change over time into their rows of `gaussians`.
    pub fn fit(&self, gaussians: &mut HostGaussians) -> Vec<Motion> {
        let fits: Vec<(Motion, Instant)> = (0..self.moving)
            .into_par_iter()
            .map(|i| {
                let instants: Vec<Instant> = self.instants.iter().map(|all| all[i]).collect();
                fit(&self.times, &instants)
            })
            .collect();
        for (i, (_, constant)) in fits.iter().enumerate() {
            gaussians.means[3 * i..3 * i + 3].copy_from_slice(&constant.mean);
            gaussians.quaternions[4 * i..4 * i + 4].copy_from_slice(&constant.rotation);
            gaussians.log_scales[3 * i..3 * i + 3].copy_from_slice(&constant.log_scales);
            gaussians.sh_dc[3 * i..3 * i + 3].copy_from_slice(&constant.color);
            let opacity = constant.opacity.clamp(1e-6, 1.0 - 1e-6);
            gaussians.opacity_logits[i] = (opacity / (1.0 - opacity)).ln();
        }
        fits.into_iter().map(|(motion, _)| motion).collect()
    }
}

/// The motion of one Gaussian, and its values at dt = 0.
fn fit(times: &[f32], instants: &[Instant]) -> (Motion, Instant) {
    let opacities: Vec<f32> = instants.iter().map(|s| s.opacity).collect();
    let (center, width, opacity) = bell(times, &opacities);
    // Rounded to half floats, as the file holds them: curves are fitted to the times that players use.
    let [center, width] = [center, width].map(|v| half::f16::from_f32(v).to_f32());
    let highest = opacities.iter().fold(1e-9f32, |a, b| a.max(*b));
    let weights: Vec<f64> = opacities.iter().map(|o| UNSEEN + f64::from(o / highest).powi(2)).collect();
    let dts: Vec<f64> = times.iter().map(|t| f64::from(*t) - f64::from(center)).collect();
    let mean = |of: &dyn Fn(&Instant) -> f64| weights.iter().zip(instants).map(|(w, s)| w * of(s)).sum::<f64>() / weights.iter().sum::<f64>();

    // The coefficients above the constant are rounded to half floats first; the constant then compensates for the rounding where the Gaussian is seen.
    let degree = 3.min(times.len() - 1);
    let mut motion = Motion { center, width, ..Motion::resting() };
    let mut start = [0.0f32; 3];
    for (axis, start) in start.iter_mut().enumerate() {
        let values: Vec<f64> = instants.iter().map(|s| f64::from(s.mean[axis])).collect();
        let fitted = polynomial(&dts, &weights, &values, degree);
        for (power, coefficient) in fitted.iter().enumerate().skip(1) {
            motion.powers[power - 1][axis] = half::f16::from_f64(coefficient.clamp(-65504.0, 65504.0)).to_f32();
        }
        let along = |dt: f64| (1..4).map(|p| f64::from(motion.powers[p - 1][axis]) * dt.powi(p as i32)).sum::<f64>();
        let left: f64 = weights.iter().zip(&dts).zip(&values).map(|((w, dt), v)| w * (v - along(*dt))).sum();
        *start = (left / weights.iter().sum::<f64>()) as f32;
    }
    let distance = |(dt, s): (&f64, &Instant)| {
        let axis = |k: usize| f64::from(start[k]) + (1..4).map(|p| f64::from(motion.powers[p - 1][k]) * dt.powi(p as i32)).sum::<f64>() - f64::from(s.mean[k]);
        (0..3).map(|k| axis(k).powi(2)).sum::<f64>().sqrt()
    };
    let distances: Vec<f64> = dts.iter().zip(instants).map(distance).collect();
    let total: f64 = weights.iter().sum();
    let seen = distances.iter().zip(&weights).filter(|(_, w)| **w > 0.01).fold(0.0f64, |a, (d, _)| a.max(*d));
    motion.error = (distances.iter().zip(&weights).map(|(d, w)| d * w).sum::<f64>() / total, seen);

    // q and -q are the same rotation; along the samples the nearer one counts.
    let mut last = instants[0].rotation;
    let rotations: Vec<[f32; 4]> = instants
        .iter()
        .map(|s| {
            let along: f32 = s.rotation.iter().zip(last).map(|(a, b)| a * b).sum();
            last = if along < 0.0 { s.rotation.map(|v| -v) } else { s.rotation };
            last
        })
        .collect();
    let mut rotation = [0.0f32; 4];
    for k in 0..4 {
        let values: Vec<f64> = rotations.iter().map(|q| f64::from(q[k])).collect();
        let fitted = polynomial(&dts, &weights, &values, degree.min(1));
        (rotation[k], motion.turn[k]) = (fitted[0] as f32, fitted.get(1).map_or(0.0, |v| *v as f32));
    }
    // The file's rotation at dt = 0 has length one, and its change is on the same scale.
    let norm = rotation.iter().map(|v| v * v).sum::<f32>().sqrt();
    if norm > 1e-6 {
        rotation = rotation.map(|v| v / norm);
        motion.turn = motion.turn.map(|v| v / norm);
    }
    let constant = Instant {
        mean: start,
        rotation,
        log_scales: std::array::from_fn(|k| mean(&|s| f64::from(s.log_scales[k])) as f32),
        opacity,
        color: std::array::from_fn(|k| mean(&|s| f64::from(s.color[k])) as f32),
    };
    (motion, constant)
}

/// Centre, width and height of the bell that is nearest to `opacities` at `times`. Opacities that hardly vary have no bell.
fn bell(times: &[f32], opacities: &[f32]) -> (f32, f32, f32) {
    let (lowest, highest) = opacities.iter().fold((f32::INFINITY, 0.0f32), |(a, b), o| (a.min(*o), b.max(*o)));
    let mean = opacities.iter().sum::<f32>() / opacities.len() as f32;
    let (Some(&from), Some(&to)) = (times.first(), times.last()) else { return (0.5, FOREVER, mean) };
    let middle = 0.5 * (from + to);
    let error = |height: f32, bell: &dyn Fn(f32) -> f32| times.iter().zip(opacities).map(|(t, o)| (o - height * bell(*t)).powi(2)).sum::<f32>();
    let mut best = (middle, FOREVER, mean);
    if highest - lowest <= CONSTANT * highest || times.len() < 2 {
        return best;
    }
    let mut least = error(mean, &|_| 1.0);
    let span = to - from;
    let mut consider = |center: f32, width: f32| {
        let bell = |t: f32| (-((t - center) / width).powi(2)).exp();
        let (top, bottom) = times.iter().zip(opacities).fold((0.0, 0.0), |(a, b), (t, o)| (a + o * bell(*t), b + bell(*t).powi(2)));
        if bottom > 1e-12 {
            let height = (top / bottom).min(1.0);
            let found = error(height, &bell);
            if found < least {
                (least, best) = (found, (center, width, height));
            }
        }
        best
    };
    // From a quarter before the first instant to a quarter after the last: a Gaussian may only fade in, or only fade out.
    let (mut step, mut factor) = (1.5 * span / (CENTERS - 1) as f32, (WIDEST / NARROWEST).powf(1.0 / (WIDTHS - 1) as f32));
    for c in 0..CENTERS {
        for w in 0..WIDTHS {
            consider(from - 0.25 * span + step * c as f32, span * NARROWEST * factor.powi(w as i32));
        }
    }
    for _ in 0..REFINEMENTS {
        (step, factor) = (0.5 * step, factor.sqrt());
        let (center, width, _) = consider(middle, FOREVER);
        for (c, w) in [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1)] {
            consider(center + step * c as f32, (width * factor.powi(w)).min(FOREVER));
        }
    }
    best
}

/// Coefficients of the polynomial of `degree` (0 to 3) nearest to `values` at `xs`, weighted. Where the samples do not determine them, the degree is lowered.
fn polynomial(xs: &[f64], weights: &[f64], values: &[f64], degree: usize) -> Vec<f64> {
    let n = degree + 1;
    // Normal equations with the right side in the last column; Gaussian elimination with pivots.
    let mut rows = vec![vec![0.0f64; n + 1]; n];
    for ((x, w), v) in xs.iter().zip(weights).zip(values) {
        for (r, row) in rows.iter_mut().enumerate() {
            for (c, cell) in row.iter_mut().enumerate().take(n) {
                *cell += w * x.powi((r + c) as i32);
            }
            row[n] += w * v * x.powi(r as i32);
        }
    }
    let scale = rows[0][0];
    for column in 0..n {
        let pivot = (column..n).fold(column, |a, r| if rows[r][column].abs() > rows[a][column].abs() { r } else { a });
        rows.swap(column, pivot);
        if rows[column][column].abs() <= 1e-12 * scale {
            return if degree == 0 { vec![0.0] } else { polynomial(xs, weights, values, degree - 1) };
        }
        let pivot_row = rows[column].clone();
        for (_, row) in rows.iter_mut().enumerate().filter(|(r, _)| *r != column) {
            let factor = row[column] / pivot_row[column];
            row.iter_mut().zip(&pivot_row).skip(column).for_each(|(cell, pivot)| *cell -= factor * pivot);
        }
    }
    (0..n).map(|k| rows[k][n] / rows[k][k]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_are_found_and_few_samples_lower_the_degree() {
        let xs: Vec<f64> = (0..9).map(|i| f64::from(i) / 8.0 - 0.5).collect();
        let values: Vec<f64> = xs.iter().map(|x| 2.0 - x + 3.0 * x * x - 4.0 * x * x * x).collect();
        let found = polynomial(&xs, &[1.0; 9], &values, 3);
        assert!(found.iter().zip([2.0, -1.0, 3.0, -4.0]).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        let equal = polynomial(&[0.25; 5], &[1.0; 5], &[7.0; 5], 3);
        assert!(equal.len() == 1 && (equal[0] - 7.0).abs() < 1e-12, "{equal:?}");
    }

    #[test]
    fn bells_are_found() {
        let times: Vec<f32> = (0..24).map(|i| i as f32 / 23.0).collect();
        for (center, width, height) in [(0.4f32, 0.15f32, 0.8f32), (1.0, 0.5, 0.9), (0.0, 0.3, 0.4)] {
            let opacities: Vec<f32> = times.iter().map(|t| height * (-((t - center) / width).powi(2)).exp()).collect();
            let (c, w, h) = bell(&times, &opacities);
            let far = times.iter().zip(&opacities).fold(0.0f32, |a, (t, o)| a.max((o - h * (-((t - c) / w).powi(2)).exp()).abs()));
            assert!(far < 0.01, "{center} {width} {height} became {c} {w} {h}: {far}");
        }
        assert_eq!(bell(&times, &[0.7; 24]).1, FOREVER);
    }

    #[test]
    fn curves_are_fitted_around_the_centre_that_the_file_holds() {
        let times: Vec<f32> = (0..24).map(|i| i as f32 / 23.0).collect();
        for peak in [0.53f32, 0.61, 0.7, 0.79, 0.87, 0.96] {
            let at = |t: &f32| {
                let opacity = 0.8 * (-((t - peak) / 0.2).powi(2)).exp();
                Instant { mean: [512.0 * t, 0.0, 0.0], rotation: [1.0, 0.0, 0.0, 0.0], log_scales: [0.0; 3], opacity, color: [0.0; 3] }
            };
            let (motion, constant) = fit(&times, &times.iter().map(at).collect::<Vec<Instant>>());
            let half = |v: f32| half::f16::from_f32(v).to_f32();
            assert!((motion.center - peak).abs() < 0.01 && motion.width < 0.3, "{motion:?}");
            // The centre that players compute where the Gaussian is seen best, against the true one: motion is linear, and its coefficient is a half float.
            let seen = constant.mean[0] + motion.powers[0][0] * (peak - half(motion.center));
            assert!((seen - 512.0 * peak).abs() < 0.02, "{seen} instead of {}", 512.0 * peak);
            assert_eq!((half(motion.center), half(motion.width)), (motion.center, motion.width));
        }
    }

    #[test]
    fn a_turn_is_followed_through_the_change_of_sign() {
        let times: Vec<f32> = (0..9).map(|i| i as f32 / 8.0).collect();
        let at = |i: usize| {
            let angle = 0.4 * times[i];
            let sign = if i.is_multiple_of(2) { 1.0 } else { -1.0 };
            let rotation = [sign * angle.cos(), 0.0, sign * angle.sin(), 0.0];
            Instant { mean: [times[i].powi(3), 0.0, 5.0], rotation, log_scales: [-1.0; 3], opacity: 0.5, color: [0.1; 3] }
        };
        let instants: Vec<Instant> = (0..9).map(at).collect();
        let (motion, constant) = fit(&times, &instants);
        assert!(motion.error.1 < 2e-3, "{motion:?}");
        for t in &times {
            let dt = t - motion.center;
            let q: [f32; 4] = std::array::from_fn(|k| constant.rotation[k] + motion.turn[k] * dt);
            let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            let along = (q[0] * (0.4 * t).cos() + q[2] * (0.4 * t).sin()) / norm;
            assert!(along.abs() > 0.9999, "{along} at {t}");
        }
    }
}
