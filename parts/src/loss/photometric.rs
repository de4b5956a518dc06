//! Loss term: L1 and 1 - SSIM in one pass over the images.

use burn::tensor::Tensor;
use cc4dgs_backends::ops::photometric::photometric_loss;
use cc4dgs_core::{Error, Fusion, LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory};
use serde::Deserialize;

/// `scale` x (`l1_share` x L1 + (1 - `l1_share`) x (1 - SSIM)); SSIM with an 11x11 Gaussian window of sigma 1.5 and zero padding, as in 3DGS.
pub(super) struct Photometric {
    pub scale: f64,
    pub l1_share: f32,
}

impl LossTerm for Photometric {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let loss = photometric_loss(input.planes.clone(), input.target.clone(), self.l1_share)?.loss;
        Ok(Some(if self.scale == 1.0 { loss } else { loss.mul_scalar(self.scale) }))
    }
}

#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    l1_share: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self { l1_share: 0.8 }
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let Settings { l1_share } = config::parse_section("loss photometric", section)?;
    if !(0.0..=1.0).contains(&l1_share) {
        return Err(Error::parameter("loss photometric: l1_share", format!("{l1_share} is not in 0..1"), "Give the weight of L1; 1 - SSIM gets the rest"));
    }
    Ok(Box::new(Photometric { scale: 1.0, l1_share }))
}

/// The terms `l1` and `dssim` with these weights.
fn fused(weights: &[f64]) -> Result<Box<dyn LossTerm>> {
    let [l1, dssim] = weights else {
        return Err(Error::backend("loss photometric", format!("{} weights for two terms", weights.len()), "Report this as a defect"));
    };
    let scale = l1 + dssim;
    Ok(Box::new(Photometric { scale, l1_share: if scale > 0.0 { (l1 / scale) as f32 } else { 0.0 } }))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "photometric",
            version: "1",
            summary: "L1 and 1 - SSIM in one pass; replaces the terms l1 and dssim if both are listed",
            paper: "Kerbl et al. 2023 (3DGS); CC-4DGS, Section IV-E",
            schema: "l1_share = 0.8           # weight of L1; the rest goes to 1 - SSIM (the paper's lambda_c)\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: Some(Fusion { kinds: &["l1", "dssim"], build: fused }),
    }
}
