//! Every registered codec: decoded values are within the declared losses, bytes are reproducible, untrusted
//! streams give errors.

use cc4dgs_codecs::morton;
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{AttributeCodec, CodecContext, ExtraAttribute, HostGaussians, Limits, Recorder, Registry, Seed, Silent, Stream};
use proptest::prelude::*;
use rand::Rng;

fn context() -> CodecContext<'static> {
    CodecContext::new(Seed::root(11), Limits::default(), &Silent)
}

/// Every codec with every profile of its capabilities.
fn codecs() -> Vec<(String, Box<dyn AttributeCodec>)> {
    let registry = Registry::collect().unwrap();
    let mut out = Vec::new();
    for (_, plugin) in registry.plugins().into_iter().filter(|(kind, _)| *kind == "codec") {
        let profiles = plugin.capabilities.iter().find_map(|c| c.strip_prefix("profiles=")).unwrap_or("");
        for profile in profiles.split(',') {
            let spec = format!("{}:{profile}", plugin.name);
            // Fewer training steps for codecs that train.
            let quick = if plugin.schema.contains("sample_budget") { "sample_budget = 20000".parse().unwrap() } else { toml::Table::new() };
            out.push((spec.clone(), registry.build_codec(&spec, &quick).unwrap()));
        }
    }
    assert!(out.len() >= 4, "raw and three profiles of cca");
    out
}

fn codec(spec: &str) -> Box<dyn AttributeCodec> {
    codecs().into_iter().find(|(name, _)| name == spec).unwrap().1
}

