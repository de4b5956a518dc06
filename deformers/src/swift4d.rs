//! The deformer of Swift4D: one joint 4D hash grid over position and time, an encoder, five heads, no biases (Wu et al. 2025 and its published code).
//!
//! Outside the box the grid's features are zero, and without biases the offsets are zero too: Gaussians outside do not move. Swift4D's box contains all
//! Gaussians, this one those that move. Swift4D's time ends just before 1, here it ends at 1.

use crate::parts::centres::{check_time, column, in_box};
use crate::parts::heads::{self, Head};
use crate::parts::settings::{bounded, not_negative, within};
use crate::parts::voxels::parameter;
use crate::parts::weights;
use burn::tensor::{Device, Tensor};
use cc4dgs_backends::ops::field::{ReluShape, mlp_relu};
use cc4dgs_backends::ops::lookup::{GridShape, Outside, lookup};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Offsets, Parameter, ParameterGroup, Part, Plugin, Result, SpatialFeatures, SpatialInput, config,
    inventory,
};
use serde::Deserialize;
use std::sync::Arc;

const SCHEMA: &str = r#"log2_rows = 15           # rows of a level's table: 15 (9.2 MB) or 19 (127.7 MB), per scene
levels = 16
features = 4             # features per level
base = 16                # vertices per axis of the first level; each level doubles them
width = 128              # width of encoder and heads
heads = ["means", "log_scales", "quaternions", "opacity", "sh"]
lr_start = 2e-4          # Adam, log-linear to lr_end
lr_end = 2e-6
grid_rate = 1.0          # learning rate of the table, as a multiple
times_extent = true      # multiply the rates by the extent of the cameras in the normalised frame, as published
"#;

/// Heads are padded to this many columns, as the published weights are.
const PADDED: usize = 16;
/// Initial table entries are uniform in ± this.
const TABLE: f32 = 1e-4;
/// Parameter groups by index.
const NET: usize = 0;
const GRID: usize = 1;

#[derive(Clone, Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    log2_rows: u32,
    levels: usize,
    features: usize,
    base: u32,
    width: usize,
    heads: Vec<Head>,
    lr_start: f64,
    lr_end: f64,
    grid_rate: f64,
    times_extent: bool,
}

impl Default for Settings {
    fn default() -> Self {
        let heads = vec![Head::Means, Head::LogScales, Head::Quaternions, Head::Opacity, Head::Sh];
        Self { log2_rows: 15, levels: 16, features: 4, base: 16, width: 128, heads, lr_start: 2e-4, lr_end: 2e-6, grid_rate: 1.0, times_extent: true }
    }
}

/// Parameters: table, encoder, one per head.
struct Swift4d {
    settings: Settings,
    context: DeformerContext,
    grid: Arc<GridShape>,
    network: Arc<ReluShape>,
    parameters: Vec<Parameter>,
}

impl Swift4d {
    fn new(settings: Settings, context: &DeformerContext, device: &Device) -> Result<Self> {
        within("log2_rows", settings.log2_rows as usize, 4, 24)?;
        within("levels", settings.levels, 1, 20)?;
        within("features", settings.features, 1, 16)?;
        within("base", settings.base as usize, 2, 256)?;
        within("width", settings.width, 1, 4096)?;
        heads::check(&settings.heads)?;
        not_negative(&[("lr_start", settings.lr_start), ("lr_end", settings.lr_end), ("grid_rate", settings.grid_rate)])?;
        let mut grid =
            GridShape { dims: 4, features: settings.features, levels: Vec::new(), stagger: 0.5, smooth: false, clamps: false, outside: Outside::Zero };
        for level in 0..settings.levels {
            let vertices = settings.base << level;
            grid.push(&[vertices; 4], &[vertices as f32 - 1.0; 4], 1 << settings.log2_rows);
        }
        let w = settings.width;
        let outputs: Vec<usize> = settings.heads.iter().map(|h| h.width(context.sh_degree).next_multiple_of(PADDED)).collect();
        let network = ReluShape { input: grid.width(), trunk: vec![w, w], heads: outputs.iter().map(|&out| vec![w, w, out]).collect() };
        bounded([grid.parameter_count(), network.parameter_count()])?;
        let seed = context.seed;
        let matrices = |seed: cc4dgs_core::Seed, widths: &[usize]| -> Vec<f32> {
            widths.windows(2).enumerate().flat_map(|(i, pair)| weights::glorot(seed.index(i as u64), pair[0], pair[1])).collect()
        };
        let table = weights::uniform(seed.child("table"), grid.parameter_count(), TABLE);
        let mut parameters = vec![parameter("grid.table".into(), Part::Grid, GRID, table, device)];
        // The paper's size tables count the encoder as grid.
        parameters.push(parameter("grid.encoder".into(), Part::Grid, NET, matrices(seed.child("encoder"), &[grid.width(), w, w]), device));
        for (head, &out) in settings.heads.iter().zip(&outputs) {
            let values = matrices(seed.child(head.name()), &[w, w, w, out]);
            parameters.push(parameter(format!("net.head.{}", head.name()), Part::Net, NET, values, device));
        }
        Ok(Self { settings, context: context.clone(), grid: Arc::new(grid), network: Arc::new(network), parameters })
    }
}

