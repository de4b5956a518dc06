//! Bytes, seconds and memory of codecs on a PLY file, repeated to a larger model: `codec_speed FILE.ply REPEAT CODEC[:PROFILE][;SETTINGS]... [--json FILE]`.
//!
//! Prints a line of JSON per codec; with `--json`, all of them and the machine are written as one document. Memory is the peak of the process, so only the
//! first row has it. `ENCODES` and `DECODES` say how often each is timed (1 and 3 by default); encoding is not repeated after a minute. Where `ARCHIVES`
//! names a folder, the archives are written there; where `DECODED` does, what was decoded too, as PLY files.
//!
//! `codec_speed FILE.cc4d CODEC[:PROFILE][;SETTINGS] [--json FILE]` decodes such an archive once in a process that has done nothing else, and says how much
//! memory it had. `codec_speed FILE.cc4d [--json FILE]` decodes the weights of its deformer instead, `DECODES` times. `benches/codec_speed.py` does all of it.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs_format::archive::{Archive, ArchiveWriter, Manifest, StreamKind};
use cc4dgs_format::{AttributeCodec, CodecContext, CodecPlugin, Entries, Error, HostGaussians, Limits, Result, Seed, Silent, ply, read_weights, toml};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Seconds of encoding after which it is not repeated.
const ENOUGH_S: f64 = 60.0;

fn main() -> Result<()> {
    cc4dgs_codecs::link();
    let usage =
        || Error::parameter("codec_speed", "wrong arguments", "Write FILE.ply REPEAT CODEC[:PROFILE][;SETTINGS]..., or FILE.cc4d [CODEC]; [--json FILE]");
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut json = None;
    if let Some(at) = arguments.iter().position(|a| a == "--json") {
        if at + 1 == arguments.len() {
            return Err(usage());
        }
        json = arguments.drain(at..at + 2).nth(1);
    }
    let rows = match arguments.as_slice() {
        [path] if path.ends_with(".cc4d") => vec![decode_weights(path)?],
        [path, codec] if path.ends_with(".cc4d") => vec![decode_alone(path, codec)?],
        [path, repeat, specs @ ..] if !specs.is_empty() => measure(path, repeat, specs)?,
        _ => return Err(usage()),
    };
    if let Some(file) = json {
        let threads = rayon::current_num_threads();
        let document = json!({ "version": env!("CARGO_PKG_VERSION"), "threads": threads, "cpu_features": cpu_features(), "rows": rows });
        std::fs::write(&file, format!("{document:#}\n")).map_err(|e| Error::io(&file, e))?;
    }
    Ok(())
}

/// The codec `CODEC[:PROFILE][;SETTINGS]`, and what that says.
fn codec_of(spec: &str) -> Result<(Box<dyn AttributeCodec>, Value)> {
    let (named, settings) = spec.split_once(';').unwrap_or((spec, ""));
    let (name, profile) = named.split_once(':').unwrap_or((named, ""));
    let settings: toml::Table = settings.parse().map_err(|e: toml::de::Error| Error::parameter("SETTINGS", e.to_string(), "Write TOML, such as layers=1"))?;
    let plugin = Entries::<CodecPlugin>::collect()?.get(name)?;
    let facts = json!({ "name": name, "version": plugin.info.version, "profile": profile, "settings": settings });
    Ok(((plugin.build)(profile, &settings)?, facts))
}

/// The number in a variable, or another.
fn times(variable: &str, otherwise: usize) -> usize {
    std::env::var(variable).ok().and_then(|v| v.parse().ok()).unwrap_or(otherwise)
}

