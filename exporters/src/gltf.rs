//! `gltf`: binary glTF 2.0 with the Khronos extension `KHR_gaussian_splatting`. Programs that do not know it show coloured points.
//!
//! Attributes keep the values and axes of the model; a rotation of the node brings its upward axis to glTF's +y.

use crate::still::{self, byte, color, sigmoid, unit};
use cc4dgs_format::{Error, ExportFacts, ExportSource, ExportTarget, Exported, Exporter, ExporterPlugin, HostGaussians, Plugin, Result, config, inventory};
use serde::Deserialize;
use serde_json::{Value, json};
use std::path::Path;

const SCHEMA: &str = "# no settings\n";
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Highest degree of harmonics of the extension.
const HIGHEST_DEGREE: usize = 3;
// glTF's numbers for component types, buffer targets, primitives and chunks.
const FLOAT: u32 = 5126;
const UNSIGNED_BYTE: u32 = 5121;
const ARRAY_BUFFER: u32 = 34962;
const POINTS: u32 = 0;
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BINARY_CHUNK: u32 = 0x004e_4942;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Gltf {}

impl Exporter for Gltf {
    fn loses(&self, facts: &ExportFacts) -> String {
        let parts = [
            (facts.sh_degree > HIGHEST_DEGREE, "harmonics over degree 3"),
            (true, "background"),
            (true, "dynamic scores"),
            (facts.antialiased, "the mark of the 2D filter that the model was trained with"),
        ];
        still::sentence(facts, &parts)
    }
    fn write(&self, source: &mut dyn ExportSource, path: &Path) -> Result<Exported> {
        let gaussians = still::instant(source, "glTF", 1)?;
        still::write(path, &to_glb(&gaussians, source.facts().up)?)?;
        Ok(Exported { gaussians: gaussians.len(), sh_degree: gaussians.sh_degree.min(HIGHEST_DEGREE), frames: 1, notes: Vec::new() })
    }
}

/// The arrays of a GLB and their descriptions.
#[derive(Default)]
struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
    attributes: serde_json::Map<String, Value>,
}

impl Buffer {
    /// Adds the array of an attribute, `count` elements of `kind`; `more` goes into its accessor.
    fn add(&mut self, name: &str, kind: &str, component: u32, count: usize, bytes: impl IntoIterator<Item = u8>, more: Value) {
        let start = self.bytes.len();
        self.bytes.extend(bytes);
        self.views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": self.bytes.len() - start, "target": ARRAY_BUFFER }));
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let mut accessor = json!({ "bufferView": self.views.len() - 1, "componentType": component, "count": count, "type": kind });
        if let (Some(accessor), Value::Object(more)) = (accessor.as_object_mut(), more) {
            accessor.extend(more);
        }
        self.accessors.push(accessor);
        self.attributes.insert(name.into(), (self.accessors.len() - 1).into());
    }
    fn floats(&mut self, name: &str, kind: &str, count: usize, values: impl IntoIterator<Item = f32>, more: Value) {
        self.add(name, kind, FLOAT, count, values.into_iter().flat_map(f32::to_le_bytes), more);
    }
}

