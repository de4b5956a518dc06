//! One round: clone, split, prune.

use super::Settings;
use crate::density::halves::rotation;
use crate::density::statistics::Statistics;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DensityPlan, HostGaussians, Result, SPACE_TIME_ATTRIBUTES, Seed};
use rand::Rng;

/// The two halves of a split are smaller by this factor (3DGS: 0.8 times 2).
const SPLIT_SHRINK: f32 = 1.6;
/// Farthest time from that of its parent at which the half of a split is, in sequences. What lasts longer is there at all times, and a path that is written
/// down from far away loses digits.
const FARTHEST: f32 = 10.0;
/// Largest logarithm of a duration whose exponential is used.
const MOST_LOG_DURATION: f32 = 30.0;

/// The actions due after an iteration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Due {
    /// Clone and split.
    pub grow: bool,
    /// Prune by blending weight, and reset that statistic.
    pub prune_weight: bool,
    /// Lower all opacities.
    pub reset: bool,
    /// Remove faint Gaussians.
    pub prune_faint: bool,
    /// Remove large Gaussians.
    pub prune_large: bool,
    /// How many of `max_gaussians` growth must leave unused.
    pub held: usize,
}

/// A Gaussian to add: its parent, and standard normal samples of space and time if it comes from a split.
type Child = (usize, Option<([f32; 3], f32)>);

/// The plan of one round. `None` if every Gaussian would be removed; then all are kept.
pub(super) fn round(settings: &Settings, statistics: &Statistics, host: &HostGaussians, due: Due, extent: f32, seed: Seed) -> Result<Option<DensityPlan>> {
    let n = host.len();
    let gradient = statistics.mean_gradients()?;
    let weight = to_vec(statistics.max_weight.clone(), "blending weights")?;
    let largest = |i: usize| host.log_scales[3 * i..3 * i + 3].iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b)).exp();
    let opacity = |i: usize| 1.0 / (1.0 + (-host.opacity_logits[i]).exp());
    let weak = |i: usize| due.prune_weight && weight[i] < settings.min_weight;
    let prunes = n > settings.prune_above;
    let dead = |i: usize| !host.is_finite(i) || (prunes && due.prune_faint && opacity(i) < settings.min_opacity);
    let too_large = |size: f32| prunes && due.prune_large && size > settings.max_scale_share * extent;

    let correct = |plan: &mut DensityPlan, row: usize, of: usize| {
        // A reset sets all opacities, and the trainer may leave it out.
        if settings.corrected && !due.reset {
            plan.set(row, "opacity_logits", &[shared_logit(opacity(of))]);
        }
    };

    let in_time = SpaceTime::of(host);
    let mut plan = DensityPlan::new();
    let mut children: Vec<Child> = Vec::new();
    let capacity = settings.max_gaussians.saturating_sub(n + due.held);
    let mut wanting: Vec<usize> = (0..n).filter(|&i| due.grow && gradient[i] >= settings.gradient && !dead(i) && !weak(i)).collect();
    // Near the upper bound, those with the largest gradients come first.
    wanting.sort_by(|&a, &b| gradient[b].total_cmp(&gradient[a]).then(a.cmp(&b)));
    let mut grows = vec![false; n];
    wanting.iter().take(capacity).for_each(|&i| grows[i] = true);
    for (i, &grows) in grows.iter().enumerate() {
        if dead(i) || weak(i) {
            plan.report.removed += 1;
            continue;
        }
        // What splits is judged by the size of its halves.
        if too_large(if grows { largest(i) / SPLIT_SHRINK } else { largest(i) }) {
            plan.report.removed += 1;
        } else if !grows {
            plan.keep(i);
        } else if largest(i) <= settings.dense_share * extent {
            let row = plan.keep(i);
            correct(&mut plan, row, i);
            children.push((i, None));
            plan.report.cloned += 1;
        } else {
            let mut rng = seed.index(i as u64).rng();
            for _ in 0..2 {
                let space = std::array::from_fn(|_| standard_normal(&mut rng));
                children.push((i, Some((space, if in_time.is_some() { standard_normal(&mut rng) } else { 0.0 }))));
            }
            plan.report.split += 1;
        }
    }
    if plan.is_empty() && children.is_empty() {
        return Ok(None);
    }
    for &(parent, normal) in &children {
        let row = plan.copy(parent);
        let Some((normal, normal_in_time)) = normal else {
            correct(&mut plan, row, parent);
            continue;
        };
        let (means, log_scales) = (&host.means[3 * parent..3 * parent + 3], &host.log_scales[3 * parent..3 * parent + 3]);
        let sample = glam::Vec3::from_array(std::array::from_fn(|a| normal[a] * log_scales[a].exp()));
        let shrink = SPLIT_SHRINK.ln();
        let mut moved = rotation(&host.quaternions[4 * parent..4 * parent + 4]) * sample;
        if let Some(times) = &in_time {
            moved += times.split(&mut plan, row, parent, normal_in_time, shrink);
        }
        let mean = glam::Vec3::from_slice(means);
        // An enormous Gaussian may have no such point in float32.
        plan.set(row, "means", &if (mean + moved).is_finite() { mean + moved } else { mean }.to_array());
        plan.set(row, "log_scales", &[log_scales[0] - shrink, log_scales[1] - shrink, log_scales[2] - shrink]);
    }
    Ok(Some(plan))
}

