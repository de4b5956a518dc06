//! Loss term: mean absolute difference of rendered and recorded image.

use super::photometric::Photometric;
use cc4dgs_core::{LossPlugin, LossTerm, Plugin, Result, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss l1", section)?;
    Ok(Box::new(Photometric { scale: 1.0, l1_share: 1.0 }))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "l1",
            version: "1",
            summary: "mean absolute difference of rendered and recorded image",
            paper: "Kerbl et al. 2023 (3DGS)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