/// Gaussians with the statistics of a trained model: clustered, long-tailed scales, colours correlated between coefficients and with the geometry.
fn scene(n: usize, sh_degree: usize, seed: u64) -> HostGaussians {
    let mut rng = Seed::root(seed).rng();
    let mut normal = move || -> f32 { (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0 };
    let mut g = HostGaussians { sh_degree, ..Default::default() };
    let rest = 3 * sh_rest_len(sh_degree);
    let basis: Vec<f32> = (0..8 * rest).map(|_| normal()).collect();
    for i in 0..n {
        let cluster = (i % 13) as f32;
        let p = [cluster.sin() * 4.0 + 0.3 * normal(), cluster.cos() * 4.0 + 0.3 * normal(), 0.5 * normal()];
        g.means.extend(p);
        let size = normal();
        g.log_scales.extend([-4.0 + size, -4.2 + size + 0.3 * normal(), -5.0 + size - 0.5 * normal().powi(2)]);
        g.quaternions.extend([0.3 + normal(), normal(), normal(), normal()]);
        g.opacity_logits.push(2.0 * normal());
        g.sh_dc.extend([normal(), normal(), normal()]);
        g.dynamic_scores.push(if i % 7 == 0 { 8.0 + 5.0 * normal().powi(2) } else { 0.3 * normal() });
        let factors: Vec<f32> = (0..8).map(|k| 0.1 * normal() / (1.0 + k as f32) + 0.1 * (p[k % 3] + k as f32).sin()).collect();
        g.sh_rest.extend((0..rest).map(|c| (0..8).map(|k| factors[k] * basis[8 * c + k]).sum::<f32>() + 0.01 * normal()));
    }
    g.extra.insert("embedding".into(), ExtraAttribute::exact(2, (0..2 * n).map(|i| i as f32).collect()));
    g
}

/// Name of the attribute that records the order of a codec.
const MARK: &str = "mark";

/// Decodes, and puts the original Gaussians into the codec's order.
fn round_trip(name: &str, codec: &dyn AttributeCodec, g: &HostGaussians) -> (HostGaussians, HostGaussians, Vec<Stream>) {
    let mut g = g.clone();
    g.extra.insert(MARK.into(), ExtraAttribute::exact(1, (0..g.len()).map(|i| i as f32).collect()));
    let streams = codec.encode(&g, &context()).unwrap_or_else(|e| panic!("{name}: {e}"));
    let decoded = codec.decode(&streams, &context()).unwrap_or_else(|e| panic!("{name}: {e}"));
    let order: Vec<usize> = decoded.extra[MARK].values.iter().map(|v| *v as usize).collect();
    (g.select(&order), decoded, streams)
}

fn relative_rms(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let n = a.len().max(1) as f64;
    let mean = a.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let error = a.iter().zip(b).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum::<f64>();
    let variance = a.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>();
    if error == 0.0 { 0.0 } else { (error / variance).sqrt() }
}

fn hold_to_losses(name: &str, codec: &dyn AttributeCodec, g: &HostGaussians) -> HostGaussians {
    let (original, decoded, _) = round_trip(name, codec, g);
    assert_eq!((decoded.len(), decoded.sh_degree), (g.len(), g.sh_degree), "{name}");
    assert_eq!(decoded.extra, original.extra, "{name}: attributes of plug-ins pass unharmed");
    let losses = codec.losses();
    for ((column, _, before), (_, _, after)) in original.columns().into_iter().zip(decoded.columns()) {
        let allowed = losses.iter().find(|l| l.attribute == column).map_or(0.0, |l| l.relative_rms);
        let lost = relative_rms(before, after);
        assert!(lost <= allowed, "{name}: {column} lost {lost:.2e}, {allowed:.2e} is declared");
        if allowed == 0.0 {
            assert!(before.iter().zip(after.iter()).all(|(a, b)| a.to_bits() == b.to_bits()), "{name}: {column} is declared bit-exact");
        }
    }
    decoded
}

#[test]
fn every_codec_keeps_its_declared_losses_at_every_degree() {
    for (name, codec) in codecs() {
        for (n, degree) in [(4000, 3), (300, 3), (2500, 1), (3000, 2), (1500, 4), (700, 0)] {
            hold_to_losses(&format!("{name} n={n} degree={degree}"), codec.as_ref(), &scene(n, degree, 1));
        }
    }
}

#[test]
fn degenerate_models_come_back() {
    for (name, codec) in codecs() {
        for degree in 0..=4 {
            hold_to_losses(&name, codec.as_ref(), &scene(0, degree, 2));
            hold_to_losses(&name, codec.as_ref(), &scene(1, degree, 2));
            hold_to_losses(&name, codec.as_ref(), &scene(2, degree, 2));
        }
        let one = scene(1, 3, 3);
        let same = one.select(&[0; 900]);
        let found = hold_to_losses(&name, codec.as_ref(), &same).sh_rest;
        // SPZ has fixed quantisation levels.
        assert!(found == same.sh_rest || name.starts_with("spz"), "{name}: 900 equal Gaussians are exact");
        let mut dark = scene(2000, 3, 4);
        dark.sh_rest.fill(0.0);
        assert!(hold_to_losses(&name, codec.as_ref(), &dark).sh_rest.iter().all(|&v| v == 0.0), "{name}: absent colours stay absent");
    }
}

#[test]
fn outliers_survive_without_spoiling_their_neighbours() {
    for (name, codec) in codecs() {
        let mut g = scene(3000, 1, 5);
        g.log_scales[5] = -300.0;
        g.log_scales[900] = 40.0;
        g.opacity_logits[7] = 1e6;
        g.dynamic_scores[9] = 3e5;
        hold_to_losses(&name, codec.as_ref(), &g);
        let (original, decoded, _) = round_trip(&name, codec.as_ref(), &g);
        let worst = |a: &[f32], b: &[f32], least: f32| {
            let outliers = a.iter().zip(b).filter(|(x, _)| x.abs() > least);
            outliers.map(|(x, y)| (x - y).abs() / (1.0 + x.abs())).fold(0.0, f32::max)
        };
        let scales = |i: usize| original.log_scales[3 * i..3 * i + 3].iter().any(|v| v.abs() > 30.0);
        let (far, near): (Vec<usize>, Vec<usize>) =
            (0..original.len()).partition(|&i| scales(i) || original.opacity_logits[i] > 1e5 || original.dynamic_scores[i] > 1e5);
        assert_eq!(far.len(), 4, "{name}");
        let (before, after) = (original.select(&far), decoded.select(&far));
        assert!(worst(&before.log_scales, &after.log_scales, 30.0) < 0.05, "{name}");
        assert!(worst(&before.opacity_logits, &after.opacity_logits, 1e5) < 0.05, "{name}");
        assert!(worst(&before.dynamic_scores, &after.dynamic_scores, 1e5) < 0.1, "{name}");
        // The others keep the declared losses, measured against their own deviation.
        let (before, after) = (original.select(&near), decoded.select(&near));
        // `compact` has steps of scales up to 0.7, and of opacities up to 1 on its scale, for Gaussians that are hardly seen.
        let (scale, opacity) = if name.starts_with("compact") { (0.36, 0.66) } else { (0.05, 0.05) };
        assert!(worst(&before.log_scales, &after.log_scales, -1.0) < scale, "{name}");
        assert!(worst(&before.opacity_logits, &after.opacity_logits, -1.0) < opacity, "{name}");
        assert!(worst(&before.dynamic_scores, &after.dynamic_scores, -1.0) < 0.1, "{name}");
        for loss in codec.losses() {
            let find = |g: &HostGaussians| g.columns().into_iter().find(|(column, _, _)| *column == loss.attribute).map(|(_, _, values)| values.clone());
            let lost = find(&before).zip(find(&after)).map_or(0.0, |(a, b)| relative_rms(&a, &b));
            assert!(lost <= loss.relative_rms.max(0.05), "{name}: {} of the others lost {lost:.2e}", loss.attribute);
        }
    }
}

#[test]
fn rotations_keep_sign_and_norm() {
    // Offsets of a deformation field are added before normalisation, so q and -q, or q and 2q, are not the same canonical rotation.
    let mut g = scene(1000, 0, 6);
    g.quaternions.chunks_exact_mut(4).enumerate().for_each(|(i, q)| q.iter_mut().for_each(|v| *v *= 0.2 + (i % 5) as f32));
    let (original, decoded, _) = round_trip("cca", codec("cca:default").as_ref(), &g);
    for (a, b) in original.quaternions.chunks_exact(4).zip(decoded.quaternions.chunks_exact(4)) {
        let norm = a.iter().map(|v| v * v).sum::<f32>().sqrt();
        assert!(a.iter().zip(b).all(|(x, y)| (x - y).abs() < 2e-3 * norm), "{a:?} became {b:?}");
    }
}

#[test]
fn encoding_is_deterministic_for_any_number_of_threads() {
    let g = scene(2500, 3, 7);
    for (name, codec) in codecs() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let streams = codec.encode(&g, &context()).unwrap();
                let decoded = codec.decode(&streams, &context()).unwrap();
                (streams, decoded)
            })
        };
        assert!(run(1) == run(3), "{name}: the number of threads shows");
    }
}

