//! `ply-sequence`: one PLY per frame, as players of sequences read them: `name_0000.ply`, `name_0001.ply` and on.

use crate::still;
use cc4dgs_format::ply::{PlyOptions, to_bytes_with};
use cc4dgs_format::{ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, Plugin, Result, config, inventory};
use serde::Deserialize;
use std::path::Path;

const SCHEMA: &str = "# no settings; the number of frames is an option of the command\n";

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlySequence {}

impl Exporter for PlySequence {
    fn loses(&self, facts: &ExportFacts) -> String {
        let frames = facts.times_norm.len();
        let blur = facts.lost_blur().map_or_else(String::new, |blur| format!(", {blur}"));
        let (applies, part) = still::highest_degree(facts);
        let degree = if applies { format!(", {part}") } else { String::new() };
        let held = if frames == 1 { "1 frame".to_string() } else { format!("{frames} frames and nothing between them") };
        format!("It holds {held}, without times, background{blur}{degree} and dynamic scores.")
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let facts = source.facts().clone();
        let options = PlyOptions { dynamic: false, antialiased: facts.antialiased };
        // As many digits as the last frame needs, so that names sort in the order of time.
        let digits = (facts.times_norm.len().max(1) - 1).to_string().len().max(4);
        let mut written = Exported::default();
        for (index, time) in facts.times_norm.iter().enumerate() {
            let gaussians = source.gaussians(Some(*time))?;
            // Before rotations that are no numbers are taken for some that are not drawn.
            still::check(&gaussians, "PLY")?;
            let gaussians = still::with_rotations(gaussians);
            still::write(&path.join(format!("{}_{index:0digits$}.ply", facts.name)), &to_bytes_with(&gaussians, &options)?)?;
            written = Exported { gaussians: gaussians.len(), sh_degree: gaussians.sh_degree, frames: index + 1, notes: Vec::new() };
            source.progress(index + 1, facts.times_norm.len())?;
        }
        Ok(written)
    }
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    Ok(Box::new(config::parse_section::<PlySequence>("exporter ply-sequence", settings)?))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "ply-sequence",
            version: "1",
            summary: "a folder with one PLY per frame",
            paper: "3D Gaussian Splatting for Real-Time Radiance Field Rendering (Kerbl et al. 2023)",
            schema: SCHEMA,
            capabilities: &["motion", "frames"],
        },
        target: ExportTarget::Folder(&["*.ply"]),
        build,
    }
}
