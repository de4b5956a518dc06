//! Loss term: mean standard deviation of the Gaussians, divided by the extent of the cameras in the normalised frame. It favours few and small Gaussians
//! (3DGS-MCMC).

use burn::tensor::Tensor;

use cc4dgs_core::{LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory, ordered_sum};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct MeanScale;

impl LossTerm for MeanScale {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        if input.gaussians.is_empty() {
            return Ok(None);
        }
        let scales = input.gaussians.log_scales.clone().exp();
        let count = scales.dims().iter().product::<usize>();
        Ok(Some(ordered_sum(scales).div_scalar(count as f32).div_scalar(input.schedule.extent.max(f32::MIN_POSITIVE))))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss scale", section)?;
    Ok(Box::new(MeanScale))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "scale",
            version: "1",
            summary: "mean scale (standard deviation) of the Gaussians, relative to the extent of the cameras",
            paper: "Kheradmand et al. 2024 (3DGS-MCMC)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
