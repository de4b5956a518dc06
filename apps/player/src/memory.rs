//! The memory that a model takes while it opens, estimated before it is decoded. Where WebAssembly runs out of memory in between, nothing of the module can be
//! called any more, and the page would have to be loaded again.

use crate::scene::GAUSSIAN_FLOATS;
use cc4dgs_format::archive::{Archive, StreamKind};
use cc4dgs_format::gaussians::sh_rest_len;
use cc4dgs_format::{Error, Result, spz};

/// Bytes at most on wasm32: an eighth of its 4 GiB is left to everything else.
const MOST: u64 = (1 << 32) / 8 * 7;
/// Memory is asked for in blocks of so many bytes, which fit between what is in use.
const BLOCK: u64 = 64 << 20;
/// What a gzipped SPZ file takes per byte that it holds unpacked: that byte, and ten for its Gaussians, no less than `of_gaussians` says at any degree.
const OF_SPZ_BYTE: u64 = 11;
/// What a PLY file takes per byte of its own.
const OF_PLY_BYTE: u64 = 3;

/// Names of streams with the ranks of a playback layer end so; what a rank takes beside three bytes of its own.
const RANKS: &str = ".ranks";
const OF_RANK: u64 = 8;

/// Bytes for `count` Gaussians: twice as floats, since arrays are copied and grow by doubling, and once as the GPU reads them.
fn of_gaussians(count: u64, sh_degree: usize) -> u64 {
    let rest = 3 * sh_rest_len(sh_degree) as u64;
    let (floats, scene) = (4 * (15 + rest), 4 * (GAUSSIAN_FLOATS as u64 + rest.div_ceil(2)));
    count.saturating_mul(2 * floats + scene)
}

/// Bytes for an archive beside the file itself. Motion that is computed from weights is not counted: its evaluation, weights included, has a limit of its
/// own.
fn of_archive(archive: &Archive) -> u64 {
    let (manifest, streams) = (archive.manifest(), archive.stream_sizes());
    let decoded = |kind: StreamKind| streams.iter().filter(|s| s.kind == kind).fold(0, |sum: u64, s| sum.saturating_add(s.decoded_bytes));
    // A layer is there as streams, as tracks and as the arrays of the scene. A rank, one byte of a stream, is a sum of four bytes in the tracks and in the
    // scene.
    let ranks = streams.iter().filter(|s| s.kind == StreamKind::Playback && s.name.ends_with(RANKS)).fold(0, |sum: u64, s| sum.saturating_add(s.decoded_bytes));
    let layer = decoded(StreamKind::Playback).saturating_mul(3).saturating_add(ranks.saturating_mul(OF_RANK));
    of_gaussians(manifest.gaussian_count, manifest.sh_degree).saturating_add(decoded(StreamKind::Canonical)).saturating_add(layer)
}

/// Bytes for a PLY or SPZ file beside the file itself.
fn of_file(bytes: &[u8]) -> u64 {
    let word = |at: usize| bytes.get(at..).and_then(|rest| rest.first_chunk::<4>()).map_or(0, |word| u64::from(u32::from_le_bytes(*word)));
    if bytes.starts_with(&spz::PLAIN_MAGIC) {
        let (count, sh_degree) = (word(8), usize::from(bytes.get(12).copied().unwrap_or(0)).min(4));
        return of_gaussians(count, sh_degree).saturating_add(count * (20 + 3 * sh_rest_len(sh_degree) as u64));
    }
    if spz::begins_as_spz(bytes) {
        // The last word of a gzip stream is the number of bytes in it.
        return OF_SPZ_BYTE * word(bytes.len().saturating_sub(4));
    }
    OF_PLY_BYTE * bytes.len() as u64
}

/// How many of `wanted` bytes can be allocated. They are free again afterwards.
fn allocatable(wanted: u64) -> u64 {
    let mut blocks: Vec<Vec<u8>> = Vec::new();
    let mut found = 0;
    while found < wanted {
        let bytes = BLOCK.min(wanted - found);
        let mut block = Vec::new();
        if block.try_reserve_exact(bytes as usize).is_err() {
            break;
        }
        found += bytes;
        blocks.push(block);
        // Compilers may leave out allocations that nobody looks at.
        std::hint::black_box(&mut blocks);
    }
    found
}

