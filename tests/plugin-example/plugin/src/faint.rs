//! `faint`: the mean opacity as a loss term, so that Gaussians that are not needed fade away (3DGS-MCMC).

use cc4dgs_core::burn::tensor::{Tensor, activation::sigmoid};
use cc4dgs_core::{Error, LossInput, LossPlugin, LossTerm, Plugin, Result, inventory, ordered_sum, toml};

struct Faint;

impl LossTerm for Faint {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let (logits, count) = (&input.gaussians.opacity_logits, input.gaussians.len());
        // burn's own sums and means may add in another order in every run.
        Ok((count > 0).then(|| ordered_sum(sigmoid(logits.clone())).div_scalar(count as f32)))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    match section.keys().next() {
        None => Ok(Box::new(Faint)),
        Some(key) => Err(Error::parameter(format!("loss faint: {key}"), "there is no such setting", "Remove it")),
    }
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "faint",
            version: "1",
            summary: "the mean opacity, so that what is not needed fades away",
            paper: "3DGS-MCMC (Kheradmand et al. 2024)",
            schema: "# no settings\n",
            capabilities: &[],
        },
        build,
        fuses: None,
    }
}
