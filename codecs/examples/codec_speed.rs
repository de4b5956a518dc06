//! Bytes per stream and seconds of codecs on a PLY file, repeated to a larger model: `codec_speed FILE.ply REPEAT CODEC[:PROFILE][;SETTINGS]...`, JSON lines. Where the
//! variable `DECODED` names a folder, what was decoded is written there as PLY files, and the archives. `DECODES` is how often it decodes, the fastest counts; 3
//! by default. `codec_speed FILE.cc4d CODEC` decodes such an archive once in a process that has done nothing else, and says how much memory it had.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs_format::archive::{Archive, ArchiveWriter, Manifest, StreamKind};
use cc4dgs_format::{CodecContext, CodecPlugin, Entries, Error, HostGaussians, Limits, Result, Seed, Silent, ply, toml};
use std::path::Path;
use std::time::Instant;

fn main() -> Result<()> {
    cc4dgs_codecs::link();
    let arguments: Vec<String> = std::env::args().collect();
    if let [_, path, codec] = arguments.as_slice()
        && path.ends_with(".cc4d")
    {
        return decode_alone(path, codec);
    }
    let [_, path, repeat, specs @ ..] = arguments.as_slice() else {
        return Err(Error::parameter("codec_speed", "too few arguments", "Write codec_speed FILE.ply REPEAT CODEC[:PROFILE][;SETTINGS]..."));
    };
    let repeat = repeat.parse::<usize>().map_err(|e| Error::parameter("REPEAT", e.to_string(), "Write a number of copies"))?;
    let limits = Limits::default();
    let gaussians = repeated(&ply::read(Path::new(path), &limits)?, repeat);
    let context = CodecContext { dynamic_threshold: Some(f32::INFINITY), ..CodecContext::new(Seed::root(0), limits, &Silent) };
    let codecs = Entries::<CodecPlugin>::collect()?;
    let decodes = std::env::var("DECODES").ok().and_then(|v| v.parse().ok()).unwrap_or(3);
    for spec in specs {
        let (named, settings) = spec.split_once(';').unwrap_or((spec, ""));
        let (name, profile) = named.split_once(':').unwrap_or((named, ""));
        let settings = settings.parse().map_err(|e: toml::de::Error| Error::parameter("SETTINGS", e.to_string(), "Write TOML, such as layers=1"))?;
        let codec = (codecs.get(name)?.build)(profile, &settings)?;
        let began = Instant::now();
        let streams = codec.encode(&gaussians, &context)?;
        let encode = began.elapsed().as_secs_f64();
        let manifest = Manifest { frame_count: 1, gaussian_count: gaussians.len() as u64, ..Default::default() };
        let bytes = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, streams).to_bytes()?;
        let file = |end: &str| std::env::var_os("DECODED").map(|folder| Path::new(&folder).join(spec.replace([':', '='], "-") + end));
        if let Some(path) = file(".cc4d") {
            std::fs::write(&path, &bytes).map_err(|e| Error::io(path, e))?;
        }
        let archive = Archive::from_bytes("memory", bytes, &limits)?;
        let (mut decode, mut decode_cpu) = (f64::INFINITY, f64::INFINITY);
        for _ in 0..decodes {
            let streams = archive.read_kind(StreamKind::Canonical)?;
            let (began, cpu) = (Instant::now(), cpu_seconds());
            let found = codec.decode(&streams, &context)?;
            decode = decode.min(began.elapsed().as_secs_f64());
            decode_cpu = decode_cpu.min(cpu_seconds() - cpu);
            assert_eq!(found.len(), gaussians.len());
            if let Some(path) = file(".ply") {
                ply::write(path, &found, false)?;
            }
        }
        let per = |bytes: u64| (1000.0 * bytes as f64 / gaussians.len().max(1) as f64).round() / 1000.0;
        let streams: Vec<String> = archive.stream_sizes().iter().map(|s| format!("\"{}\":{}", s.name, per(s.stored_bytes))).collect();
        let bytes = archive.total_bytes()?;
        println!(
            "{{\"codec\":\"{spec}\",\"gaussians\":{},\"bytes\":{bytes},\"bytes_per_gaussian\":{},\"encode_s\":{encode:.3},\"decode_s\":{decode:.4},\"decode_cpu_s\":{decode_cpu:.4},\"streams\":{{{}}}}}",
            gaussians.len(),
            per(bytes),
            streams.join(",")
        );
    }
    Ok(())
}

/// Decodes the archive `path` of `codec`.
fn decode_alone(path: &str, codec: &str) -> Result<()> {
    let limits = Limits::default();
    let context = CodecContext::new(Seed::root(0), limits, &Silent);
    let codec = (Entries::<CodecPlugin>::collect()?.get(codec)?.build)("", &toml::Table::new())?;
    let began = Instant::now();
    let found = codec.decode(&Archive::open(path, &limits)?.read_kind(StreamKind::Canonical)?, &context)?;
    let seconds = began.elapsed().as_secs_f64();
    let floats = found.columns().iter().map(|(_, _, values)| values.len()).sum::<usize>() + found.extra.values().map(|a| a.values.len()).sum::<usize>();
    let decoded = 4e-6 * floats as f64;
    // kB, of the whole process with the program itself; absent where the system does not tell.
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let most = status.lines().find_map(|line| line.strip_prefix("VmHWM:")?.trim().strip_suffix(" kB")?.parse::<f64>().ok()).unwrap_or(f64::NAN) / 1e3;
    println!("{{\"gaussians\":{},\"decode_s\":{seconds:.4},\"decoded_mb\":{decoded:.1},\"peak_mb\":{most:.1}}}", found.len());
    Ok(())
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
