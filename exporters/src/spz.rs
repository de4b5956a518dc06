//! `spz`: Niantic's SPZ. The file itself is [`cc4dgs_format::spz`].

use crate::still;
use cc4dgs_format::spz::{SpzOptions, remarks, to_spz};
use cc4dgs_format::{ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, Plugin, Result, config, inventory};
use serde::Deserialize;
use std::path::Path;

const SCHEMA: &str = "\
version = 4              # of the file: 4, or 3 for older readers
sh1_bits = 8             # bits per spherical-harmonics coefficient of degree 1, 1 to 8 (Niantic's own writer: 5)
sh_rest_bits = 8         # bits per coefficient of higher degrees, 1 to 8 (Niantic's own writer: 4)
";

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Spz {
    version: u32,
    sh1_bits: u8,
    sh_rest_bits: u8,
}

impl Default for Spz {
    fn default() -> Self {
        Self { version: 4, sh1_bits: 8, sh_rest_bits: 8 }
    }
}

impl Spz {
    fn options(&self) -> SpzOptions {
        SpzOptions { version: self.version, sh1_bits: self.sh1_bits, sh_rest_bits: self.sh_rest_bits, antialiased: false, usual_fraction: true }
    }
}

impl Exporter for Spz {
    fn loses(&self, facts: &ExportFacts) -> String {
        let (has_four, lost) = still::highest_degree(facts);
        let refused = format!("{lost} (some refuse files of version 3 that have them)");
        let four = (has_four, if self.version == 3 { refused.as_str() } else { lost });
        still::sentence(facts, &[(true, "background"), (true, "dynamic scores"), (true, "all but 8 bits of colours, opacities and scales"), four])
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let gaussians = still::instant(source, "SPZ", 2)?;
        let options = SpzOptions { antialiased: source.facts().antialiased, ..self.options() };
        let file = to_spz(&gaussians, &options)?;
        source.progress(2, 2)?;
        still::write(path, &file)?;
        let notes = [vec![format!("SPZ version {}", self.version)], remarks(&gaussians, &options)].concat();
        Ok(Exported { gaussians: gaussians.len(), sh_degree: gaussians.sh_degree, frames: 1, notes })
    }
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    let spz: Spz = config::parse_section("exporter spz", settings)?;
    // What cannot be written is refused before a model is loaded.
    to_spz(&Default::default(), &spz.options())?;
    Ok(Box::new(spz))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "spz",
            version: "4",
            summary: "Niantic's SPZ, versions 4 and 3",
            paper: "SPZ (Niantic Labs 2024), file format",
            schema: SCHEMA,
            capabilities: &["still"],
        },
        target: ExportTarget::File("spz"),
        build,
    }
}
