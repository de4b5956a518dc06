//! `csv`: a table of the Gaussians at one instant, for spreadsheets and plots. One line per Gaussian, under a line with the names of the columns.

use cc4dgs_core::serde::{self, Deserialize};
use cc4dgs_core::{
    Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, HostGaussians, Limits, Plugin, Result, config, inventory, plural, toml,
};
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

/// Scales are standard deviations, quaternions are not normalised, opacities are in 0..1. Colours are those of degree 0 and may lie outside of 0..1.
const HEADER: &str = "x,y,z,scale_x,scale_y,scale_z,qw,qx,qy,qz,opacity,red,green,blue";
/// 1 / (2 sqrt(pi)), the constant basis function of spherical harmonics.
const SH_C0: f32 = 0.282_094_8;
/// Names the model in errors.
const OBJECT: &str = "Gaussians to write as CSV";

#[derive(Default, Deserialize)]
#[serde(crate = "self::serde", default, deny_unknown_fields)]
struct Csv {
    min_opacity: f32,
}

impl Exporter for Csv {
    fn loses(&self, facts: &ExportFacts) -> String {
        let parts = [
            (facts.sh_degree > 0).then(|| "harmonics over degree 0".to_string()),
            (self.min_opacity > 0.0).then(|| format!("Gaussians of an opacity below {}", self.min_opacity)),
            facts.antialiased.then(|| "the mark of the 2D filter".to_string()),
            facts.lost_blur(),
        ];
        let lost: String = parts.iter().flatten().map(|part| format!("{part}, ")).collect();
        format!("{}, without {lost}background and dynamic scores.", facts.still())
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let time_norm = source.facts().time_norm;
        let gaussians = source.gaussians(time_norm)?;
        // A table has no largest size, but a value that is not finite is no number to other programs.
        gaussians.validate(OBJECT, &Limits { max_gaussians: u64::MAX, ..Limits::default() })?;
        source.progress(1, 1)?;
        // `path` is a temporary name: what an error leaves half written is removed by the caller.
        let failed = |e| Error::io(path, e);
        let mut table = BufWriter::new(File::create(path).map_err(failed)?);
        writeln!(table, "{HEADER}").map_err(failed)?;
        let mut written = 0;
        for index in (0..gaussians.len()).filter(|&i| sigmoid(gaussians.opacity_logits[i]) >= self.min_opacity) {
            // Every number has the digits that give the same float32 back.
            let line = row(&gaussians, index)?.map(|value| value.to_string()).join(",");
            writeln!(table, "{line}").map_err(failed)?;
            written += 1;
        }
        table.flush().map_err(failed)?;
        let left_out = gaussians.len() - written;
        let [noun, were] = [plural(left_out, "Gaussian", "Gaussians"), plural(left_out, "was", "were")];
        let note = (left_out > 0).then(|| format!("{left_out} {noun} of an opacity below {} {were} left out", self.min_opacity));
        Ok(Exported { gaussians: written, sh_degree: 0, frames: 1, notes: note.into_iter().collect() })
    }
}

/// The numbers of the Gaussian `index`, in the order of [`HEADER`].
fn row(gaussians: &HostGaussians, index: usize) -> Result<[f32; 14]> {
    let of = |values: &[f32]| values.as_chunks::<3>().0[index];
    let log_scales = of(&gaussians.log_scales);
    let scales = log_scales.map(f32::exp);
    if !scales.iter().all(|scale| scale.is_finite()) {
        return Err(Error::data(OBJECT, format!("Gaussian {index} has log-scales of {log_scales:?}, too large for float32 scales"), "Remove far outliers"));
    }
    let ([x, y, z], [scale_x, scale_y, scale_z]) = (of(&gaussians.means), scales);
    let [qw, qx, qy, qz] = gaussians.quaternions.as_chunks::<4>().0[index];
    let [red, green, blue] = of(&gaussians.sh_dc).map(|coefficient| SH_C0 * coefficient + 0.5);
    Ok([x, y, z, scale_x, scale_y, scale_z, qw, qx, qy, qz, sigmoid(gaussians.opacity_logits[index]), red, green, blue])
}

/// Opacity in 0..1.
fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    let csv: Csv = config::parse_section("exporter csv", settings)?;
    if !(0.0..=1.0).contains(&csv.min_opacity) {
        return Err(Error::parameter("exporter csv: min_opacity", format!("{} is no opacity", csv.min_opacity), "Give 0 to 1"));
    }
    Ok(Box::new(csv))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "csv",
            version: "1",
            summary: "a table of centres, scales, rotations, opacities and colours",
            paper: "an example",
            schema: "min_opacity = 0.0        # 0 to 1; Gaussians of less opacity are left out\n",
            capabilities: &["still"],
        },
        target: ExportTarget::File("csv"),
        build,
    }
}