#[test]
fn lower_profiles_take_fewer_bytes() {
    let g = scene(5000, 3, 8);
    let size = |spec: &str| -> usize {
        codec(spec).encode(&g, &context()).unwrap().iter().map(|s| cc4dgs_core::archive::estimate_stored_len(&s.bytes).unwrap() as usize).sum()
    };
    let sizes = ["raw:default", "cca:default", "cca:mid", "cca:low"].map(size);
    assert!(sizes.windows(2).all(|w| w[0] > w[1]), "{sizes:?}");
}

#[test]
fn a_bit_budget_of_cca_changes_its_own_streams_alone() {
    let registry = Registry::collect().unwrap();
    let g = scene(600, 1, 8);
    let encode = |settings: &str| {
        let codec = registry.build_codec("cca", &format!("epochs = 3\n{settings}").parse().unwrap()).unwrap();
        hold_to_losses(settings, codec.as_ref(), &g);
        codec.encode(&g, &context()).unwrap()
    };
    let base = encode("");
    let bytes = |streams: &[Stream]| streams.iter().map(|s| s.bytes.len()).sum::<usize>();
    for (settings, own) in [("scalar_bits = 8", "log_scales"), ("dynamic_bits = 8", "dynamic_scores")] {
        let fewer = encode(settings);
        let changed: Vec<&str> = base.iter().zip(&fewer).filter(|(a, b)| a.bytes != b.bytes).map(|(a, _)| a.name.as_str()).collect();
        assert!(bytes(&fewer) < bytes(&base) && changed.contains(&own) && !changed.contains(&"means"), "{settings}: {changed:?}");
    }
}

