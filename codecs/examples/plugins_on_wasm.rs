//! Finds the codecs and reads an archive where there is neither C nor a file system. CI builds this for wasm32 and calls it from Node.

use cc4dgs_format::archive::{Archive, ArchiveWriter, CodecEntry, Manifest, StreamKind};
use cc4dgs_format::{CodecContext, CodecPlugin, Entries, HostGaussians, Limits, Result, Seed, Silent, WeightCodecPlugin, toml};

/// The number of codecs and weight codecs that were found.
#[unsafe(no_mangle)]
pub extern "C" fn plugin_count() -> u32 {
    cc4dgs_codecs::link();
    let codecs = Entries::<CodecPlugin>::collect().map_or(0, |found| found.iter().count());
    let weight_codecs = Entries::<WeightCodecPlugin>::collect().map_or(0, |found| found.iter().count());
    (codecs + weight_codecs) as u32
}

/// Writes an archive of `count` Gaussians and reads it; returns how many came back, 0 on any error.
#[unsafe(no_mangle)]
pub extern "C" fn archive_round_trip(count: u32) -> u32 {
    round_trip(count as usize).map_or(0, |found| found.len() as u32)
}

fn round_trip(count: usize) -> Result<HostGaussians> {
    let mut gaussians = HostGaussians { sh_degree: 1, opacity_logits: vec![0.0; count], ..Default::default() };
    for (_, width, values) in gaussians.columns_mut() {
        *values = (0..count * width).map(|i| (i as f32 * 0.1).sin()).collect();
    }
    let limits = Limits::default();
    let context = CodecContext::new(Seed::root(u64::from(count as u32)), limits, &Silent);
    let codecs = Entries::<CodecPlugin>::collect()?;
    let codec = (codecs.get("quantize")?.build)("", &toml::Table::new())?;
    let entry = CodecEntry { name: "quantize".into(), ..Default::default() };
    let manifest = Manifest { codec: entry, frame_count: 1, gaussian_count: count as u64, sh_degree: 1, ..Default::default() };
    let bytes = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, codec.encode(&gaussians, &context)?).to_bytes()?;
    let archive = Archive::from_bytes("memory", bytes, &limits)?;
    codec.decode(&archive.read_kind(StreamKind::Canonical)?, &context)
}