/// Encodes and decodes the model at `path`, `repeat` times as large, with every codec of `specs`.
fn measure(path: &str, repeat: &str, specs: &[String]) -> Result<Vec<Value>> {
    let repeat = repeat.parse::<usize>().map_err(|e| Error::parameter("REPEAT", e.to_string(), "Write a number of copies"))?;
    let limits = Limits::default();
    let gaussians = repeated(&ply::read(Path::new(path), &limits)?, repeat);
    let context = CodecContext { dynamic_threshold: Some(f32::INFINITY), ..CodecContext::new(Seed::root(0), limits, &Silent) };
    let (encodes, decodes) = (times("ENCODES", 1).max(1), times("DECODES", 3));
    let per = |bytes: u64| rounded(bytes as f64 / gaussians.len().max(1) as f64, 3);
    let mut rows = Vec::new();
    for spec in specs {
        let (codec, facts) = codec_of(spec)?;
        let before = if rows.is_empty() { peak_mb() } else { None };
        let (mut streams, mut encode, mut encode_peak) = (Vec::new(), Vec::new(), None);
        for _ in 0..encodes {
            let began = Instant::now();
            streams = codec.encode(&gaussians, &context)?;
            encode.push(began.elapsed().as_secs_f64());
            if rows.is_empty() && encode.len() == 1 {
                encode_peak = peak_mb();
            }
            if encode.iter().sum::<f64>() > ENOUGH_S {
                break;
            }
        }
        let manifest = Manifest { frame_count: 1, gaussian_count: gaussians.len() as u64, ..Default::default() };
        let bytes = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, streams).to_bytes()?;
        let file = |variable: &str, end: &str| -> Option<PathBuf> {
            let folder = std::env::var_os(variable)?;
            Some(Path::new(&folder).join(spec.replace([':', '=', ';'], "-") + end))
        };
        for path in ["ARCHIVES", "DECODED"].into_iter().filter_map(|variable| file(variable, ".cc4d")) {
            std::fs::write(&path, &bytes).map_err(|e| Error::io(path, e))?;
        }
        let archive = Archive::from_bytes("memory", bytes, &limits)?;
        let (mut decode, mut decode_cpu) = (Vec::new(), Vec::new());
        for _ in 0..decodes {
            let streams = archive.read_kind(StreamKind::Canonical)?;
            let (began, cpu) = (Instant::now(), cpu_seconds());
            let found = codec.decode(&streams, &context)?;
            decode.push(began.elapsed().as_secs_f64());
            decode_cpu.push(cpu_seconds() - cpu);
            assert_eq!(found.len(), gaussians.len());
            if let Some(path) = file("DECODED", ".ply") {
                ply::write(path, &found, false)?;
            }
        }
        let streams: Map<String, Value> = archive.stream_sizes().into_iter().map(|s| (s.name, per(s.stored_bytes).into())).collect();
        let bytes = archive.total_bytes()?;
        let row = json!({
            "codec": spec,
            "plugin": facts,
            "gaussians": gaussians.len(),
            "bytes": bytes,
            "bytes_per_gaussian": per(bytes),
            "streams": streams,
            "decoded_bytes": array_bytes(&gaussians),
            "encodes": encode.len(),
            "encode_median_s": rounded(median(&encode), 3),
            "encode_least_s": rounded(least(&encode), 3),
            "loaded_peak_mb": before,
            "encode_peak_mb": encode_peak,
            "decodes": decode.len(),
            "decode_median_s": rounded(median(&decode), 4),
            "decode_least_s": rounded(least(&decode), 4),
            "decode_cpu_least_s": rounded(least(&decode_cpu), 4),
        });
        println!("{row}");
        rows.push(row);
    }
    Ok(rows)
}

/// Decodes the archive at `path` of the codec `spec`.
fn decode_alone(path: &str, spec: &str) -> Result<Value> {
    let limits = Limits::default();
    let context = CodecContext::new(Seed::root(0), limits, &Silent);
    let (codec, facts) = codec_of(spec)?;
    let began = Instant::now();
    let found = codec.decode(&Archive::open(path, &limits)?.read_kind(StreamKind::Canonical)?, &context)?;
    let seconds = rounded(began.elapsed().as_secs_f64(), 4);
    let row = json!({
        "codec": spec, "plugin": facts, "gaussians": found.len(), "decode_s": seconds, "decoded_bytes": array_bytes(&found), "peak_mb": peak_mb(),
    });
    println!("{row}");
    Ok(row)
}

