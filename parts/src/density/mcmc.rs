//! A budget of Gaussians that goes where the images need it (3DGS-MCMC, with growth by score and halves along the longest axis as in ImprovedGS).
//!
//! Faded Gaussians are removed, and as many others are split, drawn by their screen gradients. The budget grows with the root of the progress. The two halves of a
//! split together draw nearly what the whole drew, so that a round costs little.

use super::halves;
use super::statistics::Statistics;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    DensityControl, DensityPlan, DensityPlugin, Error, Gaussians, HostGaussians, Plugin, Result, Schedule, Seed, Stage, Statistic, ViewStatistics, config,
    inventory,
};
use rand::Rng;
use serde::Deserialize;

const SCHEMA: &str = "\
from = 500               # first round, in reference iterations of the stage (coarse 5,000, main 20,000)
until = 15000            # last round, in reference iterations of the main stage; the coarse stage has rounds to nine tenths
every = 100              # reference iterations between two rounds
min_opacity = 0.005      # fainter Gaussians are removed, and the budget is spent on others
growth = 0.1             # most Gaussians split in a round, as a share of all
coarse_share = 0.6       # share of max_gaussians that the coarse stage grows to
max_gaussians = 400000   # the budget at the end
noise = 0.0              # random steps of faint Gaussians, as a share of their size per iteration; 0 is off
";

/// Least number of iterations between two rounds.
const MIN_INTERVAL: usize = 25;
/// Share of the coarse stage that has rounds.
const COARSE_ROUNDS: f64 = 0.9;
/// Opacity around which noise fades, and how steeply (3DGS-MCMC).
const NOISE_OPACITY: f32 = 0.005;
const NOISE_STEEPNESS: f32 = 100.0;

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    from: usize,
    until: usize,
    every: usize,
    min_opacity: f32,
    growth: f64,
    coarse_share: f64,
    max_gaussians: usize,
    noise: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { from: 500, until: 15_000, every: 100, min_opacity: 0.005, growth: 0.1, coarse_share: 0.6, max_gaussians: 400_000, noise: 0.0 }
    }
}

impl Settings {
    /// The iteration of the stage at which rounds end.
    fn end(&self, schedule: &Schedule) -> usize {
        match schedule.stage {
            Stage::Coarse => (COARSE_ROUNDS * schedule.length as f64) as usize,
            _ => schedule.at(self.until),
        }
    }
    fn due(&self, schedule: &Schedule) -> bool {
        let iteration = schedule.iteration;
        iteration > schedule.at(self.from) && iteration <= self.end(schedule) && iteration.is_multiple_of(schedule.interval(self.every, MIN_INTERVAL))
    }
    /// How many Gaussians there may be now, where the stage began with `start`.
    fn budget(&self, start: usize, schedule: &Schedule) -> usize {
        let share = if schedule.stage == Stage::Coarse { self.coarse_share } else { 1.0 };
        let most = share * self.max_gaussians as f64;
        let done = (schedule.iteration as f64 / self.end(schedule).max(1) as f64).min(1.0);
        (start as f64 + (most - start as f64).max(0.0) * done.sqrt()) as usize
    }
}

struct Mcmc {
    settings: Settings,
    statistics: Statistics,
    /// Gaussians at the start of the stage.
    start: usize,
    /// Whether the last plan was a round.
    round: bool,
}

