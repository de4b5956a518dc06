//! Clone and split by screen gradient, prune by opacity, size and blending weight (3DGS; windows and weight pruning of Swift4D).

mod rules;

use super::statistics::Statistics;
use burn::tensor::{Device, Tensor};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    DensityControl, DensityPlan, DensityPlugin, Error, Gaussians, Plugin, Result, Schedule, Seed, Stage, Statistic, ViewStatistics, config, inventory,
};
use rules::{Due, round};
use serde::Deserialize;

const SCHEMA: &str = "\
from = 500               # first round, in reference iterations of the stage (coarse 5,000, main 20,000)
coarse_from = 0          # that of the coarse stage; 0: the same number
until = 10000            # last round, in reference iterations of the main stage; the coarse stage ends at 5,000
every = 100              # reference iterations between two rounds
gradient = 2e-4          # mean screen gradient, in normalised device units, from which a Gaussian is cloned or split
absolute = false         # sums of absolute values over pixels as gradients (AbsGS), where those of opposite signs do not cancel; for larger values of `gradient`
corrected = false        # a clone and its original together draw what the original drew, instead of both having its opacity
dense_share = 0.01       # largest size that is cloned instead of split, as a share of the extent of the cameras in the normalised frame
min_opacity = 0.005      # fainter Gaussians are removed
max_scale_share = 0.0    # larger Gaussians are removed, as a share of the extent; 0 is off
max_scale_from = 0       # first reference iteration of the main stage at which they are; 0: in all of it and in the coarse stage
prune_from = 0           # the same for faint Gaussians, and for large ones
prune_above = 0          # faint and large Gaussians are removed only where there are more Gaussians than this
min_weight = 0.02        # a weight pruning removes Gaussians whose largest blending weight is below this
weight_every = 3000      # reference iterations between two weight prunings; 0 is off
weight_main_every = 0    # those of the main stage; 0: the same number
reset_every = 3000       # reference iterations between two opacity resets of the coarse stage, to 0.01 or twice min_opacity; 0 is off
reset_main_every = 0     # the same in the main stage, until the last round, in reference iterations of that stage; 0 is off
reset_main_first = 0     # the first of these, in the same iterations; 0: after the interval
max_gaussians = 400000   # at this count or more, no Gaussians are added
";

/// Opacity that a reset leaves at most; twice the opacity below which Gaussians are removed, if that is more.
const RESET_OPACITY: f32 = 0.01;
/// Largest opacity that a reset leaves, however large `min_opacity` is.
const MOST_RESET_OPACITY: f32 = 0.99;
/// Least number of iterations left in the stage after an opacity reset; later resets are skipped.
const MIN_RECOVERY: usize = 500;
/// Least number of iterations between two weight prunings, so that all views contribute blending weights.
const MIN_WEIGHT_INTERVAL: usize = 100;
/// Passes over the cameras between two weight prunings: every camera has seen the Gaussians, and the Gaussians have been fitted to every camera.
const WEIGHT_PASSES: usize = 2;
/// Least number of iterations between two rounds.
const MIN_INTERVAL: usize = 25;

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Settings {
    from: usize,
    coarse_from: usize,
    until: usize,
    every: usize,
    gradient: f32,
    absolute: bool,
    corrected: bool,
    dense_share: f32,
    min_opacity: f32,
    max_scale_share: f32,
    max_scale_from: usize,
    prune_from: usize,
    prune_above: usize,
    min_weight: f32,
    weight_every: usize,
    weight_main_every: usize,
    reset_every: usize,
    reset_main_every: usize,
    reset_main_first: usize,
    max_gaussians: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            from: 500,
            coarse_from: 0,
            until: 10_000,
            every: 100,
            gradient: 2e-4,
            absolute: false,
            corrected: false,
            dense_share: 0.01,
            min_opacity: 0.005,
            max_scale_share: 0.0,
            max_scale_from: 0,
            prune_from: 0,
            prune_above: 0,
            min_weight: 0.02,
            weight_every: 3000,
            weight_main_every: 0,
            reset_every: 3000,
            reset_main_every: 0,
            reset_main_first: 0,
            max_gaussians: 400_000,
        }
    }
}

