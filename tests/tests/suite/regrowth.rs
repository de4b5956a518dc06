//! That growth and pruning do not undo each other: controls that are at their bound, driven by statistics over short and long schedules.

use super::guard::{gaussians, statistics, uniform};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityControl, Gaussians, Registry, Result, Schedule, Seed, Stage, Statistic, ViewStatistics};

/// Gaussians at the start; controls may have no more.
const BOUND: usize = 600;
/// Iterations between two views of the statistics.
const VIEW_EVERY: usize = 10;
/// Share of the Gaussians that each plan leaves covered by others: no view shows them any more.
const COVERED: f32 = 0.01;
/// Colour coefficient that marks them; those of the others are in -1..1.
const COVERED_COLOR: f32 = 2.0;
/// Iterations after which a Gaussian that growth added may be removed at the earliest.
const LEAST_AGE: usize = 100;
/// Most Gaussians that `mcmc` moves in a stage, as a share of all: the default of its `relocate`.
const RELOCATED: f64 = 0.8;

/// What a control did in both stages.
#[derive(Debug, Default)]
struct Counts {
    /// Gaussians removed.
    removed: usize,
    /// Of these, younger than [`LEAST_AGE`].
    young: usize,
    /// Of these, replaced by the plan that removed them.
    moved: usize,
    /// By how much plans made the Gaussians fewer.
    fell: usize,
    /// By how much plans made them more.
    rose: usize,
    /// By how much they made them more than the bound less what was held back.
    early: usize,
}

/// Statistics of a view that draws all Gaussians but those that are covered, and asks for more of every third.
fn view(set: &Gaussians, wanted: &[Statistic], seed: Seed, device: &Device) -> Result<ViewStatistics> {
    let (count, colors) = (set.len(), to_vec(set.sh_dc.clone(), "sh_dc")?);
    let covered = |row: usize| colors[3 * row] >= COVERED_COLOR;
    let weights: Vec<f32> = (0..count).map(|row| if covered(row) { 0.0 } else { 0.5 + 0.5 * uniform(seed, row) }).collect();
    let size = |row: usize| if row.is_multiple_of(3) && !covered(row) { 2e-5 } else { 1e-8 };
    let gradients: Vec<f32> = (0..2 * count).map(|k| size(k / 2) * uniform(seed, count + k)).collect();
    let gradient = |statistic| wanted.contains(&statistic).then(|| Tensor::<2>::from_data(TensorData::new(gradients.clone(), [count, 2]), device));
    Ok(statistics(vec![5; count], gradient, wanted.contains(&Statistic::MaxWeight).then_some(weights), device))
}

/// Drives a control through coarse and main stage. Training views recover from a removal in a fiftieth of the run, at least 60 and at most 400 iterations.
/// Until then, growth may not replace what it removed.
fn drive(control: &mut dyn DensityControl, iterations: usize, device: &Device) -> Result<Counts> {
    let recovery = (iterations / 50).clamp(60, 400);
    let (mut set, mut born, mut counts) = (gaussians(BOUND, device), vec![0; BOUND], Counts::default());
    let mut now: usize = 0;
    for (stage, length) in [(Stage::Coarse, iterations * 5 / 28), (Stage::Main, iterations * 20 / 28)] {
        control.begin_stage(set.len(), device);
        let (mut held, mut recovered) = (0, 0);
        for iteration in 1..=length {
            now += 1;
            let schedule = Schedule { stage, iteration, total: iterations, pass: 20, ..Schedule::main(length) };
            let seed = Seed::root(5).child(stage.name()).index(iteration as u64);
            if iteration.is_multiple_of(VIEW_EVERY) {
                let wanted = control.statistics(&schedule);
                control.observe(&view(&set, &wanted, seed.child("view"), device)?)?;
            }
            if now >= recovered {
                held = 0;
            }
            control.hold(held);
            let Some(plan) = control.plan(&set, &schedule, seed.child("plan"))? else { continue };
            plan.check("driven", &set)?;
            let removed = plan.removed(set.len());
            counts.removed += removed.len();
            counts.young += removed.iter().filter(|&&row| now - born[row] < LEAST_AGE).count();
            counts.moved += plan.report.moved;
            counts.rose += plan.len().saturating_sub(set.len());
            counts.early += (plan.len() + held).saturating_sub(BOUND);
            let fell = set.len().saturating_sub(plan.len());
            if fell > 0 {
                counts.fell += fell;
                held += fell;
                recovered = now + recovery;
            }
            born = plan.parents().iter().zip(plan.fresh()).map(|(&parent, &fresh)| if fresh { now } else { born[parent] }).collect();
            set = plan.apply(&set)?;
            control.executed(&plan, device)?;
            // Training gives halves their opacity back, and covers some Gaussians, whatever their age.
            let mut host = set.to_host()?;
            host.opacity_logits.fill(0.0);
            (0..host.len()).filter(|&row| uniform(seed, row) < COVERED).for_each(|row| host.sh_dc[3 * row] = COVERED_COLOR);
            set = Gaussians::from_host(&host, device);
        }
    }
    Ok(counts)
}

#[test]
fn growth_and_pruning_do_not_undo_each_other() {
    let (registry, device) = (Registry::collect().unwrap(), Device::flex());
    for kind in ["clone-split", "mcmc"] {
        for iterations in [300, 30_000] {
            let mut section = toml::Table::new();
            section.insert("kind".into(), kind.into());
            section.insert("until".into(), toml::Value::Integer(20_000));
            section.insert("max_gaussians".into(), toml::Value::Integer(BOUND as i64));
            let mut control = registry.build_density(&section).unwrap();
            let counts = drive(control.as_mut(), iterations, &device).unwrap();
            let about = format!("{kind}, {iterations} iterations: {counts:?}");
            println!("{about}");
            let Counts { removed, young, moved, fell, rose, early } = counts;
            assert!(removed > 0, "{about}");
            assert_eq!((young, early), (0, 0), "removed what growth had just added, or refilled what is not back: {about}");
            if kind == "mcmc" {
                assert!((fell, rose, moved) == (0, 0, removed), "what it removes it replaces at once: {about}");
                assert!(RELOCATED * BOUND as f64 >= removed as f64, "{about}");
            } else {
                assert!(0 < rose && rose <= fell && fell == removed, "each is replaced at most once: {about}");
            }
        }
    }
}
