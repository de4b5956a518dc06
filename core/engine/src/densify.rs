//! Adding and removing Gaussians (Inria's clone and split, Swift4D's weight pruning; baselines §1.7, §2.2).

use crate::columns::{GaussianSet, HostColumn};
use crate::config::DensifyConfig;
use burn::tensor::{Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{Result, Seed};
use rand::Rng;

/// Running statistics between two rounds, on the device.
#[derive(Clone, Debug)]
pub struct ScreenStats {
    /// Sum of screen-gradient norms in normalised device units [N].
    pub gradient_sum: Tensor<1>,
    /// Views that saw the Gaussian [N].
    pub seen: Tensor<1>,
    /// Largest blending weight since the last weight pruning [N].
    pub max_weight: Tensor<1>,
}

impl ScreenStats {
    /// Zeros for the Gaussians of `set`.
    pub fn zeros(set: &GaussianSet) -> Self {
        let zeros = || Tensor::<1>::zeros([set.len()], &set.columns[0].value.device());
        Self { gradient_sum: zeros(), seen: zeros(), max_weight: zeros() }
    }
    /// Adds one view: `probe_gradient` [N,2] in pixels of a `width` x `height` image, of a loss that was divided by `batch`.
    pub fn add_view(&mut self, probe_gradient: Tensor<2>, radii: &Tensor<1, Int>, width: u32, height: u32, batch: usize) {
        let n = probe_gradient.dims()[0];
        let scale = batch as f32 * 0.5;
        let x = probe_gradient.clone().narrow(1, 0, 1).reshape([n]).mul_scalar(scale * width as f32);
        let y = probe_gradient.narrow(1, 1, 1).reshape([n]).mul_scalar(scale * height as f32);
        let norm = (x.clone() * x + y.clone() * y).sqrt();
        let visible = radii.clone().greater_elem(0).float();
        self.gradient_sum = self.gradient_sum.clone() + norm * visible.clone();
        self.seen = self.seen.clone() + visible;
    }
    /// Takes the larger of the running and the given blending weights [N].
    pub fn add_weights(&mut self, weights: Tensor<1>) {
        self.max_weight = self.max_weight.clone().max_pair(weights);
    }
    /// Forgets gradients, as every round does.
    pub fn reset_gradients(&mut self) {
        self.gradient_sum = self.gradient_sum.zeros_like();
        self.seen = self.seen.zeros_like();
    }
}

/// What a round did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Round {
    /// Copies added.
    pub cloned: usize,
    /// Gaussians replaced by two smaller ones.
    pub split: usize,
    /// Gaussians removed.
    pub pruned: usize,
}

/// Which rules a round applies.
#[derive(Clone, Copy, Debug)]
pub struct Rounds {
    /// Clone and split.
    pub grow: bool,
    /// Remove by blending weight and start that statistic anew.
    pub prune_weight: bool,
    /// 1.1 x the spread of the cameras, world units.
    pub extent: f32,
}

