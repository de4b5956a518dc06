//! No pose model: training cameras stand where the dataset says.

use burn::tensor::Device;
use cc4dgs_core::{Camera, Plugin, Posed, Poses, PosesContext, PosesPlugin, Result, config, inventory};
use serde::Deserialize;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoSettings {}

struct AsRecorded;

impl Poses for AsRecorded {
    fn corrected(&self, _camera: &Camera, _index: usize) -> Result<Option<Posed>> {
        Ok(None)
    }
}

fn build(section: &toml::Table, _context: &PosesContext, _device: &Device) -> Result<Box<dyn Poses>> {
    let NoSettings {} = config::parse_section("poses none", section)?;
    Ok(Box::new(AsRecorded))
}

inventory::submit! {
    PosesPlugin {
        info: Plugin {
            name: "none",
            version: "1",
            summary: "no pose model: training cameras have the poses of the dataset",
            paper: "",
            schema: "# no settings\n",
            capabilities: &[],
        },
        build,
    }
}