/// What places the Gaussians in time, where they carry [`SPACE_TIME_ATTRIBUTES`].
struct SpaceTime<'a> {
    centers: &'a [f32],
    log_durations: &'a [f32],
    velocities: &'a [f32],
}

impl<'a> SpaceTime<'a> {
    fn of(host: &'a HostGaussians) -> Option<Self> {
        let [centers, log_durations, velocities] = SPACE_TIME_ATTRIBUTES.map(|(name, width)| {
            let attribute = host.extra.get(name)?;
            (attribute.width == width && attribute.values.len() == width * host.len()).then_some(&attribute.values[..])
        });
        Some(Self { centers: centers?, log_durations: log_durations?, velocities: velocities? })
    }
    /// Moves the new row `row`, one of the two that replace `parent`, to a random time of its parent, and shortens it. Returns how far its centre lies from
    /// that of its parent then. Together with a random point of the conditional Gaussian this is a random point of the Gaussian over space and time, as in
    /// 4D-GS.
    fn split(&self, plan: &mut DensityPlan, row: usize, parent: usize, normal: f32, shrink: f32) -> glam::Vec3 {
        let [(center, _), (log_duration, _), _] = SPACE_TIME_ATTRIBUTES;
        let since = (normal * self.log_durations[parent].min(MOST_LOG_DURATION).exp()).clamp(-FARTHEST, FARTHEST);
        plan.set(row, center, &[self.centers[parent] + since]);
        plan.set(row, log_duration, &[self.log_durations[parent] - shrink]);
        since * glam::Vec3::from_slice(&self.velocities[3 * parent..3 * parent + 3])
    }
}

/// The logit of the opacity p of each of two equal Gaussians that together have `opacity`: 1 - (1 - p)^2 (Rota Bulo et al. 2024, "Revising densification").
fn shared_logit(opacity: f32) -> f32 {
    let each = (1.0 - (1.0 - opacity).max(0.0).sqrt()).clamp(1e-6, 0.999);
    (each / (1.0 - each)).ln()
}

