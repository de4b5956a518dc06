//! Loss term: difference of rendered and recorded depth, relative to the recorded one.
//!
//! Sensors measure far surfaces less exactly than near ones, and the unit of a scene is arbitrary: so a difference counts as a share of the distance. Its
//! absolute value counts, not its square, because sensors are far off at edges and in reflections. DN-Splatter (Turkulainen et al. 2024) compares the depth of
//! Gaussians with that of a sensor by log(1 + |difference|), DS-NeRF (Deng et al. 2022) that of rays with the depth of points, weighted by their exactness.

use burn::tensor::Tensor;
use cc4dgs_core::{Error, LossInput, LossPlugin, LossTerm, Plugin, Result, Stage, config, inventory, ordered_sum};
use serde::Deserialize;

/// Smaller depths count as this one, in units of the scene, in which cameras are some 4 away.
const LEAST_DEPTH: f32 = 1e-6;

/// The mean of |D - alpha d| / d over the pixels whose depth d is known. D is the rendered plane, the sum of weight times z, and alpha the sum of weights: this
/// is alpha |z / d - 1| for the mean depth z = D / alpha, without a division by an alpha that may be 0.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct RelativeDepth {
    end_share: f64,
}

impl Default for RelativeDepth {
    fn default() -> Self {
        Self { end_share: 1.0 }
    }
}

impl LossTerm for RelativeDepth {
    fn value(&self, input: &LossInput) -> Result<Option<Tensor<1>>> {
        let Some(recorded) = input.depth else { return Ok(None) };
        // 1 where the depth is known, else 0.
        let known = recorded.clone().sign();
        let inverse = known.clone() / recorded.clone().clamp_min(LEAST_DEPTH);
        let count = ordered_sum(known.clone()).clamp_min(1.0);
        let [alpha, depth] = [3, 4].map(|plane| input.planes.clone().narrow(0, plane, 1));
        let mean = ordered_sum((depth * inverse - alpha * known).abs()) / count;
        let share = if input.schedule.stage == Stage::Main { self.end_share.powf(input.schedule.progress()) } else { 1.0 };
        Ok(Some(if share == 1.0 { mean } else { mean.mul_scalar(share) }))
    }
    fn wants_depth(&self) -> bool {
        true
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn LossTerm>> {
    let term: RelativeDepth = config::parse_section("loss depth", section)?;
    if !(term.end_share > 0.0 && term.end_share <= 1.0) {
        let problem = format!("{} is not above 0 and at most 1", term.end_share);
        return Err(Error::parameter("loss depth: end_share", problem, "Give 1 for a weight that stays, 0.01 for one that falls to a hundredth"));
    }
    Ok(Box::new(term))
}

inventory::submit! {
    LossPlugin {
        info: Plugin {
            name: "depth",
            version: "1",
            summary: "mean difference of rendered and recorded depth as a share of the recorded one, where it is known; for scenes with depth",
            paper: "after DN-Splatter (Turkulainen et al. 2024) and DS-NeRF (Deng et al. 2022)",
            schema: "end_share = 1.0          # weight at the end of the main stage over that at its start, above 0 and at most 1; it falls log-linearly\n",
            capabilities: &["differentiable"],
        },
        build,
        fuses: None,
    }
}
