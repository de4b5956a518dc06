//! Density control of one's own: a fixed budget. Gaussians that faded away are moved onto visible ones; none is added or removed.
//!
//! `cargo run --release --example density -- [ITERATIONS]`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::burn::tensor::Device;
use cc4dgs::core::gaussians::to_vec;
use cc4dgs::core::{
    DensityControl, DensityPlan, DensityPlugin, Gaussians, Plugin, Schedule, Seed, Statistic, ViewStatistics, config, conformance, inventory, serde, toml,
};
use cc4dgs::{Error, Result, Session, Split};
use std::sync::Arc;

/// Iterations between two rounds. There are no settings.
const EVERY: usize = 50;
#[derive(serde::Deserialize)]
#[serde(crate = "self::serde", deny_unknown_fields)]
struct Budget {}

impl DensityControl for Budget {
    fn begin_stage(&mut self, _: usize, _: &Device) {}
    fn statistics(&self, _: &Schedule) -> Vec<Statistic> {
        Vec::new()
    }
    fn observe(&mut self, _: &ViewStatistics) -> Result<()> {
        Ok(())
    }
    fn plan(&mut self, gaussians: &Gaussians, schedule: &Schedule, _: Seed) -> Result<Option<DensityPlan>> {
        if !schedule.iteration.is_multiple_of(EVERY) || schedule.left() < EVERY {
            return Ok(None);
        }
        let opacity: Vec<f32> = to_vec(gaussians.opacity_logits.clone(), "opacities")?.into_iter().map(|o| 1.0 / (1.0 + (-o).exp())).collect();
        // An opacity that is not a number is over no threshold: nothing is copied from such a Gaussian.
        let (mut alive, dead): (Vec<usize>, Vec<usize>) = (0..opacity.len()).partition(|&i| opacity[i] >= 0.01);
        if dead.is_empty() || alive.is_empty() {
            return Ok(None);
        }
        alive.sort_by(|&a, &b| opacity[b].total_cmp(&opacity[a]));
        let (mut parents, mut copies): (Vec<usize>, _) = ((0..opacity.len()).collect(), vec![1u32; opacity.len()]);
        for (&row, &parent) in dead.iter().zip(alive.iter().cycle()) {
            parents[row] = parent;
            copies[parent] += 1;
        }
        let mut plan = DensityPlan::new();
        for (row, &parent) in parents.iter().enumerate() {
            let new = if row == parent { plan.keep(row) } else { plan.copy(parent) };
            if copies[parent] > 1 {
                // Together the copies cover as much as the one before them (3DGS-MCMC, equation 9).
                let share = (1.0 - (1.0 - opacity[parent]).powf(1.0 / copies[parent] as f32)).clamp(1e-4, 1.0 - 1e-4);
                plan.set(new, "opacity_logits", &[(share / (1.0 - share)).ln()]);
            }
        }
        plan.report.moved = dead.len();
        Ok(Some(plan))
    }
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "budget", version: "1", summary: "moves faded Gaussians onto visible ones", paper: "after 3DGS-MCMC (Kheradmand et al. 2024)",
            schema: "# no settings\n", capabilities: &[],
        },
        build: |settings| Ok(Box::new(config::parse_section::<Budget>("density budget", settings)?)),
    }
}

fn main() -> Result<()> {
    let iterations = std::env::args().nth(1).unwrap_or_else(|| "600".into());
    let session = Session::new()?;
    let findings = conformance::density(session.registry().density("budget")?, &toml::Table::new(), session.device());
    if !findings.is_empty() {
        return Err(Error::backend("density control budget", findings.join("\n"), "Correct it"));
    }
    let config = session.config("demo", &["density.kind=budget", &format!("train.iterations={iterations}")])?;
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene)?);
    let model = session.train(&config, scene.clone(), None)?;
    println!("{} Gaussians, {:.2} dB", model.gaussians.len(), session.evaluate(&model, &scene, Split::Test)?.psnr_db);
    Ok(())
}