#[test]
fn colours_without_structure_are_not_thrown_away() {
    // White noise in twice as many dimensions as there are latents: the loss is within the declared one for every form.
    let mut g = scene(3000, 4, 9);
    let mut rng = Seed::root(10).rng();
    g.sh_rest.iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0));
    let events = Recorder::default();
    let codec = codec("cca:low");
    let streams = codec.encode(&g, &CodecContext { events: &events, ..context() }).unwrap();
    let decoded = codec.decode(&streams, &context()).unwrap();
    let lost = relative_rms(&g.select(&morton::order(&g.means)).sh_rest, &decoded.sh_rest);
    let allowed = codec.losses().iter().find(|l| l.attribute == "sh_rest").unwrap().relative_rms;
    assert!(lost <= allowed, "{lost} is over {allowed}");
    assert!(!events.events().is_empty(), "progress is told");
}

#[test]
fn unknown_profiles_and_settings_are_named() {
    let registry = Registry::collect().unwrap();
    let e = registry.build_codec("cca:lowest", &toml::Table::new()).err().unwrap().to_string();
    assert!(e.contains("low") && e.contains("default") && e.contains("mid"), "{e}");
    let settings = "epocs = 3".parse().unwrap();
    let e = registry.build_codec("cca", &settings).err().unwrap().to_string();
    assert!(e.contains("epocs"), "{e}");
    assert!(registry.build_codec("cca", &"epochs = 0".parse().unwrap()).is_err());
    let schema: toml::Table = registry.codec("cca").unwrap().info.schema.parse().unwrap();
    assert!(registry.build_codec("cca:mid", &schema).is_ok(), "the schema's defaults are accepted");
}

#[test]
fn models_that_are_not_sound_are_refused() {
    for (name, codec) in codecs() {
        let mut g = scene(5, 1, 1);
        g.means[3] = f32::NAN;
        assert!(codec.encode(&g, &context()).is_err(), "{name} took a NaN");
        let mut g = scene(5, 1, 1);
        g.sh_dc.pop();
        assert!(codec.encode(&g, &context()).is_err(), "{name} took a short column");
        let small = CodecContext { limits: Limits { max_gaussians: 4, ..Limits::default() }, ..context() };
        let streams = codec.encode(&scene(5, 1, 1), &context()).unwrap();
        let e = codec.decode(&streams, &small).unwrap_err().to_string();
        assert!(e.contains("limit of 4"), "{name}: {e}");
    }
}

/// Valid streams of a small model, with the autoencoder if the codec has one.
fn sound_streams(codec: &dyn AttributeCodec, n: usize) -> Vec<Stream> {
    codec.encode(&scene(n, 3, 12), &context()).unwrap()
}

#[test]
fn truncated_and_flipped_streams_never_panic() {
    for (name, codec) in codecs() {
        let streams = sound_streams(codec.as_ref(), 6);
        for s in 0..streams.len() {
            for cut in 0..streams[s].bytes.len() {
                let mut bad = streams.clone();
                bad[s].bytes.truncate(cut);
                assert!(codec.decode(&bad, &context()).is_err(), "{name}: {} truncated at {cut} was accepted", streams[s].name);
                // A flipped bit may give another valid model, but never a panic or a value that is not finite.
                let mut bad = streams.clone();
                for bit in 0..8 {
                    bad[s].bytes[cut] ^= 1 << bit;
                    if let Ok(g) = codec.decode(&bad, &context()) {
                        g.validate(&name, &Limits::default()).unwrap();
                    }
                    bad[s].bytes[cut] ^= 1 << bit;
                }
            }
            let mut missing = streams.clone();
            missing.remove(s);
            assert!(codec.decode(&missing, &context()).is_err(), "{name}: {} is not needed", streams[s].name);
            let mut long = streams.clone();
            long[s].bytes.push(0);
            assert!(codec.decode(&long, &context()).is_err(), "{name}: {} may be longer", streams[s].name);
        }
    }
}

#[test]
fn hostile_autoencoder_streams_never_panic() {
    let codec = codec("cca:low");
    let streams = sound_streams(codec.as_ref(), 4000);
    assert!(streams.iter().any(|s| s.name == "sh_rest.decoder"), "the model is large enough for the autoencoder");
    let small = ["meta", "sh_rest.codebook", "sh_rest.decoder", "sh_rest.residuals"];
    for s in (0..streams.len()).filter(|&s| small.contains(&streams[s].name.as_str())) {
        let step = if streams[s].name == "meta" { 7 } else { streams[s].bytes.len() / 8 };
        for at in (0..streams[s].bytes.len()).step_by(step) {
            for value in [0x00, 0x7c, 0xff] {
                let mut bad = streams.clone();
                bad[s].bytes[at] = value;
                if let Ok(g) = codec.decode(&bad, &context()) {
                    g.validate("decoded", &Limits::default()).unwrap();
                }
            }
        }
    }
}

