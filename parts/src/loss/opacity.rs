//! Loss term: mean opacity of the Gaussians at the time of the view. It favours few and small Gaussians (3DGS-MCMC).

use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;
use cc4dgs_core::{LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory, ordered_sum};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct MeanOpacity;

impl LossTerm for MeanOpacity {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        if input.gaussians.is_empty() {
            return Ok(None);
        }
        Ok(Some(ordered_sum(sigmoid(input.gaussians.opacity_logits.clone())).div_scalar(input.gaussians.opacity_logits.dims()[0] as f32)))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss opacity", section)?;
    Ok(Box::new(MeanOpacity))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "opacity",
            version: "1",
            summary: "mean opacity of the Gaussians at the time of the view",
            paper: "Kheradmand et al. 2024 (3DGS-MCMC)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
