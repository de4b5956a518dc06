//! Writes a small synthetic model that moves in every format of this crate, for checks with programs of others: `sample FOLDER`.

use cc4dgs_exporters as _;
use cc4dgs_format::conformance::MovingModel;
use cc4dgs_format::exporter::export;
use cc4dgs_format::{Entries, Error, ExportTarget, ExporterPlugin, Result};
use std::path::Path;

/// Gaussians, and the degree of their harmonics.
const GAUSSIANS: usize = 2000;
const DEGREE: usize = 3;

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).ok_or_else(|| Error::parameter("sample", "no folder", "Name the folder to write to"))?;
    // A page holds an archive, which the synthetic model is not.
    for plugin in Entries::<ExporterPlugin>::collect()?.iter().filter(|p| !p.info.capabilities.contains(&"player")) {
        let name = match plugin.target {
            ExportTarget::File(extension) | ExportTarget::FileOrFolder { file: extension, .. } => format!("sample.{extension}"),
            ExportTarget::Folder(_) => plugin.info.name.to_string(),
        };
        let exporter = (plugin.build)(&toml::Table::new())?;
        let mut model = MovingModel::new(GAUSSIANS, DEGREE);
        export(exporter.as_ref(), plugin.target, &mut model, &Path::new(&folder).join(name), true)?;
    }
    Ok(())
}
