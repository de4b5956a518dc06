//! A loss term of one's own: needles are discouraged. The term sees the Gaussians as drawn, not only the image.
//!
//! `cargo run --release --example loss -- [ITERATIONS]`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::burn::tensor::Tensor;
use cc4dgs::core::serde::{self, Deserialize};
use cc4dgs::core::{LossInput, LossPlugin, LossTerm, Plugin, config, inventory, ordered_sum, toml};
use cc4dgs::{Error, Model, Result, Session, Split};
use std::sync::Arc;

/// Mean excess of the longest over the shortest axis, as log-scales (PhysGaussian's anisotropy term).
#[derive(Deserialize)]
#[serde(crate = "self::serde", deny_unknown_fields)]
struct Needles {
    #[serde(default = "four")]
    ratio: f32,
}

fn four() -> f32 {
    4.0
}

impl LossTerm for Needles {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let (scales, count) = (input.gaussians.log_scales.clone(), input.gaussians.len());
        if count == 0 {
            return Ok(None);
        }
        let excess = (scales.clone().max_dim(1) - scales.min_dim(1)).sub_scalar(self.ratio.ln()).clamp_min(0.0);
        // burn's own sums and means may add in another order in every run.
        Ok(Some(ordered_sum(excess).div_scalar(count as f32)))
    }
}

fn build(settings: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let term: Needles = config::parse_section("loss needles", settings)?;
    if term.ratio >= 1.0 {
        return Ok(Box::new(term));
    }
    Err(Error::parameter("loss needles: ratio", format!("{} is below 1", term.ratio), "Give the largest ratio of two axes that costs nothing, such as 4"))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "needles", version: "1", summary: "discourages long thin Gaussians", paper: "PhysGaussian (Xie et al. 2024)",
            schema: "ratio = 4.0              # of the longest to the shortest axis that costs nothing\n", capabilities: &[],
        },
        build,
        fuses: None,
    }
}

/// Root-mean-square of the logarithm of longest over shortest axis.
fn elongation(model: &Model) -> f64 {
    let log_ratio = |s: &[f32]| f64::from(s.iter().copied().fold(f32::MIN, f32::max) - s.iter().copied().fold(f32::MAX, f32::min));
    (model.gaussians.log_scales.chunks_exact(3).map(|s| log_ratio(s).powi(2)).sum::<f64>() / model.gaussians.len().max(1) as f64).sqrt()
}

fn main() -> Result<()> {
    let iterations = std::env::args().nth(1).unwrap_or_else(|| "600".into());
    let session = Session::new()?;
    let usual = "{kind = 'l1', weight = 0.8}, {kind = 'dssim', weight = 0.2}";
    for terms in [usual.to_string(), format!("{usual}, {{kind = 'needles', weight = 0.1, ratio = 1.1}}")] {
        let config = session.config("demo", &[&format!("train.iterations={iterations}"), &format!("loss=[{terms}]")])?;
        let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene)?);
        let model = session.train(&config, scene.clone(), None)?;
        let psnr_db = session.evaluate(&model, &scene, Split::Test)?.psnr_db;
        println!("[{terms}]: {psnr_db:.2} dB, elongation {:.3}", elongation(&model));
    }
    Ok(())
}
