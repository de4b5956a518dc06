//! K-means and mu-law compared with scikit-learn and torchaudio.

use cc4dgs_codecs::kmeans;
use cc4dgs_core::Seed;
use cc4dgs_core::storage::mulaw;
use cc4dgs_tests::golden::Fixture;
use cc4dgs_tests::larger;

/// The points, their dimension, and the first centres of the k-means fixture.
fn points() -> (Fixture, Vec<f32>, usize) {
    let fixture = Fixture::open("kmeans");
    let (x, shape) = (fixture.narrow("in.x"), fixture.shape("in.x"));
    (fixture, x, shape[1])
}

/// A code or label, which the fixture has as an integer.
fn integers(fixture: &Fixture, key: &str) -> Vec<i64> {
    fixture.get(key).into_iter().map(|v| v as i64).collect()
}

#[test]
fn golden_kmeans_one_lloyd_step_is_exact() {
    let (file, x, width) = points();
    let init = file.narrow("in.init_centers");
    let a = kmeans::assign(&x, width, &init);
    let (labels, gaps) = (integers(&file, "lloyd1.labels"), file.get("lloyd1.label_gap"));
    for (i, (&ours, &theirs)) in a.labels.iter().zip(&labels).enumerate() {
        assert!(i64::from(ours) == theirs || gaps[i] < 1e-6, "point {i}: centre {ours} against {theirs}, gap {}", gaps[i]);
    }
    let inertia = file.number(&["lloyd_step", "inertia_with_init"]);
    assert!((a.inertia / inertia - 1.0).abs() < 1e-6, "{} against {inertia}", a.inertia);
    let centers = kmeans::update(&x, width, &a, &init);
    let worst = centers.iter().zip(file.narrow("lloyd1.centers")).map(|(a, b)| (a - b).abs()).fold(0.0, larger);
    assert!(worst < 1e-6, "centres differ by {worst}");
    let after = file.number(&["lloyd_step", "inertia_after_one_update"]);
    let ours = kmeans::assign(&x, width, &centers).inertia;
    assert!((ours / after - 1.0).abs() < 1e-6, "{ours} against {after}");
}

#[test]
fn golden_kmeans_reaches_the_quality_bar() {
    let (file, x, width) = points();
    let (bar, count) = (1.02 * file.number(&["quality_bar", "mean"]), file.shape("in.init_centers")[0]);
    for seed in 0..3 {
        // The codec's 25 iterations, a quarter of those of the reference.
        let centers = kmeans::cluster(&x, width, count, 25, Seed::root(seed));
        let inertia = kmeans::assign(&x, width, &centers).inertia;
        assert!(inertia <= bar, "seed {seed}: inertia {inertia:.1} is over {bar:.1}");
    }
}

#[test]
fn golden_mulaw_codes_and_values() {
    let file = Fixture::open("mulaw");
    let x = file.get("in.x");
    // torchaudio's unsigned codes: floor((y + 1) / 2 * mu + 0.5) with mu = levels - 1; the names of the arrays state the levels.
    let names: Vec<String> =
        file.keys().into_iter().filter_map(|key| key.strip_suffix(".code").filter(|name| name.starts_with('q')).map(str::to_string)).collect();
    assert!(names.len() >= 2, "{names:?}");
    for name in names {
        let mu = name[1..].parse::<f64>().unwrap() - 1.0;
        let codes = integers(&file, &format!("{name}.code"));
        let decoded = file.get(&format!("{name}.decoded"));
        let before = file.get(&format!("{name}.precode"));
        for i in 0..x.len() {
            let precode = (mulaw::compress(x[i], mu) + 1.0) / 2.0 * mu + 0.5;
            assert!((precode - before[i]).abs() < 1e-6 * mu, "{name} {}: {precode} against {}", x[i], before[i]);
            let clear = (before[i] - before[i].round()).abs() > 1e-6;
            assert!(!clear || precode.floor() as i64 == codes[i], "{name} {}: code {} against {}", x[i], precode.floor(), codes[i]);
            let value = mulaw::expand(codes[i] as f64 / mu * 2.0 - 1.0, mu);
            // torchaudio decodes in float32.
            assert!((value - decoded[i]).abs() < 1e-6, "{name} code {}: {value} against {}", codes[i], decoded[i]);
        }
    }
    // As in the codec: mu = 255, signed 16-bit codes, halves rounded away from zero.
    let codes = integers(&file, "mu255_i16.code");
    let decoded = file.get("mu255_i16.decoded");
    let before = file.get("mu255_i16.precode");
    for i in 0..x.len() {
        let clear = (before[i].abs().fract() - 0.5).abs() > 1e-6;
        assert!(!clear || i64::from(mulaw::encode(x[i], 16)) == codes[i], "{}: code {} against {}", x[i], mulaw::encode(x[i], 16), codes[i]);
        assert!((mulaw::decode(codes[i] as i32, 16) - decoded[i]).abs() < 1e-12, "code {}", codes[i]);
    }
}
