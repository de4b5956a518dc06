//! Loss term: 1 - SSIM of rendered and recorded image, 11x11 Gaussian window of sigma 1.5, zero padding.

use super::photometric::Photometric;
use cc4dgs_core::{LossPlugin, LossTerm, Plugin, Result, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss dssim", section)?;
    Ok(Box::new(Photometric { scale: 1.0, l1_share: 0.0 }))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "dssim",
            version: "1",
            summary: "1 - SSIM of rendered and recorded image: 11x11 Gaussian window of sigma 1.5, zero padding",
            paper: "Kerbl et al. 2023 (3DGS)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