impl Settings {
    /// The iteration of the stage at which rounds end.
    fn end(&self, schedule: &Schedule) -> usize {
        schedule.at(if schedule.stage == Stage::Coarse { self.until.min(Stage::Coarse.reference_length()) } else { self.until })
    }
    /// The largest opacity logit that a reset leaves: above that of Gaussians that are removed, so that a round does not take all of them.
    fn reset_logit(&self) -> f32 {
        let kept = 2.0 * self.min_opacity;
        if kept > RESET_OPACITY { logit(kept.min(MOST_RESET_OPACITY)) } else { logit(RESET_OPACITY) }
    }
    /// Iterations between two weight prunings; `None` where there are none.
    fn weight_interval(&self, schedule: &Schedule) -> Option<usize> {
        let own = schedule.stage == Stage::Main && self.weight_main_every > 0;
        let every = if own { self.weight_main_every } else { self.weight_every };
        (every > 0).then(|| schedule.at(every).max(MIN_WEIGHT_INTERVAL).max(WEIGHT_PASSES * schedule.pass))
    }
    /// Whether a rule of removal that begins at the reference iteration `from` of the main stage holds.
    fn removes(schedule: &Schedule, from: usize) -> bool {
        from == 0 || (schedule.stage == Stage::Main && schedule.iteration >= schedule.at(from))
    }
    /// The actions due after this iteration.
    fn due(&self, schedule: &Schedule) -> Due {
        let (iteration, end) = (schedule.iteration, self.end(schedule));
        let (every, first, until) = match schedule.stage {
            Stage::Coarse => (self.reset_every, 0, usize::MAX),
            _ => (self.reset_main_every, self.reset_main_first, end),
        };
        let first = schedule.at(if first == 0 { every } else { first });
        let from = if schedule.stage == Stage::Coarse && self.coarse_from > 0 { self.coarse_from } else { self.from };
        let resets = every > 0 && (first..until).contains(&iteration) && (iteration - first).is_multiple_of(schedule.at(every).max(1));
        Due {
            grow: iteration > schedule.at(from) && iteration < end && iteration.is_multiple_of(schedule.interval(self.every, MIN_INTERVAL)),
            prune_weight: iteration < end && self.weight_interval(schedule).is_some_and(|interval| iteration.is_multiple_of(interval)),
            reset: resets && schedule.left() >= MIN_RECOVERY,
            prune_faint: Self::removes(schedule, self.prune_from),
            prune_large: self.max_scale_share > 0.0 && Self::removes(schedule, self.prune_from.max(self.max_scale_from)),
            held: 0,
        }
    }
}

struct CloneSplit {
    settings: Settings,
    statistics: Statistics,
    /// The actions of the last plan.
    due: Due,
    /// How many of `max_gaussians` the next plan must leave unused.
    held: usize,
}