impl Deformer for Swift4d {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let means_world = input.means_world.clone();
        let work = DeformerWork { gaussians: means_world.dims()[0] as u64, ..DeformerWork::default() };
        // Space and time share one table, so nothing but the normalised position is time-invariant.
        Ok(SpatialFeatures { values: in_box(means_world, &self.context), work })
    }
    fn deform(&self, features: Tensor<2>, time_norm: f32) -> Result<Offsets> {
        check_time(time_norm)?;
        let (m, w, degree) = (features.dims()[0], self.settings.width, self.context.sh_degree);
        let widths = self.settings.heads.iter().map(|h| h.width(degree));
        if m == 0 {
            let empty = widths.map(|width| Tensor::zeros([0, width], &features.device())).collect();
            return Ok(heads::offsets(&self.settings.heads, empty, degree));
        }
        let points = Tensor::cat(vec![features.clone(), column(&features, time_norm)], 1);
        let encoded = lookup(self.parameters[0].value.clone(), points, &self.grid)?;
        let mut layers = vec![weights::without_biases(self.parameters[1].value.clone(), &[(self.grid.width(), w), (w, w)])];
        for (parameter, shape) in self.parameters[2..].iter().zip(&self.network.heads) {
            layers.push(weights::without_biases(parameter.value.clone(), &[(w, w), (w, w), (w, shape[2])]));
        }
        let padded = mlp_relu(encoded, Tensor::cat(layers, 0), &self.network)?;
        let outputs = padded.into_iter().zip(widths).map(|(out, width)| out.narrow(1, 0, width)).collect();
        Ok(heads::offsets(&self.settings.heads, outputs, degree))
    }
    fn parameters(&self) -> Vec<&Parameter> {
        self.parameters.iter().collect()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        self.parameters.iter_mut().collect()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        let s = &self.settings;
        let group = |name, factor| ParameterGroup {
            times_extent: s.times_extent,
            epsilon: 1e-8,
            ..ParameterGroup::plain(name, s.lr_start * factor, s.lr_end * factor)
        };
        vec![group("swift4d-hash", 1.0), group("swift4d-hash table", s.grid_rate)]
    }
}

fn build(section: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Swift4d::new(config::parse_section("deformer swift4d-hash", section)?, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "swift4d-hash",
            version: "1",
            summary: "one joint hash grid over space and time, five heads without biases",
            paper: "Swift4D (Wu et al. 2025)",
            schema: SCHEMA,
            capabilities: &["differentiable", "joint-space-time"],
        },
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_core::Seed;

    #[test]
    fn the_table_has_a_rate_of_its_own_and_the_extent_may_be_left_out() {
        let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 20, sh_degree: 0, seed: Seed::root(2) };
        let of = |grid_rate: f64, times_extent: bool| {
            let small = Settings { log2_rows: 4, levels: 1, width: 4, grid_rate, times_extent, ..Settings::default() };
            let deformer = Swift4d::new(small, &context, &Device::flex()).unwrap();
            let groups = deformer.groups();
            let rate = |parameter: &Parameter| (groups[parameter.group].lr_start, groups[parameter.group].lr_end, groups[parameter.group].times_extent);
            deformer.parameters().into_iter().map(rate).collect::<Vec<_>>()
        };
        assert!(of(1.0, true).into_iter().all(|rate| rate == (2e-4, 2e-6, true)), "as published");
        let own = of(3.0, false);
        assert_eq!(own[0], (2e-4 * 3.0, 2e-6 * 3.0, false));
        assert!(own[1..].iter().all(|rate| *rate == (2e-4, 2e-6, false)));
    }
}