/// A GLB of `gaussians` whose axis `up` points up.
fn to_glb(gaussians: &HostGaussians, up: [f64; 3]) -> Result<Vec<u8>> {
    let count = gaussians.len();
    let refuse = |problem: String, remedy: &str| Err(Error::data("Gaussians to write as glTF", problem, remedy));
    if count == 0 {
        return refuse("there are none, and glTF has no empty arrays".into(), "Export another format, or another model");
    }
    if let Some(log) = gaussians.log_scales.iter().find(|log| !log.exp().is_finite()) {
        return refuse(format!("a scale of exp({log}) is over the float range"), "Remove far outliers");
    }
    let mut buffer = Buffer::default();
    let means = gaussians.means.as_chunks::<3>().0;
    let corner = |pick: fn(f32, f32) -> f32| -> [f32; 3] { means.iter().skip(1).fold(means[0], |a, p| std::array::from_fn(|k| pick(a[k], p[k]))) };
    buffer.floats("POSITION", "VEC3", count, gaussians.means.iter().copied(), json!({ "min": corner(f32::min), "max": corner(f32::max) }));
    let rotations: Vec<Option<[f32; 4]>> = gaussians.quaternions.as_chunks::<4>().0.iter().map(unit).collect();
    // A rotation of length zero is not drawn.
    let opacities: Vec<f32> = gaussians.opacity_logits.iter().zip(&rotations).map(|(o, q)| if q.is_some() { sigmoid(*o) } else { 0.0 }).collect();
    let colors = gaussians.sh_dc.as_chunks::<3>().0.iter().zip(&opacities).flat_map(|(dc, o)| {
        let [r, g, b] = color(dc).map(|v| byte(linear(v)));
        [r, g, b, byte(*o)]
    });
    buffer.add("COLOR_0", "VEC4", UNSIGNED_BYTE, count, colors.collect::<Vec<_>>(), json!({ "normalized": true }));
    let xyzw = rotations.iter().flat_map(|q| q.map_or([0.0, 0.0, 0.0, 1.0], |[w, x, y, z]| [x, y, z, w]));
    buffer.floats(&format!("{EXTENSION}:ROTATION"), "VEC4", count, xyzw, json!({}));
    buffer.floats(&format!("{EXTENSION}:SCALE"), "VEC3", count, gaussians.log_scales.iter().map(|s| s.exp()), json!({}));
    buffer.floats(&format!("{EXTENSION}:OPACITY"), "SCALAR", count, opacities, json!({}));
    buffer.floats(&format!("{EXTENSION}:SH_DEGREE_0_COEF_0"), "VEC3", count, gaussians.sh_dc.iter().copied(), json!({}));
    let stored = cc4dgs_format::gaussians::sh_rest_len(gaussians.sh_degree);
    for degree in 1..=gaussians.sh_degree.min(HIGHEST_DEGREE) {
        for order in 0..2 * degree + 1 {
            let k = degree * degree - 1 + order;
            let values = (0..count).flat_map(|i| (0..3).map(move |c| (i * stored + k) * 3 + c)).map(|at| gaussians.sh_rest[at]);
            buffer.floats(&format!("{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"), "VEC3", count, values, json!({}));
        }
    }
    let primitive = json!({
        "attributes": buffer.attributes,
        "mode": POINTS,
        "extensions": { EXTENSION: { "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance", "projection": "perspective" } },
    });
    let document = json!({
        "asset": { "version": "2.0", "generator": concat!("cc4dgs ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0, "rotation": to_y_up(up) }],
        "meshes": [{ "primitives": [primitive] }],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{ "byteLength": buffer.bytes.len() }],
    });
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let length = 12 + 8 + text.len() + 8 + buffer.bytes.len();
    let Ok(total) = u32::try_from(length) else {
        return Err(Error::limit("GLB", length as u64, u64::from(u32::MAX), "Prune the model, or export PLY"));
    };
    let mut out = Vec::with_capacity(length);
    out.extend(b"glTF");
    out.extend([2, total, text.len() as u32, JSON_CHUNK].into_iter().flat_map(u32::to_le_bytes));
    out.extend(text);
    out.extend([buffer.bytes.len() as u32, BINARY_CHUNK].into_iter().flat_map(u32::to_le_bytes));
    out.extend(buffer.bytes);
    Ok(out)
}

/// Light of a value of sRGB: glTF's vertex colours, which programs without the extension show, are linear.
fn linear(srgb: f32) -> f32 {
    if srgb <= 0.040_45 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
}

/// The rotation (x,y,z,w) that takes the axis `up` to +y.
fn to_y_up([x, y, z]: [f64; 3]) -> [f64; 4] {
    if y <= -1.0 {
        return [1.0, 0.0, 0.0, 0.0];
    }
    // The cross product of `up` and y, and one plus their dot product.
    let q = [-z, 0.0, x, 1.0 + y];
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| v / norm)
}

pub(crate) fn build(settings: &toml::Table) -> Result<Box<dyn Exporter>> {
    Ok(Box::new(config::parse_section::<Gltf>("exporter gltf", settings)?))
}

inventory::submit! {
    ExporterPlugin {
        info: Plugin {
            name: "gltf",
            version: "2.0",
            summary: "binary glTF with KHR_gaussian_splatting",
            paper: "KHR_gaussian_splatting (Khronos Group 2025), extension of glTF 2.0",
            schema: SCHEMA,
            capabilities: &["still", "up"],
        },
        target: ExportTarget::File("glb"),
        build,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_of_plain_points_are_linear() {
        let gaussians = HostGaussians {
            means: vec![0.0; 3],
            log_scales: vec![0.0; 3],
            quaternions: vec![1.0, 0.0, 0.0, 0.0],
            opacity_logits: vec![0.0],
            sh_dc: [-0.1f32, 0.5, 0.8].map(|srgb| (srgb - 0.5) / 0.282_094_8).to_vec(),
            dynamic_scores: vec![0.0],
            ..Default::default()
        };
        let glb = to_glb(&gaussians, [0.0, 1.0, 0.0]).unwrap();
        let length = u32::from_le_bytes([glb[12], glb[13], glb[14], glb[15]]) as usize;
        let document: Value = serde_json::from_slice(&glb[20..20 + length]).unwrap();
        let index = |value: &Value| value.as_u64().unwrap() as usize;
        let accessor = &document["accessors"][index(&document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])];
        let at = 20 + length + 8 + index(&document["bufferViews"][index(&accessor["bufferView"])]["byteOffset"]);
        assert_eq!(glb[at..at + 4], [0, 55, 154, 128]);
    }

    #[test]
    fn every_axis_is_brought_up() {
        for up in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]] {
            let [x, y, z, w]: [f64; 4] = to_y_up(up);
            assert!((x * x + y * y + z * z + w * w - 1.0).abs() < 1e-12);
            // v + 2 u x (u x v + w v)
            let cross = |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            let u = [x, y, z];
            let inner = cross(u, up);
            let outer = cross(u, std::array::from_fn(|k| inner[k] + w * up[k]));
            let turned: [f64; 3] = std::array::from_fn(|k| up[k] + 2.0 * outer[k]);
            assert!(turned.iter().zip([0.0, 1.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-12), "{up:?} becomes {turned:?}");
        }
    }
}