impl DensityControl for CloneSplit {
    fn begin_stage(&mut self, count: usize, device: &Device) {
        self.statistics = Statistics::zeros(count, device);
    }
    fn statistics(&self, schedule: &Schedule) -> Vec<Statistic> {
        let end = self.settings.end(schedule);
        let mut wanted = Vec::new();
        if schedule.iteration < end {
            wanted.push(if self.settings.absolute { Statistic::AbsoluteScreenGradient } else { Statistic::ScreenGradient });
        }
        // Blending weights are collected until the last weight pruning.
        if self.settings.weight_interval(schedule).is_some_and(|interval| schedule.iteration.div_ceil(interval) * interval < end) {
            wanted.push(Statistic::MaxWeight);
        }
        wanted
    }
    fn observe(&mut self, view: &ViewStatistics) -> Result<()> {
        self.statistics.add_gradients(view)?;
        self.statistics.add_weights(view);
        Ok(())
    }
    fn hold(&mut self, count: usize) {
        self.held = count;
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Option<DensityPlan>> {
        let due = Due { held: self.held, ..self.settings.due(schedule) };
        self.due = due;
        let (mut plan, mut logits, most) = (None, None, self.settings.reset_logit());
        if due.grow || due.prune_weight {
            let mut host = gaussians.to_host()?;
            if due.reset {
                host.opacity_logits.iter_mut().for_each(|v| *v = v.min(most));
            }
            plan = round(&self.settings, &self.statistics, &host, due, schedule.extent, seed)?;
            logits = Some(host.opacity_logits);
        }
        if due.reset {
            let logits = match logits {
                Some(logits) => logits,
                None => to_vec(gaussians.opacity_logits.clone(), "opacity_logits")?,
            };
            let plan = plan.get_or_insert_with(|| DensityPlan::unchanged(logits.len()));
            for row in 0..plan.len() {
                let parent = plan.parents()[row];
                plan.set(row, "opacity_logits", &[logits[parent].min(most)]);
            }
            plan.restart("opacity_logits");
        }
        Ok(plan)
    }
    fn executed(&mut self, plan: &DensityPlan, device: &Device) -> Result<()> {
        // The plan may be one of the trainer, which changes the rows, too.
        if self.due.grow || self.due.prune_weight || !plan.keeps_all(self.statistics.len()) {
            self.statistics = self.statistics.after(plan, self.due.prune_weight, device)?;
        }
        Ok(())
    }
    fn state(&self) -> Vec<(String, Tensor<1>)> {
        self.statistics.arrays()
    }
    fn restore(&mut self, state: Vec<(String, Tensor<1>)>, count: usize) -> Result<()> {
        self.statistics = Statistics::from_arrays(state, count)?;
        Ok(())
    }
}

fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

fn build(section: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let settings: Settings = config::parse_section("density clone-split", section)?;
    for (key, value, usual) in [
        ("gradient", settings.gradient, "1e-4 to 1e-3 are usual"),
        ("dense_share", settings.dense_share, "0.01 is usual"),
        ("min_opacity", settings.min_opacity, "0.005 to 0.05 are usual"),
        ("max_scale_share", settings.max_scale_share, "0 is off, 0.1 is usual"),
        ("min_weight", settings.min_weight, "0.01 to 0.05 are usual"),
    ] {
        if !(value >= 0.0 && value.is_finite()) {
            let remedy = format!("Give a finite number of 0 or more; {usual}");
            return Err(Error::parameter(format!("density clone-split: {key}"), format!("{value} is no threshold"), remedy));
        }
    }
    if settings.every == 0 {
        return Err(Error::parameter("density clone-split: every", "0 iterations", "Give at least 1, or use density.kind = \"none\""));
    }
    Ok(Box::new(CloneSplit { settings, statistics: Statistics::zeros(0, &Device::flex()), due: Due::default(), held: 0 }))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "clone-split",
            version: "1",
            summary: "clone and split by screen gradient, prune by opacity, size and blending weight",
            paper: "Kerbl et al. 2023 (3DGS); Swift4D (Wu et al. 2025); absolute gradients of AbsGS (Ye et al. 2024)",
            schema: SCHEMA,
            capabilities: &[],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::HostGaussians;

    #[test]
    fn thresholds_out_of_range_are_named() {
        for (section, key) in [("gradient = -1.0", "gradient"), ("min_weight = inf", "min_weight")] {
            let error = build(&toml::from_str(section).unwrap()).err().unwrap().to_string();
            assert!(error.contains(&format!("clone-split: {key}")) && error.contains("usual"), "{error}");
        }
    }

    #[test]
    fn each_stage_has_resets_of_its_own() {
        let resets = |text: &str, stage: Stage, length: usize| {
            let settings: Settings = toml::from_str(text).unwrap();
            let at = |iteration: usize| Schedule { stage, iteration, total: 40_000, ..Schedule::main(length) };
            (1..=length).filter(|&iteration| settings.due(&at(iteration)).reset).collect::<Vec<_>>()
        };
        assert_eq!(resets("", Stage::Coarse, 5000), [3000]);
        assert!(resets("", Stage::Main, 20_000).is_empty());
        let both = "reset_every = 1000\nreset_main_every = 2000\nuntil = 10000";
        assert_eq!(resets(both, Stage::Coarse, 5000), [1000, 2000, 3000, 4000]);
        assert_eq!(resets(both, Stage::Main, 30_000), [3000, 6000, 9000, 12_000]);
        assert_eq!(resets(&format!("{both}\nreset_main_first = 500"), Stage::Main, 30_000), [750, 3750, 6750, 9750, 12_750]);
        assert!(resets("reset_every = 0\nreset_main_every = 0", Stage::Coarse, 5000).is_empty());
    }

    #[test]
    fn gaussians_are_removed_from_the_iteration_on_that_is_set() {
        // Faint and large ones.
        let due = |text: &str, stage: Stage, iteration: usize| {
            let settings: Settings = toml::from_str(text).unwrap();
            let due = settings.due(&Schedule { stage, iteration, total: 40_000, ..Schedule::main(30_000) });
            (due.prune_faint, due.prune_large)
        };
        assert_eq!(due("", Stage::Main, 5000), (true, false));
        assert!(due("max_scale_share = 0.1", Stage::Coarse, 600).1 && due("max_scale_share = 0.1", Stage::Main, 600).1);
        let later = "max_scale_share = 0.1\nmax_scale_from = 2000";
        assert_eq!(
            [(Stage::Coarse, 5000), (Stage::Main, 2999), (Stage::Main, 3000)].map(|(stage, at)| due(later, stage, at)),
            [(true, false), (true, false), (true, true)]
        );
        let both = "max_scale_share = 0.1\nprune_from = 2000";
        assert_eq!(
            [(Stage::Coarse, 5000), (Stage::Main, 2999), (Stage::Main, 3000)].map(|(stage, at)| due(both, stage, at)),
            [(false, false), (false, false), (true, true)]
        );
    }

    #[test]
    fn the_coarse_stage_has_a_first_round_and_the_main_stage_an_interval_of_weight_prunings_of_its_own() {
        let text = "from = 0\ncoarse_from = 833\nweight_every = 3000\nweight_main_every = 4615\nuntil = 15385";
        let at = |stage: Stage, length: usize| {
            let settings: Settings = toml::from_str(text).unwrap();
            let due = |iteration: usize| settings.due(&Schedule { stage, iteration, total: 28_000, ..Schedule::main(length) });
            let first = (1..=length).find(|&iteration| due(iteration).grow);
            (first, (1..=length).filter(|&iteration| due(iteration).prune_weight).collect::<Vec<_>>())
        };
        assert_eq!(at(Stage::Coarse, 3000), (Some(600), vec![1800]));
        assert_eq!(at(Stage::Main, 13_000), (Some(100), vec![3000, 6000, 9000]));
    }

    #[test]
    fn a_reset_leaves_more_opacity_than_what_is_removed_has() {
        let device = Device::flex();
        let host = HostGaussians {
            means: vec![0.0; 6],
            log_scales: vec![-3.0; 6],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(2),
            opacity_logits: vec![2.0, 0.0],
            sh_dc: vec![0.0; 6],
            dynamic_scores: vec![0.0; 2],
            ..Default::default()
        };
        // A round is due after the same iteration.
        let schedule = Schedule { stage: Stage::Coarse, iteration: 3000, total: 28_000, ..Schedule::main(5000) };
        for (min_opacity, left) in [(0.0f32, 0.01), (0.005, 0.01), (0.05, 0.1), (0.4, 0.8), (0.45, 0.9)] {
            let mut control = build(&toml::from_str(&format!("weight_every = 0\nmin_opacity = {min_opacity:?}")).unwrap()).unwrap();
            control.begin_stage(2, &device);
            let gaussians = Gaussians::from_host(&host, &device);
            let plan = control.plan(&gaussians, &schedule, Seed::root(1)).unwrap().unwrap();
            assert!(plan.keeps_all(2) && plan.report.removed == 0, "min_opacity {min_opacity}: {:?}", plan.report);
            let logits = plan.apply(&gaussians).unwrap().to_host().unwrap().opacity_logits;
            for (after, before) in logits.iter().zip(&host.opacity_logits) {
                let [after, before] = [after, before].map(|logit| 1.0 / (1.0 + (-logit).exp()));
                assert!((after - before.min(left)).abs() < 1e-4, "min_opacity {min_opacity}: {before} becomes {after}");
            }
        }
    }
}