/// Refuses `object` where the page cannot have the `bytes` of memory that it takes. Elsewhere than on wasm32 nothing is refused.
pub(crate) fn check(object: &str, bytes: u64) -> Result<()> {
    if !cfg!(target_arch = "wasm32") {
        return Ok(());
    }
    // What WebAssembly has once taken from the browser it keeps.
    let found = if bytes > MOST { MOST } else { allocatable(bytes) };
    if found < bytes {
        let remedy = "Close other pages, or open it on the desktop: cc4dgs view FILE";
        return Err(Error::limit(format!("memory to open {object}, in bytes"), bytes, found, remedy));
    }
    Ok(())
}

/// [`check`] for an archive whose header has arrived.
pub(crate) fn check_archive(object: &str, archive: &Archive) -> Result<()> {
    check(object, of_archive(archive))
}

/// [`check`] for the whole of a PLY or SPZ file.
pub(crate) fn check_file(object: &str, bytes: &[u8]) -> Result<()> {
    check(object, of_file(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cc4dgs_format::archive::{ArchiveWriter, Manifest};
    use cc4dgs_format::playback::{CodedTrack, Head, PlaybackLayer};
    use cc4dgs_format::spz::{SpzOptions, to_spz};
    use cc4dgs_format::{HostGaussians, Limits, ply};

    /// `count` Gaussians of degree `sh_degree`, all alike.
    fn sample(count: usize, sh_degree: usize) -> HostGaussians {
        HostGaussians {
            sh_degree,
            means: vec![0.0; 3 * count],
            log_scales: vec![0.0; 3 * count],
            quaternions: [1.0, 0.0, 0.0, 0.0].repeat(count),
            opacity_logits: vec![0.0; count],
            sh_dc: vec![0.0; 3 * count],
            sh_rest: vec![0.0; 3 * sh_rest_len(sh_degree) * count],
            dynamic_scores: vec![0.0; count],
            ..Default::default()
        }
    }

    #[test]
    fn estimates_of_files_cover_their_gaussians() {
        for degree in 0..=4 {
            let (gaussians, least) = (sample(1000, degree), of_gaussians(1000, degree));
            let files = [
                ply::to_bytes(&gaussians, false).unwrap(),
                to_spz(&gaussians, &SpzOptions::version(3)).unwrap(),
                to_spz(&gaussians, &SpzOptions::version(4)).unwrap(),
            ];
            for file in files {
                let estimate = of_file(&file);
                assert!((least..2 * least).contains(&estimate), "degree {degree}: {estimate} for {least}");
            }
        }
    }

    #[test]
    fn estimates_of_layers_cover_the_sums_of_their_ranks() {
        // The last of a thousand Gaussians uses a function, at a single time.
        let ranks: Vec<u8> = (0..1000).map(|row| u8::from(row == 999)).collect();
        let track =
            CodedTrack { head: Head::Opacities, peaks: vec![1.0], functions: vec![1], ranks, step: 1.0, exponents: vec![0; 1000], coefficients: vec![1] };
        let rows: Vec<usize> = (0..1000).collect();
        let streams = PlaybackLayer::encode(&rows, 0, 1, &[(0, vec![track])]).unwrap();
        let stored: u64 = streams.iter().map(|stream| stream.bytes.len() as u64).sum();
        let writer = ArchiveWriter::new(Manifest { frame_count: 1, ..Default::default() }).add_all(StreamKind::Playback, streams);
        let archive = Archive::from_bytes("t", writer.to_bytes().unwrap(), &Limits::default()).unwrap();
        // Ranks have 1000 bytes, and their sums four times as many in the track and again in the scene.
        assert_eq!(of_archive(&archive), 3 * stored + 8 * 1000);
    }

    #[test]
    fn four_million_gaussians_fit_into_wasm32_and_six_do_not() {
        assert!(of_gaussians(4_000_000, 3) < MOST && of_gaussians(6_000_000, 3) > MOST);
        assert!(of_gaussians(u64::MAX, 4) > MOST);
    }

    #[test]
    fn memory_is_found_in_blocks() {
        assert_eq!([0, 5, BLOCK + 1].map(allocatable), [0, 5, BLOCK + 1]);
    }
}
