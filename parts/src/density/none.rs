//! No density control: the Gaussians of the initialisation stay.

use burn::tensor::Device;
use cc4dgs_core::{DensityControl, DensityPlan, DensityPlugin, Gaussians, Plugin, Result, Schedule, Seed, Statistic, ViewStatistics, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct Fixed;

impl DensityControl for Fixed {
    fn begin_stage(&mut self, _count: usize, _device: &Device) {}
    fn statistics(&self, _schedule: &Schedule) -> Vec<Statistic> {
        Vec::new()
    }
    fn observe(&mut self, _view: &ViewStatistics) -> Result<()> {
        Ok(())
    }
    fn plan(&mut self, _gaussians: &Gaussians, _schedule: &Schedule, _seed: Seed) -> Result<Option<DensityPlan>> {
        Ok(None)
    }
}

fn build(section: &toml::Table) -> Result<Box<dyn DensityControl>> {
    let NoSettings {} = config::parse_section("density none", section)?;
    Ok(Box::new(Fixed))
}

inventory::submit! {
    DensityPlugin {
        info: Plugin {
            name: "none",
            version: "1",
            summary: "no density control: the initial Gaussians stay, none is added or removed",
            paper: "",
            schema: "# no settings\n",
            capabilities: &[],
        },
        build,
    }
}
