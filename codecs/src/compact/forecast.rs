//! What rounds of fine-tuning are expected to lose, given what those before have lost.
//!
//! After k rounds with steps s times those that need no training, the loss in dB is a s² - b - g k: rounding costs in proportion to squared steps, training
//! gains something at once and something in each round. Of a, b and g there are expectations, which each round corrects (Bayesian linear regression).

/// Share of the loss by rounding that training leaves.
const REMAINS: f64 = 0.3;
/// Gain of a hundred iterations in dB.
const GAIN: f64 = 0.04;
/// Standard deviations: of a as a share of it, of b and of g per hundred iterations in dB, and of the loss of a round from what follows from these.
const SPREADS: [f64; 3] = [0.4, 0.15, 0.03];
/// The least that a is, as a share of what is expected before the first round: losses that have other reasons may suggest that rounding gains.
const LEAST: f64 = 0.1;
const NOISE: f64 = 0.03;
/// Octaves that are looked through, and how many to an octave.
const OCTAVES: std::ops::RangeInclusive<i32> = -4..=5;
const PER_OCTAVE: i32 = 64;

/// The expectation of a, b and g.
pub struct Forecast {
    /// The inverse of their covariance, and that times their means.
    precision: [[f64; 3]; 3],
    scaled: [f64; 3],
    least: f64,
}

impl Forecast {
    /// The forecast before the first round. Rounding costs `untuned` dB without training; a round has `iterations` iterations.
    pub fn new(untuned: f64, iterations: f64) -> Self {
        let cost = REMAINS * untuned.max(1e-6);
        let hundreds = 0.01 * iterations;
        let means = [cost, 0.0, GAIN * hundreds];
        let spreads = [SPREADS[0] * cost, SPREADS[1], SPREADS[2] * hundreds];
        let mut out = Self { precision: [[0.0; 3]; 3], scaled: [0.0; 3], least: LEAST * cost };
        for (k, (mean, spread)) in means.into_iter().zip(spreads).enumerate() {
            out.precision[k][k] = 1.0 / (spread * spread);
            out.scaled[k] = out.precision[k][k] * mean;
        }
        out
    }
    /// Takes note of what was lost after `round` rounds, the last with steps so many octaves larger than those without training.
    pub fn add(&mut self, round: usize, octaves: f64, loss: f64) {
        let row = self.row(round, octaves);
        for (i, own) in row.into_iter().enumerate() {
            self.scaled[i] += own * loss / (NOISE * NOISE);
            self.precision[i].iter_mut().zip(row).for_each(|(sum, other)| *sum += own * other / (NOISE * NOISE));
        }
    }
    /// The most octaves with which at most `allowed` dB are lost after `round` rounds, even if it is `caution` standard deviations more than expected; minus
    /// infinity where none do.
    pub fn octaves(&self, round: usize, allowed: f64, caution: f64) -> f64 {
        let [cost, at_once, gain] = solve(self.precision, self.scaled);
        let loss = |octaves: f64| {
            let row = self.row(round, octaves);
            let variance: f64 = row.iter().zip(solve(self.precision, row)).map(|(a, b)| a * b).sum();
            row[0] * cost.max(self.least) - at_once - gain * round as f64 + caution * (variance + NOISE * NOISE).sqrt()
        };
        let tried = (OCTAVES.start() * PER_OCTAVE..=OCTAVES.end() * PER_OCTAVE).rev().map(|k| f64::from(k) / f64::from(PER_OCTAVE));
        tried.into_iter().find(|octaves| loss(*octaves) <= allowed).unwrap_or(f64::NEG_INFINITY)
    }
    /// The octaves with which `allowed` dB are lost where a round has just lost `loss` with `octaves` and training gains nothing more.
    pub fn octaves_after(&self, octaves: f64, loss: f64, allowed: f64) -> f64 {
        let cost = solve(self.precision, self.scaled)[0].max(self.least);
        0.5 * libm::log2((libm::exp2(2.0 * octaves) + (allowed - loss) / cost).max(f64::MIN_POSITIVE))
    }
    /// What a, b and g are multiplied with.
    fn row(&self, round: usize, octaves: f64) -> [f64; 3] {
        [libm::exp2(2.0 * octaves), -1.0, -(round as f64)]
    }
}

