//! `splatv`: moving Gaussians for splaTV and gsplat.js, 64 bytes each.
//!
//! A centre follows a cubic in t - c, a rotation is linear in it, and the opacity is that of the file times exp(-((t - c) / s)²). Motion is fitted to samples
//! of the model ([`fit`]); t runs from 0 to 1. The Gaussians fill the rows of a texture of 4096 texels with four texels each.

mod fit;

use crate::still::{self, byte, color_bytes, sigmoid, unit};
use cc4dgs_format::{
    Camera, Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, HostGaussians, Plugin, Result, config, inventory,
};
use fit::{Motion, Samples};
use half::f16;
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;

const SCHEMA: &str = "\
samples = 24             # instants from 0 to 1 that the motion is fitted to
";
const MAGIC: u32 = 0x674b;
/// Texels per row; a Gaussian takes four.
const TEXTURE_WIDTH: usize = 4096;
const TEXELS: usize = 4;
/// Bytes per Gaussian.
const BYTES: usize = 64;

#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Splatv {
    samples: usize,
}

impl Default for Splatv {
    fn default() -> Self {
        Self { samples: 24 }
    }
}

impl Exporter for Splatv {
    fn loses(&self, facts: &ExportFacts) -> String {
        let motion = if facts.moving > 0 { "motion is one cubic per Gaussian and opacity one bell over time, " } else { "" };
        let harmonics = if facts.sh_degree > 0 { ", colours are the same from every side" } else { "" };
        let blur = facts.lost_blur().map_or_else(String::new, |blur| format!(", {blur}"));
        format!("In splatV {motion}rotations and scales have 11 bits, colours and opacities 8{harmonics}, and background{blur} and dynamic scores are lost.")
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let facts = source.facts().clone();
        // Players run from 0 to 1, whatever the times of the frames are.
        let count = if facts.moving > 0 { self.samples } else { 1 };
        let times: Vec<f32> = (0..count).map(|i| i as f32 / (count - 1).max(1) as f32).collect();
        let mut samples = Samples::new(facts.moving);
        let mut still = None;
        for (done, time) in times.iter().enumerate() {
            let gaussians = source.gaussians(Some(*time))?;
            still::check(&gaussians, "splatV")?;
            samples.add(*time, &gaussians)?;
            still.get_or_insert(gaussians);
            source.progress(done + 1, times.len())?;
        }
        let mut gaussians = still.unwrap_or_default();
        let motions = samples.fit(&mut gaussians);
        let mut notes = Vec::new();
        if facts.moving > 0 {
            let (mean, most) = fit::errors(&motions);
            notes.push(format!(
                "motion fitted to {} instants: centres differ by {mean:.2e} on average, {most:.2e} at most, in units of the dataset",
                times.len()
            ));
        }
        still::write(path, &to_bytes(&gaussians, &motions, facts.home.as_ref())?)?;
        Ok(Exported { gaussians: gaussians.len(), sh_degree: 0, frames: times.len(), notes })
    }
}

/// The file: a magic number, a description in JSON, and the texture.
fn to_bytes(gaussians: &HostGaussians, motions: &[Motion], home: Option<&Camera>) -> Result<Vec<u8>> {
    let per_row = TEXTURE_WIDTH / TEXELS;
    let rows = gaussians.len().div_ceil(per_row).max(1);
    let size = rows * per_row * BYTES;
    let Ok(_) = u32::try_from(size) else {
        return Err(Error::limit("splatV texture", size as u64, u64::from(u32::MAX), "Prune the model"));
    };
    let cameras: Vec<Value> = home.iter().map(|camera| camera_json(camera)).collect();
    let description = json!([{ "type": "splat", "size": size, "texwidth": TEXTURE_WIDTH, "texheight": rows, "cameras": cameras }]).to_string();
    let mut out = Vec::with_capacity(8 + description.len() + size);
    out.extend(MAGIC.to_le_bytes());
    out.extend((description.len() as u32).to_le_bytes());
    out.extend(description.bytes());
    let resting = Motion::resting();
    for row in 0..gaussians.len() {
        record(&mut out, gaussians, row, motions.get(row).unwrap_or(&resting));
    }
    out.resize(8 + description.len() + size, 0);
    Ok(out)
}

/// The 64 bytes of a Gaussian.
fn record(out: &mut Vec<u8>, gaussians: &HostGaussians, row: usize, motion: &Motion) {
    let halves = |out: &mut Vec<u8>, values: &[f32]| values.iter().for_each(|v| out.extend(half_bits(*v).to_le_bytes()));
    let rotation = gaussians.quaternions.as_chunks::<4>().0[row];
    let drawn = unit(&rotation);
    gaussians.means[3 * row..3 * row + 3].iter().for_each(|v| out.extend(v.to_le_bytes()));
    halves(out, &drawn.unwrap_or([1.0, 0.0, 0.0, 0.0]));
    let scales = gaussians.log_scales.as_chunks::<3>().0[row].map(f32::exp);
    halves(out, &[scales[0], scales[1], scales[2], 0.0]);
    out.extend(color_bytes(&gaussians.sh_dc.as_chunks::<3>().0[row]));
    // A rotation of length zero is not drawn.
    out.push(if drawn.is_some() { byte(sigmoid(gaussians.opacity_logits[row])) } else { 0 });
    halves(out, motion.powers.as_flattened());
    halves(out, &[0.0]);
    halves(out, &motion.turn);
    halves(out, &[motion.center, motion.width]);
}

/// The nearest half float; magnitudes over the range become the largest.
fn half_bits(value: f32) -> u16 {
    f16::from_f32(value.clamp(-65504.0, 65504.0)).to_bits()
}

/// A camera as in the `cameras.json` of 3DGS: position, and the rotation from the camera to the world by rows.
fn camera_json(camera: &Camera) -> Value {
    let m = &camera.world_to_camera;
    let rotation: [[f64; 3]; 3] = std::array::from_fn(|row| std::array::from_fn(|column| m[column][row]));
    json!({
        "id": 0,
        "img_name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.center_world(),
        "rotation": rotation,
        "fx": camera.fx,
        "fy": camera.fy,
    })
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    let splatv: Splatv = config::parse_section("exporter splatv", settings)?;
    if !(1..=256).contains(&splatv.samples) {
        return Err(Error::parameter("exporter splatv", format!("{} samples", splatv.samples), "Give 1 to 256"));
    }
    Ok(Box::new(splatv))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "splatv",
            version: "1",
            summary: "moving Gaussians for splaTV and gsplat.js",
            paper: "splaTV (Kwok 2024), file format of Spacetime Gaussians (Li et al. 2024)",
            schema: SCHEMA,
            capabilities: &["motion", "camera"],
        },
        target: ExportTarget::File("splatv"),
        build,
    }
}
