//! Binary cross-entropy of the first rendered plane, read as logits, against a mask: the score stage fits dynamic scores with it (Swift4D).

use burn::tensor::Tensor;
use cc4dgs_backends::ops::photometric::bce_with_logits_loss;
use cc4dgs_core::{LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct MaskBce;

impl LossTerm for MaskBce {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let [_, height, width] = input.target.dims();
        let mask = input.target.clone().narrow(0, 0, 1).reshape([height, width]);
        Ok(Some(bce_with_logits_loss(input.planes.clone(), mask)?))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss mask-bce", section)?;
    Ok(Box::new(MaskBce))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "mask-bce",
            version: "1",
            summary: "binary cross-entropy of rendered dynamic scores (logits) and the mask of what moves; for the score stage",
            paper: "Swift4D (Wu et al. 2025)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