/// The solution of a system with a positive definite matrix.
fn solve(mut matrix: [[f64; 3]; 3], mut right: [f64; 3]) -> [f64; 3] {
    for k in 0..3 {
        let (row, value) = (matrix[k], right[k]);
        for i in (0..3).filter(|&i| i != k) {
            let factor = matrix[i][k] / row[k];
            matrix[i].iter_mut().zip(row).for_each(|(own, other)| *own -= factor * other);
            right[i] -= factor * value;
        }
    }
    std::array::from_fn(|k| right[k] / matrix[k][k])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equations_are_solved() {
        let found = solve([[4.0, 1.0, -1.0], [1.0, 3.0, 0.5], [-1.0, 0.5, 2.0]], [3.0, 8.5, 6.0]);
        assert!(found.iter().zip([1.0, 2.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?}");
    }

    #[test]
    fn rounds_teach_what_the_next_ones_lose() {
        // Losses in dB of a model of 9,542 Gaussians, of which 0.05 and 0.25 were allowed; steps that keep the limit in the end are known.
        for (limit, untuned, rounds, range) in [
            (0.05, 0.059, [(3.63, 0.170), (1.81, -0.009), (2.25, -0.014), (2.68, -0.020)], 3.3..4.1),
            (0.25, 0.301, [(2.27, 0.576), (1.14, 0.113), (1.60, 0.175), (1.73, 0.186)], 1.7..2.2),
        ] {
            let mut forecast = Forecast::new(untuned, 100.0);
            let before = libm::exp2(forecast.octaves(4, limit, 0.0));
            assert!((1.5..4.0).contains(&before), "{before}");
            for (round, (steps, loss)) in rounds.into_iter().enumerate() {
                forecast.add(round + 1, libm::log2(steps), loss);
            }
            let steps = libm::exp2(forecast.octaves(5, limit, 0.0));
            assert!(range.contains(&steps), "{steps}");
        }
        let mut hopeless = Forecast::new(0.01, 100.0);
        assert!(hopeless.octaves(4, 0.01, 1.0) < hopeless.octaves(4, 0.01, 0.0), "caution costs bytes");
        hopeless.add(1, 0.0, 5.0);
        hopeless.add(2, 0.0, 5.0);
        assert_eq!(hopeless.octaves(2, 0.01, 0.0), f64::NEG_INFINITY);
    }

    #[test]
    fn a_round_that_missed_tells_the_next_steps() {
        let forecast = Forecast::new(0.1, 100.0);
        let cost = REMAINS * 0.1;
        let [finer, coarser] = [0.05, 0.2].map(|allowed| forecast.octaves_after(1.0, 0.1, allowed));
        assert!((cost * (4.0 - libm::exp2(2.0 * finer)) - 0.05).abs() < 1e-9 && (cost * (libm::exp2(2.0 * coarser) - 4.0) - 0.1).abs() < 1e-9);
        assert!(forecast.octaves_after(1.0, 5.0, 0.0) < -10.0, "no steps are small enough");
    }

    #[test]
    fn losses_that_have_other_reasons_do_not_turn_steps_round() {
        // Where training loses, steps never grow; where it gains more than rounding costs, they never shrink.
        for (losses, grows) in [([0.5, 0.6, 0.6, 0.6], false), ([-0.2, -0.6, -1.0, -1.4], true)] {
            let (mut forecast, mut octaves) = (Forecast::new(0.06, 100.0), 1.86f64);
            for (round, loss) in losses.into_iter().enumerate() {
                forecast.add(round + 1, octaves, loss);
                let next = forecast.octaves(4, 0.05, 0.5).clamp(octaves - 1.0, octaves + 1.0);
                assert!((next >= octaves) == grows, "round {}: {octaves} to {next}", round + 1);
                octaves = next;
            }
        }
    }
}
