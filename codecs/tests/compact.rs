//! `compact`: the conformance suite, a stored file that must stay readable, motion, and sizes.
#![allow(clippy::unwrap_used, reason = "a test that meets an error should stop there, in helpers too")]

use cc4dgs_format::{
    AttributeCodec, CodecContext, CodecPlugin, Entries, ExtraAttribute, HostGaussians, Limits, Seed, Silent, Stream, StreamStage, conformance, toml,
};

fn plugin() -> &'static CodecPlugin {
    cc4dgs_codecs::link();
    Entries::<CodecPlugin>::collect().unwrap().get("compact").unwrap()
}

fn codec(profile: &str) -> Box<dyn AttributeCodec> {
    (plugin().build)(profile, &toml::Table::new()).unwrap()
}

fn context(threshold: Option<f32>) -> CodecContext<'static> {
    CodecContext { dynamic_threshold: threshold, ..CodecContext::new(Seed::root(3), Limits::default(), &Silent) }
}

/// Gaussians on a surface, of many sizes, with smooth colours and some noise. No function whose rounding depends on the machine is used.
fn scene(count: usize, sh_degree: usize) -> HostGaussians {
    let draw = |i: usize, k: usize| (Seed::root(31).index(i as u64).index(k as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0;
    let mut g = HostGaussians { sh_degree, opacity_logits: vec![0.0; count], ..Default::default() };
    g.opacity_logits = (0..count).map(|i| 2.0 + 3.0 * draw(i, 0)).collect();
    for i in 0..count {
        let (x, y) = (draw(i, 1), draw(i, 2));
        g.means.extend([x, y, 0.3 * x * y + 0.01 * draw(i, 3)]);
        let size = -4.0 + 1.5 * draw(i, 4) * draw(i, 5);
        g.log_scales.extend([size, size - 0.5 * draw(i, 6), size - 1.0 + draw(i, 7)]);
        g.quaternions.extend([1.0 + 0.3 * draw(i, 8), draw(i, 9), draw(i, 10), draw(i, 11)]);
        g.sh_dc.extend([x + 0.2 * draw(i, 12), y + 0.2 * draw(i, 13), x * y + 0.2 * draw(i, 14)]);
        g.sh_rest.extend(
            (0..3 * cc4dgs_format::gaussians::sh_rest_len(sh_degree)).map(|k| 0.1 * draw(i, 20 + k) * draw(i, 80 + k) * if k % 3 == 0 { x } else { y }),
        );
        g.dynamic_scores.push(if x > 0.5 { 9.0 + draw(i, 15) } else { draw(i, 16) });
    }
    g
}

#[test]
fn the_suite_passes() {
    for (profile, layers) in [("", 0), ("psnr=35dB", 2), ("psnr=70dB", 5), ("max-size=1MB", 0)] {
        let findings = conformance::codec(plugin(), profile, &toml::Table::from_iter([("layers".into(), layers.into())]));
        assert!(findings.is_empty(), "{}", findings.join("\n"));
    }
}

#[test]
fn columns_without_spread_are_exact() {
    // No step keeps a loss relative to a deviation of zero, however small the values are.
    for (value, count) in [(0.3, 1), (1e-20, 1), (-1e-41, 1), (1e-20, 70)] {
        let mut g = scene(count, 1);
        for (_, _, values) in g.columns_mut() {
            values.fill(value);
        }
        let (codec, limits) = (codec(""), context(None));
        let found = codec.decode(&codec.encode(&g, &limits).unwrap(), &limits).unwrap();
        let columns = g.columns().into_iter().zip(found.columns());
        let wrong: Vec<&str> = columns.filter(|((_, _, a), (_, _, b))| a != b).map(|((name, _, _), _)| name).collect();
        assert!(wrong.is_empty(), "{count} times {value}: {wrong:?}");
    }
}

#[test]
fn a_few_gaussians_far_away_do_not_spoil_the_centres_of_the_others() {
    let (count, codec, limits) = (10_000, codec(""), context(Some(5.0)));
    let mut g = scene(count, 0);
    g.log_scales.fill(-5.0);
    (0..100).for_each(|i| g.means[3 * i] = if i % 2 == 0 { 1e5 } else { -1e5 });
    g.extra.insert("row".into(), ExtraAttribute::exact(1, (0..count).map(|i| i as f32).collect()));
    let streams = codec.encode(&g, &limits).unwrap();
    let found = codec.decode(&streams, &limits).unwrap();
    let given = g.select(&found.extra["row"].values.iter().map(|v| *v as usize).collect::<Vec<usize>>());
    let worst = given.means.iter().zip(&found.means).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // Steps are at most about a standard deviation.
    assert!(worst < (-5.0f32).exp(), "a centre is {worst} off");
    // Those far away are stored as they are, and few others.
    let exact = streams.iter().find(|s| s.name == "exact").unwrap().bytes.len();
    assert!((1600..3200).contains(&exact), "{exact} bytes");
}

#[test]
fn motion_is_kept_and_scores_take_a_bit() {
    let (g, codec) = (scene(4000, 1), codec(""));
    for (threshold, width) in [(Some(5.0), 1.0), (Some(f32::NEG_INFINITY), 0.1), (Some(f32::INFINITY), 0.1)] {
        let streams = codec.encode(&g, &context(threshold)).unwrap();
        let found = codec.decode(&streams, &context(None)).unwrap();
        let moves = |g: &HostGaussians| g.dynamic_scores.iter().filter(|s| **s > threshold.unwrap()).count();
        assert_eq!(moves(&found), moves(&g));
        let bytes = streams.iter().find(|s| s.name == "moving").unwrap().bytes.len();
        assert!(8.0 * bytes as f64 <= 100.0 + width * 4000.0, "{bytes} bytes for a bit per Gaussian");
    }
}

/// Covariances are what axes and rotations mean.
fn covariance(g: &HostGaussians, i: usize) -> [f64; 6] {
    let q: Vec<f64> = g.quaternions[4 * i..4 * i + 4].iter().map(|&v| f64::from(v)).collect();
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [w, x, y, z] = [q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm];
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let s: Vec<f64> = g.log_scales[3 * i..3 * i + 3].iter().map(|&v| f64::from(v).exp().powi(2)).collect();
    let entry = |a: usize, b: usize| (0..3).map(|k| r[a][k] * s[k] * r[b][k]).sum::<f64>();
    [entry(0, 0), entry(0, 1), entry(0, 2), entry(1, 1), entry(1, 2), entry(2, 2)]
}

#[test]
fn sorted_axes_are_the_same_ellipsoids() {
    let g = scene(500, 0);
    let codec = codec("psnr=90dB");
    let streams = codec.encode(&g, &context(Some(f32::INFINITY))).unwrap();
    let found = codec.decode(&streams, &context(None)).unwrap();
    for i in 0..found.len() {
        let (mean, wanted) = (&found.means[3 * i..3 * i + 3], covariance(&found, i));
        let distance = |j: &usize| (0..3).map(|k| f64::from(g.means[3 * j + k] - mean[k]).powi(2)).sum::<f64>();
        let nearest = (0..g.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        let (given, size) = (covariance(&g, nearest), wanted[0] + wanted[3] + wanted[5]);
        assert!(given.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 0.02 * size), "{given:?} became {wanted:?}");
        assert!(found.log_scales[3 * i..3 * i + 3].is_sorted_by(|a, b| a >= b));
    }
}

#[test]
fn a_larger_error_takes_fewer_bytes_and_sizes_are_kept_to() {
    let g = scene(5000, 2);
    let size = |streams: &[Stream]| streams.iter().map(|s| s.bytes.len()).sum::<usize>();
    let sizes: Vec<usize> = ["psnr=60dB", "psnr=50dB", "psnr=40dB"].iter().map(|p| size(&codec(p).encode(&g, &context(None)).unwrap())).collect();
    assert!(sizes.is_sorted_by(|a, b| 5 * a > 6 * b), "{sizes:?}");
    let wanted = (sizes[0] + sizes[1]) / 2;
    let found = size(&codec(&format!("max-size={}MB", wanted as f64 / 1e6)).encode(&g, &context(None)).unwrap());
    assert!(found <= wanted && 10 * found > 9 * wanted, "{found} of {wanted}");
    assert!(codec("max-size=0.0001MB").encode(&g, &context(None)).is_err());
    assert!(codec("max-drop=0.1dB").encode(&g, &context(None)).unwrap_err().to_string().contains("--scene"));
}

#[test]
fn what_is_far_out_is_exact_and_the_smallest_weights_are_stored() {
    let mut g = scene(3000, 0);
    (g.opacity_logits[7], g.log_scales[31]) = (1e6, -300.0);
    let found = codec("").decode(&codec("").encode(&g, &context(None)).unwrap(), &context(None)).unwrap();
    assert!(found.opacity_logits.contains(&1e6) && found.log_scales.contains(&-300.0));
    let plugins = Entries::<cc4dgs_format::WeightCodecPlugin>::collect().unwrap();
    let weights = [cc4dgs_format::WeightArray { name: "w".into(), shape: vec![3], values: Vec::new() }];
    for settings in ["", "bits = 3", "bits = 12"] {
        let codec = (plugins.get("compact").unwrap().build)(&settings.parse().unwrap()).unwrap();
        let kept = |values: [f32; 3]| {
            let array = [cc4dgs_format::WeightArray { values: values.into(), ..weights[0].clone() }];
            let found = codec.decode(&codec.encode(&array, &context(None)).unwrap(), &context(None)).unwrap();
            let largest = values.iter().fold(0.0f64, |m, v| m.max(f64::from(*v).abs()));
            // The smallest floats have steps of their own.
            let allowed = codec.loss() * largest + f64::from(f32::from_bits(1));
            assert!(found[0].values.iter().zip(values).all(|(a, b)| (f64::from(*a) - f64::from(b)).abs() <= allowed), "{:?} of {values:?}", found[0].values);
        };
        kept([1e-45, -1e-42, f32::MAX]);
        kept([1e-45, -1e-42, 0.0]);
        kept([1e-45, 0.0, 0.0]);
    }
}

#[test]
fn the_most_important_gaussians_come_first() {
    let g = scene(4000, 2);
    let settings = toml::Table::from_iter([("layers".into(), 3.into())]);
    let codec = (plugin().build)("", &settings).unwrap();
    let streams = codec.encode(&g, &context(Some(5.0))).unwrap();
    let up_to = |layer: u8| {
        let streams: Vec<Stream> = streams.iter().filter(|s| codec.stage(&s.name) <= StreamStage::Layer(layer)).cloned().collect();
        codec.decode_stage(&streams, &context(None)).unwrap()
    };
    let found: Vec<HostGaussians> = (0..3).map(up_to).collect();
    assert_eq!(found.iter().map(HostGaussians::len).collect::<Vec<_>>(), [1000, 2000, 4000]);
    assert!(found.iter().all(|g| g.sh_rest.iter().all(|v| *v == 0.0)));
    // Large opaque ones matter most.
    let area = |g: &HostGaussians, rows: std::ops::Range<usize>| {
        let of = |i: usize| f64::from(g.opacity_logits[i]).tanh() + 1.0 + 0.1 * f64::from(g.log_scales[3 * i] + g.log_scales[3 * i + 1]);
        rows.clone().map(of).sum::<f64>() / rows.len() as f64
    };
    assert!(area(&found[2], 0..1000) > area(&found[2], 2000..4000));
    // Layers cost little, and the classes that they separate need fewer bits.
    let size = |streams: &[Stream]| streams.iter().map(|s| s.bytes.len()).sum::<usize>();
    let one = size(&self::codec("").encode(&g, &context(Some(5.0))).unwrap());
    assert!(size(&streams) < one + one / 4, "{} bytes in layers, {one} without", size(&streams));
}

#[test]
fn degrees_arrive_one_by_one() {
    let (count, mut some, mut all) = (600, false, false);
    let mut g = scene(count, 3);
    // Its steps are among the smallest.
    let size = |i: usize| g.opacity_logits[i] + g.log_scales[3 * i..3 * i + 3].iter().sum::<f32>();
    let row = (0..count).max_by(|&a, &b| size(a).total_cmp(&size(b))).unwrap();
    for layers in [1i64, 3] {
        let codec = (plugin().build)("", &toml::Table::from_iter([("layers".into(), layers.into())])).unwrap();
        for value in [0.1, 3e4, 1e6, 3e7, 1e9, 1e20] {
            // A coefficient of degree 2: large ones are stored exactly, and even larger ones spoil the steps of all rows.
            g.sh_rest[45 * row + 13] = value;
            let streams = codec.encode(&g, &context(Some(5.0))).unwrap();
            let exact = streams.iter().find(|s| s.name == "exact").unwrap().bytes.len();
            (some, all) = (some || (60..20 * count).contains(&exact), all || exact > 60 * count);
            let whole = codec.decode(&streams, &context(None)).unwrap();
            for (degree, coefficients) in [(1, 9), (2, 24), (3, 45)] {
                let arrived: Vec<Stream> = streams.iter().filter(|s| codec.stage(&s.name) <= StreamStage::Harmonics(degree)).cloned().collect();
                let mut expected = whole.clone();
                expected.sh_rest.chunks_exact_mut(45).for_each(|row| row[coefficients..].fill(0.0));
                let found = codec.decode_stage(&arrived, &context(None)).unwrap();
                assert!(found == expected, "{value} in {layers} layers: degree {degree} is not the first coefficients of the whole");
            }
        }
    }
    assert!(some && all, "exact rows of degree 2: some {some}, all {all}");
}

/// Streams of version 4, in one layer and in three, and what they decode to, written by this test where the variable is set.
#[test]
fn stored_streams_decode_to_the_same_bits() {
    let put = |out: &mut Vec<u8>, bytes: &[u8]| {
        out.extend((bytes.len() as u32).to_le_bytes());
        out.extend(bytes);
    };
    let values = |g: &HostGaussians| g.columns().iter().flat_map(|(_, _, v)| v.iter().flat_map(|v| v.to_le_bytes())).collect::<Vec<u8>>();
    for (name, layers) in [("compact-4", 1i64), ("compact-4-layers", 3)] {
        let path = std::path::PathBuf::from(format!("tests/fixtures/{name}.bin"));
        let codec = (plugin().build)("", &toml::Table::from_iter([("layers".into(), layers.into())])).unwrap();
        if std::env::var_os("CC4DGS_WRITE_FIXTURES").is_some() {
            let streams = codec.encode(&scene(60, 3), &context(Some(5.0))).unwrap();
            let mut out = Vec::new();
            put(&mut out, &values(&codec.decode(&streams, &context(None)).unwrap()));
            for stream in &streams {
                put(&mut out, stream.name.as_bytes());
                put(&mut out, &stream.bytes);
            }
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, out).unwrap();
        }
        let stored = std::fs::read(&path).unwrap();
        let mut reader = cc4dgs_format::archive::ByteReader::new("fixture", &stored);
        let mut next = || {
            let length = reader.u32().ok()? as usize;
            Some(reader.take(length).unwrap().to_vec())
        };
        let expected = next().unwrap();
        let mut streams = Vec::new();
        while let Some(name) = next() {
            streams.push(Stream { name: String::from_utf8(name).unwrap(), bytes: next().unwrap() });
        }
        assert_eq!(streams.iter().filter(|s| s.name.starts_with("means")).count() as i64, layers, "{name}");
        assert_eq!(values(&codec.decode(&streams, &context(None)).unwrap()), expected, "{name}");
    }
}
