//! Readers of the exported formats, written from their descriptions and apart from the writers.

use cc4dgs::{HostGaussians, Limits};
use cc4dgs_core::{ply, spz};
use half::f16;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// The Gaussians of a PLY, SPZ, GLB or SOG file.
pub fn any(path: &Path) -> HostGaussians {
    let bytes = std::fs::read(path).unwrap();
    match path.extension().and_then(|e| e.to_str()).unwrap() {
        "ply" => ply::from_bytes("t", &bytes, &Limits::default()).unwrap().gaussians,
        "spz" => spz::from_spz("t", &bytes, &Limits::default()).unwrap().gaussians,
        "glb" => glb(&bytes),
        "sog" => sog(&bytes),
        other => panic!("{other}"),
    }
}

fn logit(opacity: f32) -> f32 {
    let opacity = opacity.clamp(1e-6, 1.0 - 1e-6);
    (opacity / (1.0 - opacity)).ln()
}

/// Harmonics of degree 0 to 3 that have so many coefficients per colour above degree 0.
fn degree_of(coefficients: usize) -> usize {
    [0, 3, 8, 15].iter().position(|c| *c == coefficients).unwrap()
}

fn glb(bytes: &[u8]) -> HostGaussians {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!((&bytes[..4], word(4), word(8)), (&b"glTF"[..], 2, bytes.len()));
    let json: Value = serde_json::from_slice(&bytes[20..20 + word(12)]).unwrap();
    let binary = 20 + word(12) + 8;
    let primitive = &json["meshes"][0]["primitives"][0];
    assert_eq!((&primitive["mode"], &json["extensionsUsed"][0]), (&Value::from(0), &Value::from("KHR_gaussian_splatting")));
    let floats = |name: &str| -> Option<Vec<f32>> {
        let accessor = &json["accessors"][primitive["attributes"].get(name)?.as_u64().unwrap() as usize];
        assert_eq!(accessor["componentType"], 5126, "{name}");
        let view = &json["bufferViews"][accessor["bufferView"].as_u64().unwrap() as usize];
        let (start, length) = (view["byteOffset"].as_u64().unwrap() as usize, view["byteLength"].as_u64().unwrap() as usize);
        let width = match accessor["type"].as_str().unwrap() {
            "SCALAR" => 1,
            "VEC3" => 3,
            _ => 4,
        };
        assert_eq!(length as u64, 4 * width * accessor["count"].as_u64().unwrap());
        Some(bytes[binary + start..binary + start + length].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
    };
    let of = |name: &str| floats(&format!("KHR_gaussian_splatting:{name}"));
    let means = floats("POSITION").unwrap();
    let count = means.len() / 3;
    let mut coefficients = Vec::new();
    for degree in 1..=3 {
        coefficients.extend((0..2 * degree + 1).filter_map(|k| of(&format!("SH_DEGREE_{degree}_COEF_{k}"))));
    }
    let sh_rest = (0..count).flat_map(|i| coefficients.iter().flat_map(move |c| c[3 * i..3 * i + 3].to_vec())).collect();
    let xyzw = of("ROTATION").unwrap();
    HostGaussians {
        sh_degree: degree_of(coefficients.len()),
        means,
        log_scales: of("SCALE").unwrap().iter().map(|s| s.ln()).collect(),
        quaternions: xyzw.as_chunks::<4>().0.iter().flat_map(|[x, y, z, w]| [*w, *x, *y, *z]).collect(),
        opacity_logits: of("OPACITY").unwrap().iter().map(|o| logit(*o)).collect(),
        sh_dc: of("SH_DEGREE_0_COEF_0").unwrap(),
        sh_rest,
        dynamic_scores: vec![0.0; count],
        ..Default::default()
    }
}

/// Pixels of a lossless WebP as RGBA.
fn pixels(file: &[u8]) -> Vec<[u8; 4]> {
    let mut decoder = image_webp::WebPDecoder::new(std::io::Cursor::new(file)).unwrap();
    assert!(!decoder.is_lossy());
    let (alpha, mut data) = (decoder.has_alpha(), vec![0; decoder.output_buffer_size().unwrap()]);
    decoder.read_image(&mut data).unwrap();
    data.chunks_exact(if alpha { 4 } else { 3 }).map(|p| [p[0], p[1], p[2], if alpha { p[3] } else { 255 }]).collect()
}

fn sog(bytes: &[u8]) -> HostGaussians {
    let files: BTreeMap<String, Vec<u8>> = cc4dgs::exporters::sog::stored(bytes).unwrap().into_iter().collect();
    let meta: Value = serde_json::from_slice(&files["meta.json"]).unwrap();
    assert_eq!(meta["version"], 2);
    let count = meta["count"].as_u64().unwrap() as usize;
    let image = |section: &str, k: usize| pixels(&files[meta[section]["files"][k].as_str().unwrap()]);
    let numbers = |value: &Value| -> Vec<f32> { value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap() as f32).collect() };
    let (low, high) = (image("means", 0), image("means", 1));
    let (mins, maxs) = (numbers(&meta["means"]["mins"]), numbers(&meta["means"]["maxs"]));
    let mean = |i: usize, k: usize| {
        let code = f32::from(low[i][k]) + 256.0 * f32::from(high[i][k]);
        let log = mins[k] + (maxs[k] - mins[k]) * code / 65535.0;
        log.signum() * log.abs().exp_m1()
    };
    let indexed = |section: &str| -> Vec<[f32; 3]> {
        let book = numbers(&meta[section]["codebook"]);
        image(section, 0).iter().take(count).map(|p| [0, 1, 2].map(|k| book[usize::from(p[k])])).collect()
    };
    let quaternion = |p: [u8; 4]| -> [f32; 4] {
        let missing = usize::from(p[3] - 252);
        let mut q = [0.0f32; 4];
        for (k, v) in (0..4).filter(|k| *k != missing).zip(p) {
            q[k] = (f32::from(v) / 255.0 - 0.5) * std::f32::consts::SQRT_2;
        }
        q[missing] = (1.0 - q.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
        q
    };
    let mut out = HostGaussians {
        means: (0..count).flat_map(|i| [0, 1, 2].map(|k| mean(i, k))).collect(),
        log_scales: indexed("scales").concat(),
        quaternions: image("quats", 0).iter().take(count).flat_map(|p| quaternion(*p)).collect(),
        opacity_logits: image("sh0", 0).iter().take(count).map(|p| logit(f32::from(p[3]) / 255.0)).collect(),
        sh_dc: indexed("sh0").concat(),
        dynamic_scores: vec![0.0; count],
        ..Default::default()
    };
    if let Some(bands) = meta["shN"]["bands"].as_u64() {
        let coefficients = [0, 3, 8, 15][bands as usize];
        let (book, palette, labels) = (numbers(&meta["shN"]["codebook"]), image("shN", 0), image("shN", 1));
        out.sh_degree = bands as usize;
        for label in labels.iter().take(count) {
            let entry = usize::from(label[0]) + 256 * usize::from(label[1]);
            let start = (entry / 64) * 64 * coefficients + (entry % 64) * coefficients;
            out.sh_rest.extend(palette[start..start + coefficients].iter().flat_map(|p| [0, 1, 2].map(|k| book[usize::from(p[k])])));
        }
    }
    out
}

/// The Gaussians of a splatV file at `time`.
pub fn splatv(path: &Path, time: f32) -> HostGaussians {
    let bytes = std::fs::read(path).unwrap();
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
    assert_eq!(word(0), 0x674b);
    let json: Value = serde_json::from_slice(&bytes[8..8 + word(4) as usize]).unwrap();
    let chunk = &json[0];
    let body = &bytes[8 + word(4) as usize..];
    assert_eq!(chunk["size"].as_u64().unwrap() as usize, body.len());
    assert_eq!(chunk["texheight"].as_u64().unwrap() * 4096 * 16, body.len() as u64);
    assert!(chunk["cameras"][0]["position"][2].is_number());
    let mut out = HostGaussians::default();
    for record in body.as_chunks::<64>().0 {
        let float = |at: usize| f32::from_le_bytes(record[at..at + 4].try_into().unwrap());
        let half = |at: usize| f16::from_le_bytes([record[at], record[at + 1]]).to_f32();
        let dt = time - half(60);
        let alpha = f32::from(record[31]) / 255.0 * (-(dt / half(62)).powi(2)).exp();
        // Rows are filled with zeros.
        if record.iter().all(|b| *b == 0) {
            continue;
        }
        out.means.extend((0..3).map(|k| float(4 * k) + half(32 + 2 * k) * dt + half(38 + 2 * k) * dt * dt + half(44 + 2 * k) * dt * dt * dt));
        out.quaternions.extend((0..4).map(|k| half(12 + 2 * k) + half(52 + 2 * k) * dt));
        out.log_scales.extend((0..3).map(|k| half(20 + 2 * k).ln()));
        out.sh_dc.extend((0..3).map(|k| (f32::from(record[28 + k]) / 255.0 - 0.5) / 0.282_094_8));
        out.opacity_logits.push(logit(alpha));
        out.dynamic_scores.push(0.0);
    }
    out
}
