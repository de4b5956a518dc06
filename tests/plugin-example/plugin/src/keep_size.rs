//! `keep-size`: what moves rigidly keeps its size. The term compares the Gaussians as drawn with the canonical ones.

use cc4dgs_core::burn::tensor::Tensor;
use cc4dgs_core::{Error, LossInput, LossPlugin, LossTerm, Plugin, Result, inventory, ordered_sum, toml};

struct KeepSize;

impl LossTerm for KeepSize {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let count = input.gaussians.len();
        let growth = || input.gaussians.log_scales.clone() - input.canonical.log_scales.clone();
        Ok((count > 0).then(|| ordered_sum(growth().powi_scalar(2)).div_scalar(3.0 * count as f32)))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    match section.keys().next() {
        None => Ok(Box::new(KeepSize)),
        Some(key) => Err(Error::parameter(format!("loss keep-size: {key}"), "there is no such setting", "Remove it")),
    }
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "keep-size",
            version: "1",
            summary: "the mean square of how far the deformer changes log-scales, so that what moves keeps its size",
            paper: "an example",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