/// Decodes the weights of the deformer of the archive at `path`, which is in memory; Zstandard is included.
fn decode_weights(path: &str) -> Result<Value> {
    let limits = Limits::default();
    let archive = Archive::from_bytes(path, limits.read_file(Path::new(path))?, &limits)?;
    let Some(deformer) = &archive.manifest().deformer else {
        return Err(Error::parameter(path, "the archive has no deformer", "Name one that `cc4dgs compress` made of a model with a deformer"));
    };
    let (mut values, mut decode, mut decode_cpu) = (0, Vec::new(), Vec::new());
    for _ in 0..times("DECODES", 3).max(1) {
        let (began, cpu) = (Instant::now(), cpu_seconds());
        let found = read_weights(path, &archive, &deformer.weights, None, &limits, &Silent)?;
        decode.push(began.elapsed().as_secs_f64());
        decode_cpu.push(cpu_seconds() - cpu);
        values = found.iter().map(|array| array.values.len()).sum::<usize>();
    }
    let weights = &deformer.weights;
    let row = json!({
        "deformer": deformer.name,
        "plugin": { "name": weights.name, "version": weights.version, "settings": weights.settings },
        "values": values,
        "bytes": archive.stream_sizes().iter().filter(|s| s.kind == StreamKind::Field).map(|s| s.stored_bytes).sum::<u64>(),
        "decodes": decode.len(),
        "decode_median_s": rounded(median(&decode), 5),
        "decode_least_s": rounded(least(&decode), 5),
        "decode_cpu_least_s": rounded(least(&decode_cpu), 5),
        "peak_mb": peak_mb(),
    });
    println!("{row}");
    Ok(row)
}

/// Bytes of all arrays.
fn array_bytes(gaussians: &HostGaussians) -> usize {
    let extra = gaussians.extra.values().map(|a| a.values.len()).sum::<usize>();
    size_of::<f32>() * (gaussians.columns().iter().map(|(_, _, values)| values.len()).sum::<usize>() + extra)
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

fn least(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}

fn rounded(value: f64, digits: i32) -> f64 {
    let unit = 10f64.powi(digits);
    (value * unit).round() / unit
}

/// The most memory that this process had so far, the program itself included, in MB; `None` where the system does not tell.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let kilobytes = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB")?.parse::<f64>().ok())?;
    Some(rounded(1.024e-3 * kilobytes, 1))
}

/// Vector extensions of the processor that kernels may choose from.
fn cpu_features() -> Vec<&'static str> {
    #[cfg(target_arch = "x86_64")]
    let known = [
        ("avx2", std::arch::is_x86_feature_detected!("avx2")),
        ("fma", std::arch::is_x86_feature_detected!("fma")),
        ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
    ];
    #[cfg(not(target_arch = "x86_64"))]
    let known: [(&str, bool); 0] = [];
    known.into_iter().filter(|(_, present)| *present).map(|(name, _)| name).collect()
}

/// Processor time of all threads, which does not depend on what else the machine does; 0 where the system does not tell.
fn cpu_seconds() -> f64 {
    let nanoseconds = |task: std::io::Result<std::fs::DirEntry>| {
        std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?.split_whitespace().next()?.parse::<f64>().ok()
    };
    std::fs::read_dir("/proc/self/task").map_or(0.0, |tasks| 1e-9 * tasks.filter_map(nanoseconds).sum::<f64>())
}

/// Copies of `gaussians` side by side, so that no two Gaussians are equal.
fn repeated(gaussians: &HostGaussians, repeat: usize) -> HostGaussians {
    let mut out = gaussians.select(&(0..gaussians.len() * repeat).map(|i| i % gaussians.len().max(1)).collect::<Vec<_>>());
    let wide = gaussians.means.iter().fold(0.0f32, |a, v| a.max(v.abs()));
    for (i, mean) in out.means.chunks_exact_mut(3).enumerate() {
        let copy = i / gaussians.len().max(1);
        mean[0] += 2.1 * wide * (copy % 3) as f32;
        mean[2] += 2.1 * wide * (copy / 3) as f32;
    }
    out
}
