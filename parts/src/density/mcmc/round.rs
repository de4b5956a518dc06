//! One round: faded and hidden Gaussians are removed, and as many others are split into halves.

use super::Settings;
use crate::density::halves;
use cc4dgs_core::{DensityPlan, HostGaussians, Seed};
use rand::Rng;

/// The plan of one round: which of the Gaussians are removed, kept and split, so that there are at most `budget`. `scores` `[N]` are the weights
/// with which Gaussians are drawn for splitting. Of the rows `hidden` the first are relocated: removed, as many as others can be split for.
pub(super) fn round(settings: &Settings, host: &HostGaussians, scores: &[f32], hidden: &[usize], budget: usize, seed: Seed) -> DensityPlan {
    let n = host.len();
    let opacity = |row: usize| 1.0 / (1.0 + (-host.opacity_logits[row]).exp());
    let alive: Vec<usize> = (0..n).filter(|&row| host.is_finite(row) && opacity(row) >= settings.min_opacity).collect();
    let mut plan = DensityPlan::new();
    if alive.is_empty() {
        return DensityPlan::unchanged(n);
    }
    let hidden: Vec<usize> = hidden.iter().copied().filter(|row| alive.binary_search(row).is_ok()).collect();
    let mut goes = vec![false; n];
    hidden.iter().for_each(|&row| goes[row] = true);
    let stays: Vec<usize> = alive.iter().copied().filter(|&row| !goes[row]).collect();
    // The trainer may have kept faded rows: the number above the budget is subtracted.
    let over = (0..n).filter(|&row| host.is_finite(row)).count().saturating_sub(budget);
    let slots = budget.saturating_sub(stays.len() + over).min((settings.growth * n as f64).ceil() as usize);
    let drawn = drawn(&stays, scores, slots, seed);
    let mut splits = vec![false; n];
    drawn.iter().for_each(|&row| splits[row] = true);
    // If too few others can be split, the last hidden rows stay, up to the budget: rows that the trainer kept of earlier plans may exceed it.
    let missing = alive.len().min(budget).saturating_sub(stays.len() + drawn.len());
    let moved = hidden.len().saturating_sub(missing);
    hidden[moved..].iter().for_each(|&row| goes[row] = false);
    for &row in alive.iter().filter(|&&row| !goes[row]) {
        if splits[row] {
            halves::split(&mut plan, host, row);
        } else {
            plan.keep(row);
        }
    }
    plan.report.moved = moved.min(drawn.len());
    plan.report.removed = n - alive.len() + moved - plan.report.moved;
    plan.report.split = drawn.len() - plan.report.moved;
    plan
}

/// `count` of `rows`, drawn without replacement in proportion to their `scores`; rows without a score are never drawn.
fn drawn(rows: &[usize], scores: &[f32], count: usize, seed: Seed) -> Vec<usize> {
    let mut random = seed.rng();
    // Exponential random numbers with the scores as rates: those with the smallest are a weighted draw (Efraimidis and Spirakis 2006).
    let keyed = |&row: &usize| {
        let uniform: f32 = random.random();
        (-(1.0 - uniform).max(f32::MIN_POSITIVE).ln() / scores[row], row)
    };
    let mut keyed: Vec<(f32, usize)> = rows.iter().map(keyed).filter(|(_, row)| scores[*row] > 0.0 && scores[*row].is_finite()).collect();
    keyed.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    keyed.into_iter().take(count).map(|(_, row)| row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host_of(opacities: &[f32]) -> HostGaussians {
        let n = opacities.len();
        HostGaussians {
            means: (0..n).flat_map(|row| [row as f32, 0.0, 0.0]).collect(),
            log_scales: vec![-3.0; 3 * n],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(n),
            opacity_logits: opacities.iter().map(|o| (o / (1.0 - o)).ln()).collect(),
            sh_dc: vec![0.0; 3 * n],
            dynamic_scores: vec![0.0; n],
            ..Default::default()
        }
    }

    #[test]
    fn faded_gaussians_are_replaced_by_halves_of_those_with_gradients() {
        let mut host = host_of(&[0.5, 0.001, 0.5, 0.5, 0.5]);
        host.means[12] = f32::NAN;
        let settings = Settings { growth: 1.0, ..Default::default() };
        let plan = round(&settings, &host, &[0.0, 1.0, 1.0, 0.0, 1.0], &[], 4, Seed::root(1));
        // Row 1 faded, row 4 is broken; of the others only row 2 has a gradient.
        assert_eq!((plan.parents(), plan.fresh()), (&[0, 2, 2, 3][..], &[false, true, true, false][..]));
        assert_eq!((plan.report.removed, plan.report.split), (2, 1));
        let full = round(&settings, &host_of(&[0.5; 4]), &[1.0; 4], &[], 4, Seed::root(1));
        assert!(full.keeps_all(4), "nothing happens at the budget");
        let above = round(&settings, &host_of(&[0.5, 0.5, 0.5, 0.001, 0.001]), &[1.0; 5], &[], 4, Seed::root(1));
        assert_eq!((above.parents(), above.report.split), (&[0, 1, 2][..], 0), "faded rows that the trainer may keep are above the budget");
        assert!(round(&settings, &host_of(&[0.001; 3]), &[1.0; 3], &[], 9, Seed::root(1)).keeps_all(3), "never all of them");
        // At the budget, the hidden row is removed and the only other row with a gradient is split; if no other has a gradient, the hidden row stays.
        let plan = round(&settings, &host_of(&[0.5; 4]), &[1.0, 0.0, 1.0, 0.0], &[2], 4, Seed::root(1));
        assert_eq!((plan.parents(), plan.report.moved, plan.report.split), (&[0, 0, 1, 3][..], 1, 0));
        assert!(round(&settings, &host_of(&[0.5; 4]), &[0.0, 0.0, 1.0, 0.0], &[2], 4, Seed::root(1)).keeps_all(4));
    }

    #[test]
    fn draws_follow_the_scores() {
        let rows: Vec<usize> = (0..1000).collect();
        let scores: Vec<f32> = rows.iter().map(|&row| if row < 500 { 3.0 } else { 1.0 }).collect();
        let drawn = drawn(&rows, &scores, 100, Seed::root(5));
        let heavy = drawn.iter().filter(|&&row| row < 500).count();
        assert!(drawn.len() == 100 && (60..90).contains(&heavy), "{heavy} of 100");
    }
}
