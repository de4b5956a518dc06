//! No appearance model: cameras record what is rendered.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{Appearance, AppearanceContext, AppearancePlugin, Plugin, Result, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct Identity;

impl Appearance for Identity {
    fn apply(&self, planes: Tensor<3>, _camera: Option<usize>) -> Result<Tensor<3>> {
        Ok(planes)
    }
}

fn build(section: &toml::Table, _context: &AppearanceContext, _device: &Device) -> Result<Box<dyn Appearance>> {
    let NoSettings {} = config::parse_section("appearance none", section)?;
    Ok(Box::new(Identity))
}

inventory::submit! {
    AppearancePlugin {
        info: Plugin {
            name: "none",
            version: "1",
            summary: "no appearance model: all cameras record the rendered colours as they are",
            paper: "",
            schema: "# no settings\n",
            capabilities: &[],
        },
        build,
    }
}
