//! A budget of Gaussians that is distributed by what images need (3DGS-MCMC, with growth by score and halves along the longest axis as in ImprovedGS).
//!
//! Faded Gaussians are removed, and as many others are split, drawn by their screen gradients. The budget grows with the root of the progress. The two halves
//! of a split together draw nearly what the whole drew, so that a round costs little.
//!
//! With `decay`, opacities fall wherever a view shows a Gaussian. Those that images need recover; the others fade and are removed.
//!
//! In the main stage every round also moves some of those that are hardly seen: hidden, faint or covered by others, they cost as much as any other.

mod round;
mod weights;

use super::statistics::Statistics;
use burn::tensor::activation::sigmoid;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_backends::ops::view_sums::fade;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    DensityControl, DensityPlan, DensityPlugin, Error, Gaussians, Plugin, Result, Schedule, Seed, Stage, Statistic, ViewStatistics, config, inventory,
};
use rand::Rng;
use round::round;
use serde::Deserialize;
use weights::Weights;

const SCHEMA: &str = "\
from = 500               # first round, in reference iterations of the stage (coarse 5,000, main 20,000)
until = 15000            # last round, in reference iterations of the main stage; the coarse stage has rounds to nine tenths
every = 100              # reference iterations between two rounds
min_opacity = 0.005      # fainter Gaussians are removed, and the budget is spent on others
growth = 0.1             # most Gaussians split in a round, as a share of all
coarse_share = 0.6       # share of max_gaussians that the coarse stage grows to
max_gaussians = 400000   # the budget at the end
relocate = 0.8           # Gaussians that the rounds of the main stage move, those with the smallest blending weights, as a share of all; 0 is off
noise = 0.0              # random steps of faint Gaussians, as a share of their size per iteration; 0 is off
decay = 0.0              # share by which an iteration lowers opacities of what its views show, while there are rounds (after Binocular3DGS); 0 is off
";

/// Least number of iterations between two rounds.
const MIN_INTERVAL: usize = 25;
/// Share of the coarse stage that has rounds.
const COARSE_ROUNDS: f64 = 0.9;
/// Opacity around which noise fades, and how steeply (3DGS-MCMC).
const NOISE_OPACITY: f32 = 0.005;
const NOISE_STEEPNESS: f32 = 100.0;
/// Largest share of the Gaussians that one round moves.
const MOST_MOVED: f64 = 0.05;

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
    relocate: f64,
    noise: f32,
    decay: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            from: 500,
            until: 15_000,
            every: 100,
            min_opacity: 0.005,
            growth: 0.1,
            coarse_share: 0.6,
            max_gaussians: 400_000,
            relocate: 0.8,
            noise: 0.0,
            decay: 0.0,
        }
    }
}

impl Settings {
    /// The share of the stage at which rounds end.
    fn end_share(&self, schedule: &Schedule) -> f64 {
        match schedule.stage {
            Stage::Coarse => COARSE_ROUNDS,
            stage => self.until as f64 / stage.reference_length() as f64,
        }
    }
    /// The iteration of the stage at which rounds end.
    fn end(&self, schedule: &Schedule) -> usize {
        schedule.iteration_at(self.end_share(schedule)).round() as usize
    }
    fn due(&self, schedule: &Schedule) -> bool {
        let iteration = schedule.iteration;
        iteration > schedule.at(self.from) && iteration <= self.end(schedule) && iteration.is_multiple_of(self.interval(schedule))
    }
    fn interval(&self, schedule: &Schedule) -> usize {
        schedule.interval(self.every, MIN_INTERVAL)
    }
    /// The share of the Gaussians that a round moves: equal ones add up to `relocate`.
    fn moved(&self, schedule: &Schedule) -> f64 {
        if schedule.stage != Stage::Main {
            return 0.0;
        }
        let iterations = self.end(schedule).saturating_sub(schedule.at(self.from));
        (self.relocate * self.interval(schedule) as f64 / iterations.max(1) as f64).min(MOST_MOVED)
    }
    /// How many Gaussians there may be now, where the stage began with `start`.
    fn budget(&self, start: usize, schedule: &Schedule) -> usize {
        let share = if schedule.stage == Stage::Coarse { self.coarse_share } else { 1.0 };
        let most = share * self.max_gaussians as f64;
        let done = (schedule.progress() / self.end_share(schedule).max(f64::MIN_POSITIVE)).min(1.0);
        (start as f64 + (most - start as f64).max(0.0) * done.sqrt()) as usize
    }
}

struct Mcmc {
    settings: Settings,
    statistics: Statistics,
    weights: Weights,
    /// Gaussians at the start of the stage.
    start: usize,
    /// Whether the last plan was a round.
    round: bool,
    /// The largest radius of each Gaussian in the views of this iteration, 0 where none shows it `[N]`.
    shown: Option<Tensor<1, Int>>,
}

