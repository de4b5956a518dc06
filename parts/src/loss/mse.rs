//! Loss term: mean squared difference of rendered and recorded image.

use burn::tensor::Tensor;

use cc4dgs_core::{LossInput, LossPlugin, LossTerm, Plugin, Result, config, inventory, ordered_sum};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct MeanSquare;

impl LossTerm for MeanSquare {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let difference = input.planes.clone().narrow(0, 0, 3) - input.target.clone();
        // Divided before the sum, which would overflow where the mean does not.
        let share = difference.mul_scalar(1.0 / (input.target.dims().iter().product::<usize>().max(1) as f64).sqrt());
        Ok(Some(ordered_sum(share.clone().mul(share))))
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let NoSettings {} = config::parse_section("loss mse", section)?;
    Ok(Box::new(MeanSquare))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "mse",
            version: "1",
            summary: "mean squared difference of rendered and recorded image",
            paper: "Mildenhall et al. 2020 (NeRF)",
            schema: "# no settings\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