fn standard_normal(rng: &mut impl Rng) -> f32 {
    // Box-Muller; 1 - u keeps the logarithm finite.
    let (u, v): (f32, f32) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::super::build;
    use super::*;
    use crate::density::seen;
    use burn::tensor::{Device, Tensor};
    use cc4dgs_core::{ExtraAttribute, Gaussians, Schedule, Statistic};

    fn host_of(n: usize) -> HostGaussians {
        HostGaussians {
            means: (0..n).flat_map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_scales: vec![0.0; 3 * n],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(n),
            opacity_logits: vec![0.0; n],
            sh_dc: vec![0.0; 3 * n],
            dynamic_scores: vec![0.0; n],
            extra: [("label".to_string(), ExtraAttribute::exact(1, (0..n).map(|i| i as f32).collect()))].into(),
            ..Default::default()
        }
    }

    #[test]
    fn clone_split_and_prune_carry_every_attribute() {
        let device = Device::flex();
        let mut host = host_of(4);
        // 0: small with a large gradient, cloned; 1: large with a large gradient, split; 2: transparent, removed; 3: kept.
        host.log_scales[0..3].fill(0.001f32.ln());
        host.opacity_logits[2] = -20.0;
        let mut statistics = Statistics::zeros(4, &device);
        statistics.gradients = Tensor::from_floats([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [0.0, 1.0]], &device);
        let due = Due { grow: true, prune_faint: true, ..Default::default() };
        let plan = round(&Settings::default(), &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap();
        assert_eq!((plan.report.cloned, plan.report.split, plan.report.removed), (1, 1, 1));
        assert_eq!(to_vec(statistics.after(&plan, false, &device).unwrap().max_weight, "weights").unwrap(), [0.0, 0.0, 1.0, 1.0, 1.0]);
        let gaussians = Gaussians::from_host(&host, &device);
        plan.check("clone-split", &gaussians).unwrap();
        let after = plan.apply(&gaussians).unwrap().to_host().unwrap();
        assert_eq!(after.extra["label"].values, vec![0.0, 3.0, 0.0, 1.0, 1.0]);
        assert!((after.log_scales[9] + SPLIT_SHRINK.ln()).abs() < 1e-6);
        assert_ne!(after.means[9..12], after.means[12..15], "the two halves are different samples");
    }

    #[test]
    fn large_gaussians_are_removed_after_they_were_split() {
        let device = Device::flex();
        let mut host = host_of(4);
        // 0 is kept, 1 splits into halves that are small enough, 2 does not grow and is too large, and so are the halves of 3.
        host.log_scales = [0.01f32, 0.15, 0.15, 0.3].iter().flat_map(|size| [size.ln(); 3]).collect();
        let mut statistics = Statistics::zeros(4, &device);
        statistics.gradients = Tensor::from_floats([[0.0, 1.0], [1.0, 1.0], [0.0, 1.0], [1.0, 1.0]], &device);
        let planned = |prune_above: usize| {
            let settings = Settings { max_scale_share: 0.1, prune_above, ..Settings::default() };
            let due = Due { grow: true, prune_large: true, ..Default::default() };
            round(&settings, &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap()
        };
        let plan = planned(3);
        assert_eq!((plan.parents(), plan.report.removed, plan.report.split), (&[0, 1, 1][..], 2, 1));
        assert_eq!((planned(4).parents(), planned(4).report.removed), (&[0, 2, 1, 1, 3, 3][..], 0));
    }

    #[test]
    fn gaussians_of_space_and_time_are_split_in_both() {
        let device = Device::flex();
        let mut host = host_of(2);
        // Of size 1e-4, so that halves lie on the path of their parent. The second is small, and is cloned.
        host.log_scales = [[1e-4f32.ln(); 3], [1e-9f32.ln(); 3]].concat();
        let of = |width, row: &[f32]| ExtraAttribute::exact(width, row.repeat(2));
        host.extra.extend(
            [("time_center", of(1, &[0.5])), ("log_duration", of(1, &[0.2f32.ln()])), ("velocity", of(3, &[2.0, 0.0, -1.0]))].map(|(n, v)| (n.into(), v)),
        );
        let mut statistics = Statistics::zeros(2, &device);
        statistics.gradients = Tensor::from_floats([[1.0, 1.0], [1.0, 1.0]], &device);
        let settings = Settings { dense_share: 1e-6, ..Settings::default() };
        let due = Due { grow: true, ..Default::default() };
        let gaussians = Gaussians::from_host(&host, &device);
        let plan = round(&settings, &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap();
        plan.check("clone-split", &gaussians).unwrap();
        let after = plan.apply(&gaussians).unwrap().to_host().unwrap();
        assert_eq!(plan.parents(), [1, 0, 0, 1]);
        let (times, durations) = (&after.extra["time_center"].values, &after.extra["log_duration"].values);
        assert!(times[1] != times[2] && times[1] != 0.5 && times[0] == 0.5 && times[3] == 0.5, "{times:?}");
        for row in [1, 2] {
            let since = times[row] - 0.5;
            let moved = [2.0 * since, 0.0, -since];
            let centre = &after.means[3 * row..3 * row + 3];
            assert!(centre.iter().zip(moved).all(|(a, b)| (a - b).abs() < 1e-3), "{centre:?} is not at {moved:?}");
            assert!((durations[row] - (0.2f32 / SPLIT_SHRINK).ln()).abs() < 1e-6 && since.abs() < 1.0, "{durations:?}");
        }
        assert!(durations[0] == durations[3] && (durations[0] - 0.2f32.ln()).abs() < 1e-6, "a clone keeps its duration");
        // What is there at all times stays near.
        host.extra.insert("log_duration".into(), of(1, &[120.0]));
        let plan = round(&settings, &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap();
        plan.check("clone-split", &gaussians).unwrap();
        let after = plan.apply(&gaussians).unwrap().to_host().unwrap();
        assert!(after.extra["time_center"].values.iter().all(|t| t.abs() <= 10.5) && after.means.iter().all(|x| x.abs() <= 21.0), "{:?}", after.means);
        // Neither enormous paths nor enormous sizes make a plan that is refused.
        host.extra.insert("velocity".into(), of(3, &[f32::MAX, 0.0, 0.0]));
        host.log_scales.fill(200.0);
        round(&settings, &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap().check("clone-split", &gaussians).unwrap();
    }

    #[test]
    fn corrected_clones_draw_what_the_original_drew() {
        let device = Device::flex();
        let mut host = host_of(1);
        host.log_scales.fill(0.001f32.ln());
        host.opacity_logits[0] = 1.5;
        let mut statistics = Statistics::zeros(1, &device);
        statistics.gradients = Tensor::from_floats([[1.0, 1.0]], &device);
        let due = Due { grow: true, ..Default::default() };
        let passed = |corrected: bool| {
            let plan = round(&Settings { corrected, ..Settings::default() }, &statistics, &host, due, 1.0, Seed::root(1)).unwrap().unwrap();
            let after = plan.apply(&Gaussians::from_host(&host, &device)).unwrap().to_host().unwrap();
            assert_eq!(after.len(), 2);
            after.opacity_logits.iter().map(|v| 1.0 - 1.0 / (1.0 + (-v).exp())).product::<f32>()
        };
        let original = 1.0 - 1.0 / (1.0 + (-1.5f32).exp());
        assert!((passed(true) - original).abs() < 1e-5 && (passed(false) - original * original).abs() < 1e-5);
        assert!(shared_logit(1.0).is_finite() && shared_logit(0.0).is_finite());
    }

    #[test]
    fn the_largest_gradients_grow_up_to_the_bound_less_what_is_held() {
        let device = Device::flex();
        let mut statistics = Statistics::zeros(3, &device);
        statistics.gradients = Tensor::from_floats([[1.0, 1.0], [3.0, 1.0], [2.0, 1.0]], &device);
        let settings = Settings { max_gaussians: 5, ..Settings::default() };
        let parents = |held: usize| {
            let due = Due { grow: true, held, ..Default::default() };
            round(&settings, &statistics, &host_of(3), due, 1.0, Seed::root(1)).unwrap().unwrap().parents().to_vec()
        };
        assert_eq!((parents(0), parents(1)), (vec![0, 1, 1, 2, 2], vec![0, 2, 1, 1]));
        assert_eq!((parents(2), parents(9)), (vec![0, 1, 2], vec![0, 1, 2]));
    }

    #[test]
    fn weight_pruning_removes_what_no_view_shows() {
        let device = Device::flex();
        let mut statistics = Statistics::zeros(3, &device);
        statistics.max_weight = Tensor::from_floats([0.5, 0.0, 0.019], &device);
        let due = Due { prune_weight: true, ..Default::default() };
        let plan = round(&Settings::default(), &statistics, &host_of(3), due, 1.0, Seed::root(1)).unwrap().unwrap();
        assert_eq!((plan.report.removed, plan.parents()), (2, &[0][..]));
    }

    #[test]
    fn absolute_gradients_grow_what_opposite_signs_hide() {
        let device = Device::flex();
        let mut host = host_of(2);
        host.log_scales.fill(0.001f32.ln());
        let schedule = Schedule { iteration: 1000, extent: 1.0, ..Schedule::main(20_000) };
        let cloned = |absolute: bool| {
            let mut control = build(&toml::Table::from_iter([("absolute".to_string(), absolute.into()), ("every".to_string(), 1.into())])).unwrap();
            control.begin_stage(2, &device);
            let gradient = |wanted: Statistic, value: f32| {
                control.statistics(&schedule).contains(&wanted).then(|| Tensor::<2>::from_floats([[value, 0.0], [0.0, 0.0]], &device))
            };
            let mut view = seen(&[3, 3], &device);
            view.screen_gradient = gradient(Statistic::ScreenGradient, 0.0);
            view.absolute_screen_gradient = gradient(Statistic::AbsoluteScreenGradient, 1.0);
            control.observe(&view).unwrap();
            control.plan(&Gaussians::from_host(&host, &device), &schedule, Seed::root(1)).unwrap().map_or(0, |plan| plan.report.cloned)
        };
        assert_eq!((cloned(false), cloned(true)), (0, 1));
    }
}