/// One round: clone, split, prune. New Gaussians start with zero moments; statistics start anew.
pub fn densify(set: &mut GaussianSet, stats: &mut ScreenStats, config: &DensifyConfig, rounds: Rounds, seed: Seed) -> Result<Round> {
    let n = set.len();
    let device = set.columns[0].value.device();
    let gradient = to_vec(stats.gradient_sum.clone(), "screen gradients")?;
    let seen = to_vec(stats.seen.clone(), "screen counts")?;
    let mut weight = to_vec(stats.max_weight.clone(), "blending weights")?;
    let columns = set.to_host()?;
    let [means, log_scales, quaternions, logits] = [0, 1, 2, 3].map(|i| columns[i].arrays[0].as_slice());
    let largest = |i: usize| log_scales[3 * i..3 * i + 3].iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b)).exp();
    let opacity = |i: usize| 1.0 / (1.0 + (-logits[i]).exp());
    let weak = |i: usize| rounds.prune_weight && weight[i] < config.min_weight;
    let dead = |i: usize| {
        let finite = columns.iter().all(|c| c.arrays[0][i * c.width..(i + 1) * c.width].iter().all(|v| v.is_finite()));
        !finite || opacity(i) < config.min_opacity || (config.max_scale_share > 0.0 && largest(i) > config.max_scale_share * rounds.extent)
    };

    let mut plan = Plan::default();
    let mut round = Round::default();
    let mut born = Vec::new();
    let room = config.max_gaussians.saturating_sub(n);
    for i in 0..n {
        if dead(i) || weak(i) {
            round.pruned += 1;
            continue;
        }
        let mean_gradient = if seen[i] > 0.0 { gradient[i] / seen[i] } else { 0.0 };
        let grows = rounds.grow && mean_gradient >= config.gradient && round.cloned + round.split < room;
        if !grows {
            plan.keep(i);
        } else if largest(i) <= config.dense_share * rounds.extent {
            plan.keep(i);
            born.push((i, None));
            round.cloned += 1;
        } else {
            let mut rng = seed.index(i as u64).rng();
            for _ in 0..2 {
                let normal: [f32; 3] = std::array::from_fn(|_| standard_normal(&mut rng));
                born.push((i, Some(normal)));
            }
            round.split += 1;
        }
    }
    plan.born = born;
    if plan.kept.is_empty() && plan.born.is_empty() {
        // Removing everything would end the run; a scene that wants that keeps its Gaussians and the caller's PSNR tells the story.
        stats.reset_gradients();
        return Ok(Round::default());
    }
    let mut grown: Vec<HostColumn> = columns.iter().map(|c| plan.gather(c)).collect();
    let first_born = plan.kept.len();
    for (k, &(i, normal)) in plan.born.iter().enumerate() {
        let Some(normal) = normal else { continue };
        let row = first_born + k;
        let sample = rotate(&quaternions[4 * i..4 * i + 4], std::array::from_fn(|a| normal[a] * log_scales[3 * i + a].exp()));
        for a in 0..3 {
            grown[0].arrays[0][3 * row + a] = means[3 * i + a] + sample[a];
            // Two Gaussians of 1/1.6 the size stand for one (Inria's 0.8 * 2).
            grown[1].arrays[0][3 * row + a] = log_scales[3 * i + a] - 1.6f32.ln();
        }
    }
    let count = first_born + plan.born.len();
    if rounds.prune_weight {
        weight = vec![0.0; count];
    } else {
        weight = plan.kept.iter().map(|&i| weight[i]).chain(plan.born.iter().map(|_| f32::INFINITY)).collect();
    }
    *set = GaussianSet::from_host(grown, count, set.sh_degree, set.step, &device);
    *stats = ScreenStats::zeros(set);
    // Newborn Gaussians have no history: they cannot fail the coming weight pruning.
    stats.max_weight = Tensor::from_data(TensorData::new(weight.iter().map(|w| w.min(1.0)).collect::<Vec<f32>>(), [count]), &device);
    Ok(round)
}

/// Clamps opacity to at most `ceiling` and zeroes its moments (Inria's opacity reset).
pub fn reset_opacity(set: &mut GaussianSet, ceiling: f32) {
    let logit = (ceiling / (1.0 - ceiling)).ln();
    let column = &mut set.columns[3];
    column.value = column.value.clone().clamp_max(logit);
    column.first_moment = column.first_moment.zeros_like();
    column.second_moment = column.second_moment.zeros_like();
}

#[derive(Default)]
struct Plan {
    kept: Vec<usize>,
    /// Parent, and a standard normal sample when the child comes from a split.
    born: Vec<(usize, Option<[f32; 3]>)>,
}

