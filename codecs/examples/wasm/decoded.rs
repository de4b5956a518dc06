//! What an archive decodes to, as a checksum that must be the same on every machine.

use cc4dgs_format::archive::Archive;
use cc4dgs_format::{HostGaussians, Limits, Result, Silent, canonical_stages, read_gaussians, read_stage, read_weights};
use xxhash_rust::xxh3::Xxh3;

/// XXH3-64 over the bits of all Gaussians of an archive, of what a player draws at each stage of loading, and of all weights.
pub fn checksum(bytes: Vec<u8>) -> Result<u64> {
    cc4dgs_codecs::link();
    let (object, limits) = ("archive", Limits::default());
    let archive = Archive::from_bytes(object, bytes, &limits)?;
    let mut hash = Xxh3::new();
    let mut add = |values: &[f32]| values.iter().for_each(|v| hash.update(&v.to_bits().to_le_bytes()));
    let mut add_all = |gaussians: &HostGaussians| {
        gaussians.columns().iter().for_each(|(_, _, values)| add(values));
        gaussians.extra.values().for_each(|attribute| add(&attribute.values));
    };
    add_all(&read_gaussians(object, &archive, &limits, &Silent)?);
    let mut stages = canonical_stages(object, &archive)?;
    stages.sort_unstable();
    stages.dedup();
    for stage in stages {
        add_all(&read_stage(object, &archive, stage, &limits, &Silent)?);
    }
    if let Some(deformer) = &archive.manifest().deformer {
        read_weights(object, &archive, &deformer.weights, None, &limits, &Silent)?.iter().for_each(|array| add(&array.values));
    }
    Ok(hash.digest())
}
