//! No deformation: a static scene, and the baseline for dynamic ones.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{
    Deformer, DeformerContext, DeformerPlugin, DeformerWork, Offsets, Parameter, ParameterGroup, Plugin, Result, SpatialFeatures, SpatialInput, config,
    inventory,
};
use serde::Deserialize;

struct NoDeformation;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

impl Deformer for NoDeformation {
    fn spatial(&self, input: &SpatialInput) -> Result<SpatialFeatures> {
        let m = input.len();
        let work = DeformerWork { gaussians: m as u64, ..DeformerWork::default() };
        Ok(SpatialFeatures { values: Tensor::zeros([m, 1], &input.means_world.clone().inner().device()), work })
    }
    fn deform(&self, _features: Tensor<2>, _time_norm: f32) -> Result<Offsets> {
        Ok(Offsets::default())
    }
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
    fn is_static(&self) -> bool {
        true
    }
}

fn build(settings: &toml::Table, _context: &DeformerContext, _device: &Device) -> Result<Box<dyn Deformer>> {
    config::parse_section::<NoSettings>("deformer none", settings)?;
    Ok(Box::new(NoDeformation))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: "none",
            version: "1",
            summary: "no deformation: a static scene",
            paper: "Kerbl et al. 2023 (3DGS)",
            schema: "# no settings\n",
            capabilities: &["static-only"],
        },
        build,
    }
}