impl Plan {
    fn keep(&mut self, i: usize) {
        self.kept.push(i);
    }
    fn gather(&self, column: &HostColumn) -> HostColumn {
        let w = column.width;
        let mut arrays: [Vec<f32>; 3] = Default::default();
        for (which, (to, from)) in arrays.iter_mut().zip(&column.arrays).enumerate() {
            to.reserve((self.kept.len() + self.born.len()) * w);
            for &i in &self.kept {
                to.extend_from_slice(&from[i * w..(i + 1) * w]);
            }
            for &(i, _) in &self.born {
                if which == 0 {
                    to.extend_from_slice(&from[i * w..(i + 1) * w]);
                } else {
                    to.extend(std::iter::repeat_n(0.0, w));
                }
            }
        }
        HostColumn { name: column.name.clone(), width: w, arrays }
    }
}

fn rotate(q: &[f32], v: [f32; 3]) -> [f32; 3] {
    let norm = q.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12);
    let rotation = glam::Quat::from_xyzw(q[1] / norm, q[2] / norm, q[3] / norm, q[0] / norm);
    (rotation * glam::Vec3::from(v)).to_array()
}

fn standard_normal(rng: &mut impl Rng) -> f32 {
    // Box-Muller; 1 - u keeps the logarithm finite.
    let (u, v): (f32, f32) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::init::from_points;
    use burn::tensor::Device;
    use cc4dgs_core::PointCloud;

    fn set_of(n: usize) -> GaussianSet {
        let positions = (0..n).map(|i| [i as f32, 0.0, 0.0]).collect();
        let mut host = from_points(&PointCloud { positions, colors: vec![[0.5; 3]; n] }, 1, 0.5);
        host.extra.insert("label".into(), cc4dgs_core::ExtraAttribute::exact(1, (0..n).map(|i| i as f32).collect()));
        GaussianSet::new(&host, &Device::flex())
    }

    #[test]
    fn clone_split_and_prune_carry_every_attribute() {
        let mut set = set_of(4);
        // 0: small and busy -> cloned; 1: large and busy -> split; 2: transparent -> pruned; 3: quiet -> kept.
        let mut host = set.to_host().unwrap();
        host[1].arrays[0][0..3].fill((0.001f32).ln());
        host[3].arrays[0][2] = -20.0;
        set = GaussianSet::from_host(host, 4, 1, 5, &Device::flex());
        let mut stats = ScreenStats::zeros(&set);
        stats.gradient_sum = Tensor::from_floats([1.0, 1.0, 1.0, 0.0], &Device::flex());
        stats.seen = Tensor::ones([4], &Device::flex());
        let rounds = Rounds { grow: true, prune_weight: false, extent: 1.0 };
        let round = densify(&mut set, &mut stats, &DensifyConfig::default(), rounds, Seed::root(1)).unwrap();
        assert_eq!(round, Round { cloned: 1, split: 1, pruned: 1 });
        let after = set.to_host().unwrap();
        assert_eq!(after.iter().find(|c| c.name == "label").unwrap().arrays[0], vec![0.0, 3.0, 0.0, 1.0, 1.0]);
        let parent = set_of(4).to_host().unwrap()[1].arrays[0][3];
        assert!((after[1].arrays[0][3 * 3] - (parent - 1.6f32.ln())).abs() < 1e-6);
        assert_ne!(after[0].arrays[0][9..12], after[0].arrays[0][12..15], "the two halves are different samples");
    }

    #[test]
    fn weight_pruning_removes_what_never_shows() {
        let mut set = set_of(3);
        let mut stats = ScreenStats::zeros(&set);
        stats.add_weights(Tensor::from_floats([0.5, 0.0, 0.019], &Device::flex()));
        let rounds = Rounds { grow: false, prune_weight: true, extent: 1.0 };
        let round = densify(&mut set, &mut stats, &DensifyConfig::default(), rounds, Seed::root(1)).unwrap();
        assert_eq!((round.pruned, set.len()), (2, 1));
    }
}