impl DensityControl for Mcmc {
    fn begin_stage(&mut self, count: usize, device: &Device) {
        self.statistics = Statistics::zeros(count, device);
        self.start = count;
    }
    fn statistics(&self, schedule: &Schedule) -> Vec<Statistic> {
        if schedule.iteration <= self.settings.end(schedule) { vec![Statistic::AbsoluteScreenGradient] } else { Vec::new() }
    }
    fn observe(&mut self, view: &ViewStatistics) -> Result<()> {
        self.statistics.add(view);
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Option<DensityPlan>> {
        self.round = self.settings.due(schedule);
        if !self.round {
            return Ok(None);
        }
        let scores = self.statistics.mean_gradients()?;
        Ok(Some(round(&self.settings, &gaussians.to_host()?, &scores, self.settings.budget(self.start, schedule), seed)))
    }
    fn executed(&mut self, plan: &DensityPlan, device: &Device) -> Result<()> {
        // A round starts over; so do the statistics when somebody else changed the rows.
        if self.round || !plan.keeps_all(self.statistics.seen.dims()[0]) {
            self.statistics = Statistics::zeros(plan.len(), device);
        }
        Ok(())
    }
    fn after_step(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        if self.settings.noise == 0.0 {
            return Ok(Vec::new());
        }
        let (n, mut random) = (gaussians.len(), seed.rng());
        // The sum of twelve uniform numbers, minus six, is nearly standard normal.
        let normal: Vec<f32> = (0..3 * n).map(|_| (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0).collect();
        let normal = Tensor::<2>::from_data(TensorData::new(normal, [n, 3]), &gaussians.means.device());
        let above = sigmoid(gaussians.opacity_logits.clone()).sub_scalar(NOISE_OPACITY);
        let faint = sigmoid(above.mul_scalar(-NOISE_STEEPNESS)).reshape([n, 1]);
        let size = gaussians.log_scales.clone().mean_dim(1).exp();
        let share = self.settings.noise * (1.0 - schedule.progress() as f32);
        Ok(vec![("means".into(), gaussians.means.clone() + normal * faint * size * share)])
    }
    fn state(&self) -> Vec<(String, Tensor<1>)> {
        let mut arrays = self.statistics.arrays();
        let device = arrays[0].1.device();
        // Up to 16,777,216 a float32 is exact; beyond, the budget of a resumed run differs by a row or two.
        arrays.push(("start".into(), Tensor::from_floats([self.start as f32], &device)));
        arrays
    }
    fn restore(&mut self, mut state: Vec<(String, Tensor<1>)>, count: usize) -> Result<()> {
        let damaged = || Error::data("density state 'start'", "it is missing or not a count", "The checkpoint is damaged or of another density control");
        let at = state.iter().position(|(name, _)| name == "start").ok_or_else(damaged)?;
        let start = to_vec(state.swap_remove(at).1, "start")?;
        match start[..] {
            [start] if (0.0..1e9).contains(&start) => self.start = start as usize,
            _ => return Err(damaged()),
        }
        self.statistics = Statistics::from_arrays(state, count)?;
        Ok(())
    }
}

/// The plan of one round: which of the Gaussians are removed, kept and split, so that there are at most `budget`. `scores` say who is split `[N]`.
fn round(settings: &Settings, host: &HostGaussians, scores: &[f32], budget: usize, seed: Seed) -> DensityPlan {
    let n = host.len();
    let opacity = |row: usize| 1.0 / (1.0 + (-host.opacity_logits[row]).exp());
    let alive: Vec<usize> = (0..n).filter(|&row| host.is_finite(row) && opacity(row) >= settings.min_opacity).collect();
    let mut plan = DensityPlan::new();
    if alive.is_empty() {
        return DensityPlan::unchanged(n);
    }
    let slots = budget.saturating_sub(alive.len()).min((settings.growth * n as f64).ceil() as usize);
    let mut splits = vec![false; n];
    drawn(&alive, scores, slots, seed).into_iter().for_each(|row| splits[row] = true);
    for &row in &alive {
        if splits[row] {
            halves::split(&mut plan, host, row);
        } else {
            plan.keep(row);
        }
    }
    plan.report.removed = n - alive.len();
    plan.report.split = plan.len() - alive.len();
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

fn build(section: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let settings: Settings = config::parse_section("density mcmc", section)?;
    let out_of_range =
        |key: &str, value: f64, limits: &str| Err(Error::parameter(format!("density mcmc: {key}"), format!("{value} is not in {limits}"), "Change it"));
    if settings.every == 0 {
        return Err(Error::parameter("density mcmc: every", "0 iterations", "Give at least 1, or use density.kind = \"none\""));
    }
    for (key, value, most) in [
        ("min_opacity", f64::from(settings.min_opacity), 0.999),
        ("growth", settings.growth, 1.0),
        ("coarse_share", settings.coarse_share, 1.0),
        ("noise", f64::from(settings.noise), 100.0),
    ] {
        if !(0.0..=most).contains(&value) {
            return out_of_range(key, value, &format!("0..{most}"));
        }
    }
    Ok(Box::new(Mcmc { settings, statistics: Statistics::zeros(0, &Device::flex()), start: 0, round: false }))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "mcmc",
            version: "1",
            summary: "a budget that moves from faded Gaussians to where screen gradients are large",
            paper: "3DGS-MCMC (Kheradmand et al. 2024); ImprovedGS",
            schema: SCHEMA,
            capabilities: &[],
        },
        build,
    }
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
    fn faded_gaussians_make_room_for_halves_of_those_with_gradients() {
        let mut host = host_of(&[0.5, 0.001, 0.5, 0.5, 0.5]);
        host.means[12] = f32::NAN;
        let settings = Settings { growth: 1.0, ..Default::default() };
        let plan = round(&settings, &host, &[0.0, 1.0, 1.0, 0.0, 1.0], 4, Seed::root(1));
        // Row 1 faded, row 4 is broken; of the others only row 2 has a gradient.
        assert_eq!((plan.parents(), plan.fresh()), (&[0, 2, 2, 3][..], &[false, true, true, false][..]));
        assert_eq!((plan.report.removed, plan.report.split), (2, 1));
        let full = round(&settings, &host_of(&[0.5; 4]), &[1.0; 4], 4, Seed::root(1));
        assert!(full.keeps_all(4), "nothing happens at the budget");
        assert!(round(&settings, &host_of(&[0.001; 3]), &[1.0; 3], 9, Seed::root(1)).keeps_all(3), "never all of them");
    }

    #[test]
    fn draws_follow_the_scores() {
        let rows: Vec<usize> = (0..1000).collect();
        let scores: Vec<f32> = rows.iter().map(|&row| if row < 500 { 3.0 } else { 1.0 }).collect();
        let drawn = drawn(&rows, &scores, 100, Seed::root(5));
        let heavy = drawn.iter().filter(|&&row| row < 500).count();
        assert!(drawn.len() == 100 && (60..90).contains(&heavy), "{heavy} of 100");
    }

    #[test]
    fn the_budget_grows_with_the_root_of_the_progress() {
        let settings = Settings { max_gaussians: 1000, ..Default::default() };
        let at = |iteration| settings.budget(200, &Schedule { iteration, ..Schedule::main(20_000) });
        assert_eq!((at(0), at(3750), at(15_000), at(20_000)), (200, 600, 1000, 1000));
        let coarse = Schedule { stage: Stage::Coarse, iteration: 5000, ..Schedule::main(5000) };
        assert_eq!(settings.budget(200, &coarse), 600);
        assert_eq!(settings.budget(800, &coarse), 800, "a stage that starts over its share stays");
    }
}
