//! K-means and mu-law compared with scikit-learn and torchaudio.

use cc4dgs_codecs::kmeans;
use cc4dgs_core::Seed;
use cc4dgs_core::storage::mulaw;
use safetensors::SafeTensors;
use std::path::PathBuf;

fn golden(name: &str) -> Vec<u8> {
    let root = PathBuf::from(env!("CARGO_MANIFEST_DIR"));
    let folders = [std::env::var_os("CC4DGS_GOLDEN").map(PathBuf::from), Some(root.join("fixtures/golden")), Some(root.join("../../shared/golden"))];
    let found = folders.into_iter().flatten().map(|f| f.join(name)).find(|p| p.exists());
    std::fs::read(found.unwrap_or_else(|| panic!("{name} is in no golden folder; set CC4DGS_GOLDEN"))).unwrap()
}

fn f32s(file: &SafeTensors, name: &str) -> Vec<f32> {
    file.tensor(name).unwrap().data().chunks_exact(4).map(|c| f32::from_le_bytes(c.try_into().unwrap())).collect()
}
fn f64s(file: &SafeTensors, name: &str) -> Vec<f64> {
    file.tensor(name).unwrap().data().chunks_exact(8).map(|c| f64::from_le_bytes(c.try_into().unwrap())).collect()
}
fn i32s(file: &SafeTensors, name: &str) -> Vec<i32> {
    file.tensor(name).unwrap().data().chunks_exact(4).map(|c| i32::from_le_bytes(c.try_into().unwrap())).collect()
}

#[test]
fn golden_kmeans_one_lloyd_step_is_exact() {
    let bytes = golden("kmeans.f32.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let facts: serde_json::Value = serde_json::from_slice(&golden("kmeans.json")).unwrap();
    let (x, init) = (f32s(&file, "in.x"), f32s(&file, "in.init_centers"));
    let a = kmeans::assign(&x, 15, &init);
    let (labels, gaps) = (i32s(&file, "lloyd1.labels"), f32s(&file, "lloyd1.label_gap"));
    for (i, (&ours, &theirs)) in a.labels.iter().zip(&labels).enumerate() {
        assert!(ours == theirs as u32 || gaps[i] < 1e-6, "point {i}: centre {ours} against {theirs}, gap {}", gaps[i]);
    }
    let inertia = facts["lloyd_step"]["inertia_with_init"].as_f64().unwrap();
    assert!((a.inertia / inertia - 1.0).abs() < 1e-6, "{} against {inertia}", a.inertia);
    let centers = kmeans::update(&x, 15, &a, &init);
    let worst = centers.iter().zip(f32s(&file, "lloyd1.centers")).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-6, "centres differ by {worst}");
    let after = facts["lloyd_step"]["inertia_after_one_update"].as_f64().unwrap();
    let ours = kmeans::assign(&x, 15, &centers).inertia;
    assert!((ours / after - 1.0).abs() < 1e-6, "{ours} against {after}");
}

#[test]
fn golden_kmeans_reaches_the_quality_bar() {
    let bytes = golden("kmeans.f32.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let facts: serde_json::Value = serde_json::from_slice(&golden("kmeans.json")).unwrap();
    let bar = 1.02 * facts["quality_bar"]["mean"].as_f64().unwrap();
    let x = f32s(&file, "in.x");
    for seed in 0..3 {
        // The codec's 25 iterations, a quarter of those of the reference.
        let centers = kmeans::cluster(&x, 15, 256, 25, Seed::root(seed));
        let inertia = kmeans::assign(&x, 15, &centers).inertia;
        assert!(inertia <= bar, "seed {seed}: inertia {inertia:.1} is over {bar:.1}");
    }
}

#[test]
fn golden_mulaw_codes_and_values() {
    let bytes = golden("mulaw.f64.safetensors");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let x = f64s(&file, "in.x");
    // torchaudio's unsigned codes: floor((y + 1) / 2 * mu + 0.5) with mu = levels - 1.
    for (name, levels) in [("q65536", 65536u32), ("q256", 256)] {
        let mu = f64::from(levels - 1);
        let codes = i32s(&file, &format!("{name}.code"));
        let decoded = f64s(&file, &format!("{name}.decoded"));
        let before = f64s(&file, &format!("{name}.precode"));
        for i in 0..x.len() {
            let precode = (mulaw::compress(x[i], mu) + 1.0) / 2.0 * mu + 0.5;
            assert!((precode - before[i]).abs() < 1e-6 * mu, "{name} {}: {precode} against {}", x[i], before[i]);
            let clear = (before[i] - before[i].round()).abs() > 1e-6;
            assert!(!clear || precode.floor() as i32 == codes[i], "{name} {}: code {} against {}", x[i], precode.floor(), codes[i]);
            let value = mulaw::expand(f64::from(codes[i]) / mu * 2.0 - 1.0, mu);
            // torchaudio decodes in float32.
            assert!((value - decoded[i]).abs() < 1e-6, "{name} code {}: {value} against {}", codes[i], decoded[i]);
        }
    }
    // As in the codec: mu = 255, signed 16-bit codes, halves rounded away from zero.
    let codes = i32s(&file, "mu255_i16.code");
    let decoded = f64s(&file, "mu255_i16.decoded");
    let before = f64s(&file, "mu255_i16.precode");
    for i in 0..x.len() {
        let clear = (before[i].abs().fract() - 0.5).abs() > 1e-6;
        assert!(!clear || mulaw::encode(x[i], 16) == codes[i], "{}: code {} against {}", x[i], mulaw::encode(x[i], 16), codes[i]);
        assert!((mulaw::decode(codes[i], 16) - decoded[i]).abs() < 1e-12, "code {}", codes[i]);
    }
}