impl DensityControl for Mcmc {
    fn begin_stage(&mut self, count: usize, device: &Device) {
        (self.statistics, self.weights) = (Statistics::zeros(count, device), Weights::zeros(count, device));
        (self.start, self.shown, self.round) = (count, None, false);
    }
    fn statistics(&self, schedule: &Schedule) -> Vec<Statistic> {
        let mut wanted = Vec::new();
        if schedule.iteration <= self.settings.end(schedule) {
            wanted.push(Statistic::AbsoluteScreenGradient);
            wanted.extend((self.settings.moved(schedule) > 0.0).then_some(Statistic::MaxWeight));
        }
        wanted
    }
    fn observe(&mut self, view: &ViewStatistics) -> Result<()> {
        self.statistics.add_gradients(view)?;
        self.weights.add(view)?;
        if self.settings.decay > 0.0 {
            // A Gaussian counts as shown if one of the views shows it.
            self.shown = Some(match self.shown.take() {
                Some(before) => before.max_pair(view.radii.clone()),
                None => view.radii.clone(),
            });
        }
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Option<DensityPlan>> {
        self.round = self.settings.due(schedule);
        if !self.round {
            return Ok(None);
        }
        let scores = self.statistics.mean_gradients()?;
        let most = (self.settings.moved(schedule) * gaussians.len() as f64) as usize;
        let hidden = if most > 0 { self.weights.smallest(most)? } else { Vec::new() };
        Ok(Some(round(&self.settings, &gaussians.to_host()?, &scores, &hidden, self.settings.budget(self.start, schedule), seed)))
    }
    fn executed(&mut self, plan: &DensityPlan, device: &Device) -> Result<()> {
        let (before, own) = (self.statistics.len(), std::mem::take(&mut self.round));
        // Gaussians that the trainer adds, such as points of key frames, do not count as growth of this control.
        if !own {
            self.start += plan.len().saturating_sub(before);
        }
        // Statistics start anew after a round, and after a plan of the trainer that changes the rows.
        if own || !plan.keeps_all(before) {
            self.statistics = Statistics::zeros(plan.len(), device);
            self.weights = self.weights.after(plan, own, device)?;
        }
        Ok(())
    }
    fn after_step(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        let mut changed = Vec::new();
        if let Some(shown) = self.shown.take().filter(|_| schedule.iteration <= self.settings.end(schedule)) {
            let faded = fade(gaussians.opacity_logits.clone(), shown, self.settings.decay)?;
            changed.push(("opacity_logits".into(), faded.reshape([-1, 1])));
        }
        if self.settings.noise == 0.0 {
            return Ok(changed);
        }
        let (n, mut random) = (gaussians.len(), seed.rng());
        // The sum of twelve uniform numbers, minus six, is nearly standard normal.
        let normal: Vec<f32> = (0..3 * n).map(|_| (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0).collect();
        let normal = Tensor::<2>::from_data(TensorData::new(normal, [n, 3]), &gaussians.means.device());
        let above = sigmoid(gaussians.opacity_logits.clone()).sub_scalar(NOISE_OPACITY);
        let faint = sigmoid(above.mul_scalar(-NOISE_STEEPNESS)).reshape([n, 1]);
        let size = gaussians.log_scales.clone().mean_dim(1).exp();
        let share = self.settings.noise * (1.0 - schedule.progress() as f32);
        changed.push(("means".into(), gaussians.means.clone() + normal * faint * size * share));
        Ok(changed)
    }
    fn state(&self) -> Vec<(String, Tensor<1>)> {
        let mut arrays = self.statistics.arrays();
        let device = arrays[0].1.device();
        // Up to 16,777,216 a float32 is exact; beyond, the budget of a resumed run differs by a row or two.
        arrays.push(("start".into(), Tensor::from_floats([self.start as f32], &device)));
        let rounds = Tensor::from_floats(self.weights.rounds.as_slice(), &device);
        arrays.extend([("weights".into(), self.weights.sums.clone().flatten(0, 1)), ("rounds".into(), rounds)]);
        arrays
    }
    fn restore(&mut self, mut state: Vec<(String, Tensor<1>)>, count: usize) -> Result<()> {
        let stored = state.iter().any(|(name, _)| name == "rounds");
        let mut take = |name: &str, size: usize| {
            let damaged = |problem: &str| {
                let remedy = "The checkpoint is damaged or of another density control";
                Error::data(format!("density state '{name}'"), problem, remedy)
            };
            let at = state.iter().position(|(n, _)| n == name).ok_or_else(|| damaged("it is missing"))?;
            let values = state.swap_remove(at).1;
            if values.dims() == [size] { Ok(values) } else { Err(damaged("it has another number of values")) }
        };
        let start = to_vec(take("start", 1)?, "start")?[0];
        if !(0.0..1e9).contains(&start) {
            return Err(Error::data("density state 'start'", format!("{start} is not a count"), "The checkpoint is damaged"));
        }
        (self.start, self.shown) = (start as usize, None);
        // Programs before relocation stored no weights.
        let weights = if stored {
            let (sums, rounds) = (take("weights", 3 * count)?.reshape([count, 3]), to_vec(take("rounds", count)?, "rounds")?);
            Some(Weights { sums, rounds })
        } else {
            None
        };
        self.statistics = Statistics::from_arrays(state, count)?;
        self.weights = weights.unwrap_or_else(|| Weights::zeros(count, &self.statistics.gradients.device()));
        Ok(())
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let settings: Settings = config::parse_section("density mcmc", section)?;
    if settings.every == 0 {
        return Err(Error::parameter("density mcmc: every", "0 iterations", "Give at least 1, or use density.kind = \"none\""));
    }
    for (key, value, most, usual) in [
        ("min_opacity", f64::from(settings.min_opacity), 0.999, "0.005 is usual"),
        ("growth", settings.growth, 1.0, "0.05 to 0.2 are usual"),
        ("relocate", settings.relocate, 100.0, "0 is off, 0.8 is usual"),
        ("coarse_share", settings.coarse_share, 1.0, "0.6 is usual"),
        ("noise", f64::from(settings.noise), 100.0, "0 is off and usual"),
        ("decay", f64::from(settings.decay), 0.5, "0 is off, 0.01 is usual"),
    ] {
        if !(0.0..=most).contains(&value) {
            let (object, problem) = (format!("density mcmc: {key}"), format!("{value} is not in 0..{most}"));
            return Err(Error::parameter(object, problem, format!("Give a number in that range; {usual}")));
        }
    }
    let (statistics, weights) = (Statistics::zeros(0, &Device::flex()), Weights::zeros(0, &Device::flex()));
    Ok(Box::new(Mcmc { settings, statistics, weights, start: 0, round: false, shown: None }))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "mcmc",
            version: "1",
            summary: "a budget of Gaussians: faded ones are removed, and as many are split where screen gradients are large",
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
    use crate::density::seen;
    use cc4dgs_core::HostGaussians;

    #[test]
    fn what_others_add_is_no_growth() {
        let device = Device::flex();
        let mut control = build(&toml::Table::new()).unwrap();
        control.begin_stage(2, &device);
        let mut plan = DensityPlan::unchanged(2);
        (0..3).for_each(|_| {
            plan.copy(0);
        });
        control.executed(&plan, &device).unwrap();
        let start = control.state().into_iter().find(|(name, _)| name == "start").unwrap().1;
        assert_eq!(start.into_scalar::<f32>(), 5.0);
    }

    #[test]
    fn settings_out_of_range_are_named_with_what_is_usual() {
        for (section, key) in [("decay = 0.6", "decay"), ("growth = nan", "growth")] {
            let error = build(&toml::from_str(section).unwrap()).err().unwrap().to_string();
            assert!(error.contains(&format!("mcmc: {key}")) && error.contains("usual"), "{error}");
        }
    }

    #[test]
    fn only_rounds_of_its_own_age_the_blending_weights() {
        let device = Device::flex();
        let mut control = build(&toml::from_str("every = 1\nmax_gaussians = 3").unwrap()).unwrap();
        control.begin_stage(2, &device);
        let rounds = |control: &dyn DensityControl| {
            let found = control.state().into_iter().find(|(name, _)| name == "rounds").unwrap().1;
            to_vec(found, "rounds").unwrap()
        };
        // As the trainer adds points of key frames, then removes rows that are not finite.
        let mut added = DensityPlan::unchanged(2);
        added.copy(0);
        control.executed(&added, &device).unwrap();
        let mut removed = DensityPlan::new();
        removed.keep(1);
        removed.keep(2);
        control.executed(&removed, &device).unwrap();
        assert_eq!(rounds(control.as_ref()), [0.0, 0.0]);
        let host = HostGaussians {
            means: vec![0.0; 6],
            log_scales: vec![-3.0; 6],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(2),
            opacity_logits: vec![0.0; 2],
            sh_dc: vec![0.0; 6],
            dynamic_scores: vec![0.0; 2],
            ..Default::default()
        };
        let schedule = Schedule { iteration: 1000, ..Schedule::main(20_000) };
        let plan = control.plan(&Gaussians::from_host(&host, &device), &schedule, Seed::root(1)).unwrap().unwrap();
        control.executed(&plan, &device).unwrap();
        assert_eq!(rounds(control.as_ref()), [1.0, 1.0]);
    }

    #[test]
    fn blending_weights_are_summed_and_the_largest_are_not_kept() {
        let device = Device::flex();
        let mut control = build(&toml::Table::new()).unwrap();
        control.begin_stage(2, &device);
        let mut view = seen(&[3, 3], &device);
        view.max_weights = Some(Tensor::from_floats([0.5, 0.1], &device));
        control.observe(&view).unwrap();
        let sum = |name: &str| control.state().into_iter().find(|(n, _)| n == name).unwrap().1.sum().into_scalar::<f32>();
        assert!(sum("weights") > 0.0);
        assert_eq!(sum("max_weight"), 0.0);
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