/// Bytes per stream of a trained model at full effort. `cargo test --release -p cc4dgs-tests --test codecs -- --ignored --nocapture`
#[test]
#[ignore = "takes a minute; prints a report"]
fn report_bytes_of_a_trained_model() {
    let data = std::env::var_os("CC4DGS_DATA").map_or_else(|| std::path::PathBuf::from("../../shared/data"), Into::into);
    let path = data.join("playbot_31k/lod3_decoded_3dgs.ply");
    let trained = path.exists().then(|| cc4dgs_core::ply::read(&path, &Limits::default()).unwrap());
    if trained.is_none() {
        println!("{} is absent", path.display());
    }
    for (name, g) in [("trained", trained), ("synthetic", Some(scene(50_000, 3, 20)))].into_iter().filter_map(|(n, g)| Some((n, g?))) {
        for spec in ["raw", "cca:default", "cca:mid", "cca:low"] {
            let codec = Registry::collect().unwrap().build_codec(spec, &toml::Table::new()).unwrap();
            let start = std::time::Instant::now();
            let (original, decoded, streams) = round_trip(spec, codec.as_ref(), &g);
            let seconds = start.elapsed().as_secs_f64();
            let manifest = cc4dgs_core::archive::Manifest { frame_count: 1, gaussian_count: g.len() as u64, ..Default::default() };
            let start = std::time::Instant::now();
            let bytes = cc4dgs_core::archive::ArchiveWriter::new(manifest).add_all(cc4dgs_core::archive::StreamKind::Canonical, streams).to_bytes().unwrap();
            let archive = cc4dgs_core::archive::Archive::from_bytes("t", bytes, &Limits::default()).unwrap();
            let per = |b: u64| b as f64 / g.len() as f64;
            println!(
                "{name} {spec}: {} Gaussians, {:.2} B each, coded and decoded in {seconds:.1} s, packed in {:.1} s",
                g.len(),
                per(archive.total_bytes().unwrap()),
                start.elapsed().as_secs_f64()
            );
            for s in archive.stream_sizes() {
                println!("    {:<20} {:>9} B {:>9} B stored {:>7.3} B/G", s.name, s.decoded_bytes, s.stored_bytes, per(s.stored_bytes));
            }
            for ((column, _, before), (_, _, after)) in original.columns().into_iter().zip(decoded.columns()) {
                println!("    {column:<20} relative rms {:.2e}", relative_rms(before, after));
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn any_finite_model_comes_back_within_its_losses(
        n in 0usize..40,
        degree in 0usize..=4,
        bits in proptest::collection::vec(any::<u32>(), 1..200),
    ) {
        // All kinds of finite bit patterns: denormals, extremes, both zeros.
        let mut at = 0usize;
        let mut next = || { at += 1; let v = f32::from_bits(bits[at % bits.len()].wrapping_mul(at as u32 | 1)); if v.is_finite() { v } else { 0.25 } };
        let mut g = HostGaussians { sh_degree: degree, opacity_logits: vec![0.0; n], ..Default::default() };
        for (_, width, values) in g.columns_mut() {
            *values = (0..n * width).map(|_| next()).collect();
        }
        for (name, codec) in codecs() {
            hold_to_losses(&name, codec.as_ref(), &g);
        }
    }
    #[test]
    fn random_bytes_are_no_streams(bytes in proptest::collection::vec(any::<u8>(), 0..300), meta in 0usize..2) {
        for (name, codec) in codecs() {
            let mut streams = sound_streams(codec.as_ref(), 2);
            let at = if meta == 0 { streams.iter().position(|s| s.name == "meta").unwrap() } else { bytes.len() % streams.len() };
            streams[at].bytes = bytes.clone();
            if let Ok(g) = codec.decode(&streams, &context()) {
                g.validate(&name, &Limits::default()).unwrap();
            }
        }
    }
}
