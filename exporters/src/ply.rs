//! `ply`: one PLY in the layout of 3D Gaussian splatting.

use crate::still;
use cc4dgs_format::ply::{PlyOptions, to_bytes_with};
use cc4dgs_format::{ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, Plugin, Result, config, inventory};
use serde::Deserialize;
use std::path::Path;

const SCHEMA: &str = "\
dynamic = true           # write the dynamic scores as a 63rd property; false for viewers that insist on the 62 of static 3DGS
";

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Ply {
    dynamic: bool,
}

impl Default for Ply {
    fn default() -> Self {
        Self { dynamic: true }
    }
}

impl Exporter for Ply {
    fn loses(&self, facts: &ExportFacts) -> String {
        still::sentence(facts, &[(true, "background"), (!self.dynamic, "dynamic scores"), still::highest_degree(facts)])
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let gaussians = still::with_rotations(still::instant(source, "PLY", 1)?);
        still::write(path, &to_bytes_with(&gaussians, &PlyOptions { dynamic: self.dynamic, antialiased: source.facts().antialiased })?)?;
        Ok(Exported { gaussians: gaussians.len(), sh_degree: gaussians.sh_degree, frames: 1, notes: Vec::new() })
    }
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    Ok(Box::new(config::parse_section::<Ply>("exporter ply", settings)?))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "ply",
            version: "1",
            summary: "PLY in the layout of 3D Gaussian splatting",
            paper: "3D Gaussian Splatting for Real-Time Radiance Field Rendering (Kerbl et al. 2023)",
            schema: SCHEMA,
            capabilities: &["still"],
        },
        target: ExportTarget::File("ply"),
        build,
    }
}
