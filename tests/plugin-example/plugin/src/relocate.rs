//! `relocate`: density control after 3DGS-MCMC (Kheradmand et al. 2024). Faded Gaussians are moved onto visible ones, their number grows to a cap, and noise
//! lets faint ones explore.

use cc4dgs_core::burn::tensor::{Device, Tensor, TensorData, activation::sigmoid};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{
    DensityControl, DensityPlan, DensityPlugin, DensityReport, Error, Gaussians, Plugin, Result, Schedule, Seed, Statistic, ViewStatistics, config, inventory,
    toml,
};
use rand::Rng;

#[derive(Deserialize)]
#[serde(crate = "self::serde", default, deny_unknown_fields)]
struct Relocate {
    every: usize,
    dead_below: f32,
    growth: f64,
    max_gaussians: usize,
    noise: f32,
}

impl Default for Relocate {
    fn default() -> Self {
        Self { every: 100, dead_below: 0.005, growth: 0.05, max_gaussians: 100_000, noise: 0.5 }
    }
}

impl DensityControl for Relocate {
    fn begin_stage(&mut self, _: usize, _: &Device) {}
    fn statistics(&self, _: &Schedule) -> Vec<Statistic> {
        // The image's gradients are not asked for, so they are not collected.
        Vec::new()
    }
    fn observe(&mut self, _: &ViewStatistics) -> Result<()> {
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Option<DensityPlan>> {
        let every = schedule.interval(self.every, 20);
        if !schedule.iteration.is_multiple_of(every) || schedule.left() < every {
            return Ok(None);
        }
        let opacity = to_vec(sigmoid(gaussians.opacity_logits.clone()), "opacities")?;
        let scales = to_vec(gaussians.log_scales.clone(), "log-scales")?;
        let (n, alive) = (opacity.len(), (0..opacity.len()).filter(|&i| opacity[i] >= self.dead_below).collect::<Vec<_>>());
        // A parent is chosen in proportion to its opacity.
        let sums: Vec<f32> = alive.iter().scan(0.0, |sum, &i| Some(std::mem::replace(sum, *sum + opacity[i]) + opacity[i])).collect();
        let Some(&total) = sums.last() else { return Ok(None) };
        let mut random = seed.rng();
        let mut draw = || alive[sums.partition_point(|&s| s < random.random::<f32>() * total).min(alive.len() - 1)];
        let added = ((n as f64 * self.growth) as usize).min(self.max_gaussians.saturating_sub(n));
        let parents: Vec<usize> = (0..n + added).map(|row| if row < n && opacity[row] >= self.dead_below { row } else { draw() }).collect();
        let mut copies = vec![0u32; n];
        parents.iter().for_each(|&parent| copies[parent] += 1);
        let mut plan = DensityPlan::new();
        for (row, &parent) in parents.iter().enumerate() {
            let new = if row == parent { plan.keep(row) } else { plan.copy(parent) };
            if copies[parent] > 1 {
                let (logit, shrink) = shared(opacity[parent], copies[parent]);
                plan.set(new, "opacity_logits", &[logit]);
                plan.set(new, "log_scales", &[0, 1, 2].map(|k| scales[3 * parent + k] + shrink));
            }
        }
        plan.report = DensityReport { cloned: added, moved: n - alive.len(), ..Default::default() };
        Ok(Some(plan))
    }
    fn after_step(&mut self, gaussians: &Gaussians, schedule: &Schedule, seed: Seed) -> Result<Vec<(String, Tensor<2>)>> {
        if self.noise == 0.0 {
            return Ok(Vec::new());
        }
        let (n, mut random) = (gaussians.len(), seed.rng());
        // Twelve uniform numbers make a normal one.
        let normal: Vec<f32> = (0..3 * n).map(|_| (0..12).map(|_| random.random::<f32>()).sum::<f32>() - 6.0).collect();
        let normal = Tensor::<2>::from_data(TensorData::new(normal, [n, 3]), &gaussians.means.device());
        // Only what is nearly transparent moves, by a share of its own size; less and less towards the end of the stage.
        let faint = sigmoid(sigmoid(gaussians.opacity_logits.clone()).sub_scalar(0.005).mul_scalar(-100.0)).reshape([n, 1]);
        let size = gaussians.log_scales.clone().mean_dim(1).exp();
        let step = normal * faint * size * (self.noise * (1.0 - schedule.progress() as f32));
        Ok(vec![("means".into(), gaussians.means.clone() + step)])
    }
}

/// The logit of each of `copies` Gaussians that together are as opaque as one of `opacity`, and what is added to their log-scales (equation 9).
fn shared(opacity: f32, copies: u32) -> (f32, f32) {
    let old = opacity.clamp(1e-4, 1.0 - 1e-4);
    let new = (1.0 - (1.0 - old).powf(1.0 / copies as f32)).clamp(1e-4, 1.0 - 1e-4);
    let mut sum = 0.0;
    for i in 1..=copies {
        let mut binomial = 1.0f32;
        for k in 0..i {
            sum += binomial * if k % 2 == 0 { 1.0 } else { -1.0 } * new.powi(k as i32 + 1) / ((k + 1) as f32).sqrt();
            binomial *= (i - 1 - k) as f32 / (k + 1) as f32;
        }
    }
    ((new / (1.0 - new)).ln(), (old / sum.max(1e-4)).ln().clamp(-2.0, 0.5))
}

fn build(section: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let control: Relocate = config::parse_section("density relocate", section)?;
    for (name, value, least, most) in [
        ("every", control.every as f64, 1.0, 1e6),
        ("dead_below", f64::from(control.dead_below), 0.0, 0.99),
        ("growth", control.growth, 0.0, 1.0),
        ("noise", f64::from(control.noise), 0.0, 100.0),
    ] {
        if !(least..=most).contains(&value) {
            let problem = format!("{value} is not from {least} to {most}");
            return Err(Error::parameter(format!("density relocate: {name}"), problem, "Give a number in this range, or leave it out"));
        }
    }
    Ok(Box::new(control))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "relocate", version: "1", summary: "moves faded Gaussians onto visible ones, grows to a cap, and adds noise", paper: "3DGS-MCMC (Kheradmand et al. 2024)",
            schema: "every = 100              # reference iterations\ndead_below = 0.005       # opacity\ngrowth = 0.05            # per round\nmax_gaussians = 100000\nnoise = 0.5              # of a Gaussian's size per step\n",
            capabilities: &[],
        },
        build,
    }
}
