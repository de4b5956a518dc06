//! Writes an archive with every codec into a folder and prints what each decodes to, as `CHECKSUM FILE`; with files instead of a folder it prints those.
//! CI compares with what `plugins_on_wasm` finds in the same files.
//!
//! `cargo run --release -p cc4dgs-codecs --example archives -- FOLDER | FILE...`

#![allow(clippy::print_stdout)]

#[path = "wasm/decoded.rs"]
mod decoded;

use cc4dgs_format::archive::{ArchiveWriter, CodecEntry, DeformerEntry, Manifest, StreamKind, write_atomically};
use cc4dgs_format::{
    CodecContext, CodecPlugin, DeformerContext, Entries, ExtraAttribute, HostGaussians, Limits, Result, Seed, Silent, WeightArray, WeightCodecPlugin, toml,
};
use std::path::{Path, PathBuf};

/// More than a block of 2^14.
const COUNT: usize = 20_000;
/// What decides the seed of everything.
const ROOT: u64 = 5;

fn main() -> Result<()> {
    cc4dgs_codecs::link();
    let given: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let files = match given.as_slice() {
        [folder] if folder.is_dir() => write_all(folder)?,
        _ => given,
    };
    for file in files {
        let bytes = std::fs::read(&file).map_err(|e| cc4dgs_format::Error::io(&file, e))?;
        println!("{:016x} {}", decoded::checksum(bytes)?, file.display());
    }
    Ok(())
}

/// An archive per codec, each with the next of the weight codecs.
fn write_all(folder: &Path) -> Result<Vec<PathBuf>> {
    let (codecs, weight_codecs) = (Entries::<CodecPlugin>::collect()?, Entries::<WeightCodecPlugin>::collect()?);
    let context = CodecContext { dynamic_threshold: Some(0.5), ..CodecContext::new(Seed::root(ROOT), Limits::default(), &Silent) };
    let gaussians = gaussians();
    let weights = [WeightArray { name: "table".into(), shape: vec![64, 48], values: (0..64 * 48).map(|i| draw(i, 8)).collect() }];
    let entry = |name: &str, settings: toml::Table| CodecEntry { name: name.into(), settings, ..Default::default() };
    let mut files = Vec::new();
    for (plugin, weight_plugin) in codecs.iter().zip(weight_codecs.iter().collect::<Vec<_>>().into_iter().cycle()) {
        let mut settings = toml::Table::new();
        if plugin.info.schema.contains("sample_budget") {
            settings.insert("sample_budget".into(), 20_000.into());
        }
        let (codec, weight_codec) = ((plugin.build)("", &settings)?, (weight_plugin.build)(&toml::Table::new())?);
        let deformer = DeformerEntry {
            name: "none".into(),
            version: String::new(),
            settings: toml::Table::new(),
            context: DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 2, seed: Seed::root(ROOT) },
            weights: entry(weight_plugin.info.name, toml::Table::new()),
        };
        let mut manifest = Manifest { codec: entry(plugin.info.name, settings), deformer: Some(deformer), frame_count: 2, ..Default::default() };
        (manifest.gaussian_count, manifest.sh_degree, manifest.provenance.seed) = (COUNT as u64, gaussians.sh_degree, ROOT);
        let writer = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, codec.encode(&gaussians, &context)?);
        let bytes = writer.add_all(StreamKind::Field, weight_codec.encode(&weights, &context)?).to_bytes()?;
        let file = folder.join(format!("{}.cc4d", plugin.info.name));
        write_atomically(&file, &bytes)?;
        files.push(file);
    }
    Ok(files)
}

/// A number from -1 to 1.
fn draw(index: usize, column: usize) -> f32 {
    (Seed::root(ROOT).index(index as u64).index(column as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

fn gaussians() -> HostGaussians {
    let mut out = HostGaussians { sh_degree: 2, opacity_logits: vec![0.0; COUNT], ..Default::default() };
    for (column, (name, width, values)) in out.columns_mut().into_iter().enumerate() {
        let shift = if name == "log_scales" { -4.0 } else { 0.0 };
        *values = (0..COUNT * width).map(|i| shift + draw(i, column)).collect();
    }
    out.extra.insert("life".into(), ExtraAttribute::exact(2, (0..2 * COUNT).map(|i| draw(i, 9)).collect()).within(0.01));
    out
}
