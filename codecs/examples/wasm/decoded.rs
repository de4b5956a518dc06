//! What an archive decodes to, as a checksum that must be the same on every machine.

use cc4dgs_format::archive::{Archive, StreamKind};
use cc4dgs_format::{CodecContext, CodecPlugin, Entries, Limits, Result, Seed, Silent, WeightCodecPlugin};
use xxhash_rust::xxh3::Xxh3;

/// XXH3-64 over the bits of all Gaussians and weights of an archive.
pub fn checksum(bytes: Vec<u8>) -> Result<u64> {
    cc4dgs_codecs::link();
    let limits = Limits::default();
    let archive = Archive::from_bytes("archive", bytes, &limits)?;
    let manifest = archive.manifest().clone();
    let context = CodecContext::new(Seed::root(manifest.provenance.seed), limits, &Silent);
    let mut hash = Xxh3::new();
    let mut add = |values: &[f32]| values.iter().for_each(|v| hash.update(&v.to_bits().to_le_bytes()));

    let codec = (Entries::<CodecPlugin>::collect()?.get(&manifest.codec.name)?.build)(&manifest.codec.profile, &manifest.codec.settings)?;
    let gaussians = codec.decode(&archive.read_kind(StreamKind::Canonical)?, &context)?;
    gaussians.columns().iter().for_each(|(_, _, values)| add(values));
    gaussians.extra.values().for_each(|attribute| add(&attribute.values));
    if let Some(deformer) = manifest.deformer {
        let codec = (Entries::<WeightCodecPlugin>::collect()?.get(&deformer.weights.name)?.build)(&deformer.weights.settings)?;
        codec.decode(&archive.read_kind(StreamKind::Field)?, &context)?.iter().for_each(|array| add(&array.values));
    }
    Ok(hash.digest())
}
