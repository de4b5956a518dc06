//! Archives and PLY files that lie, end early or have flipped bits: an error that says what is wrong, never a panic, never a large allocation,
//! never half a file left behind.
//!
//! `tests/bad` at the root holds a corpus of them, made by the functions below. `CC4DGS_WRITE_BAD=1` writes it anew after the format changed. A program of its
//! own, because it watches every allocation.
#![allow(clippy::unwrap_used, reason = "tests: a failed helper is a failed test")]

#[path = "support/allocations.rs"]
mod allocations;

use allocations::{LARGEST, Watching};
use cc4dgs_format::archive::{Archive, ArchiveWriter, CodecEntry, FORMAT_VERSION, Manifest, StreamKind, write_atomically};
use cc4dgs_format::{Error, HostGaussians, Limits, Result, Stream, ply};
use proptest::prelude::*;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

#[global_allocator]
static ALLOCATOR: Watching = Watching;

/// The most a small hostile file may make a reader ask for at once. Zstandard's own tables and the test harness stay well below.
const ALLOCATION_CAP: usize = 16 << 20;

fn manifest() -> Manifest {
    Manifest { codec: CodecEntry { name: "raw".into(), ..Default::default() }, frame_count: 1, gaussian_count: 3, time_range: [0.0, 1.0], ..Default::default() }
}

fn sound() -> Vec<u8> {
    let stream = |name: &str, bytes: Vec<u8>| Stream { name: name.into(), bytes };
    ArchiveWriter::new(manifest())
        .add(StreamKind::Canonical, stream("means", (0..90u32).flat_map(|i| (i as f32 * 0.5).to_le_bytes()).collect()))
        .add(StreamKind::Field, stream("field", vec![7; 300]))
        .add(StreamKind::Meta, stream("noise", (0..40u64).map(|i| (i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as u8).collect()))
        .add(StreamKind::Other(200), stream("from the future", vec![1, 2, 3]))
        .add(StreamKind::Meta, stream("empty", vec![]))
        .to_bytes()
        .unwrap()
}

/// Opens and reads everything.
fn read_all(bytes: &[u8], limits: &Limits) -> Result<()> {
    let archive = Archive::from_bytes("test.cc4d", bytes.to_vec(), limits)?;
    for info in archive.stream_sizes() {
        archive.read_stream(&info.name)?;
    }
    Ok(())
}

fn gaussians() -> HostGaussians {
    let mut g = HostGaussians { sh_degree: 1, opacity_logits: vec![0.0; 3], ..Default::default() };
    for (_, width, values) in g.columns_mut() {
        *values = (0..3 * width).map(|i| 0.25 * i as f32 - 1.0).collect();
    }
    g
}

fn sound_ply() -> Vec<u8> {
    ply::to_bytes(&gaussians(), true).unwrap()
}

/// The decoded header of an archive, and what follows it.
fn header_and_streams(bytes: &[u8]) -> (Vec<u8>, &[u8]) {
    let word = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let end = 24 + word(12);
    (zstd::bulk::decompress(&bytes[28..end], word(24)).unwrap(), &bytes[end..])
}

/// Where the directory begins in a decoded header, as in the layout of the archive module.
fn directory_at(header: &[u8]) -> usize {
    4 + u32::from_le_bytes(header[..4].try_into().unwrap()) as usize
}

/// An archive with this decoded header and sound lengths and checksum, as a forger would make it.
fn with_header(header: &[u8], streams: &[u8]) -> Vec<u8> {
    with_stored_header(&[(header.len() as u32).to_le_bytes().to_vec(), zstd::bulk::compress(header, 19).unwrap()].concat(), streams)
}

/// An archive with this header as it is stored.
fn with_stored_header(stored: &[u8], streams: &[u8]) -> Vec<u8> {
    let mut out = sound()[..12].to_vec();
    out.extend((stored.len() as u32).to_le_bytes());
    out.extend(xxhash_rust::xxh3::xxh3_64(stored).to_le_bytes());
    out.extend(stored);
    out.extend(streams);
    out
}

/// [`sound`] with an edited header.
fn forged(edit: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let bytes = sound();
    let (mut header, streams) = header_and_streams(&bytes);
    edit(&mut header);
    with_header(&header, streams)
}

/// [`sound`] with a stored header of which `claimed` decoded bytes are claimed.
fn with_claim(claimed: u32) -> Vec<u8> {
    let bytes = sound();
    let (_, streams) = header_and_streams(&bytes);
    let mut stored = bytes[24..bytes.len() - streams.len()].to_vec();
    stored[..4].copy_from_slice(&claimed.to_le_bytes());
    with_stored_header(&stored, streams)
}

/// Replaces the manifest in a forged header.
fn with_manifest(json: &[u8]) -> Vec<u8> {
    forged(|header| {
        let end = directory_at(header);
        header.splice(..end, (json.len() as u32).to_le_bytes().into_iter().chain(json.iter().copied()));
    })
}

/// Overwrites bytes of the first directory entry ("means") in a forged header.
fn with_entry(offset: usize, value: &[u8]) -> Vec<u8> {
    forged(|header| {
        let at = directory_at(header) + 4 + offset;
        header[at..at + value.len()].copy_from_slice(value);
    })
}

fn ply_with(from: &str, to: &str) -> Vec<u8> {
    let bytes = sound_ply();
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(bytes[..end].to_vec()).unwrap();
    assert!(header.contains(from), "{from}");
    let mut out = header.replacen(from, to, 1).into_bytes();
    out.extend(&bytes[end..]);
    out
}

/// The corpus: file name, bytes, what the error must speak of.
fn bad_files() -> Vec<(&'static str, Vec<u8>, &'static str)> {
    let mut version = sound();
    version[8] = 9;
    let mut magic = sound();
    magic[4] = b'd';
    let mut flipped_stream = sound();
    let last = flipped_stream.len() - 50;
    flipped_stream[last] ^= 4;
    let mut flipped_header = sound();
    flipped_header[60] ^= 1;
    let mut header_claim = sound();
    header_claim[12..16].copy_from_slice(&u32::MAX.to_le_bytes());
    let trailing = [sound(), b"more".to_vec()].concat();
    let json = serde_json::to_string(&Manifest { format_version: FORMAT_VERSION, ..manifest() }).unwrap();
    let deep = json.replace("\"extra\":{}", &format!("\"extra\":{{\"a\":{}{}}}", "[".repeat(500), "]".repeat(500)));
    let huge = json.replace("\"gaussian_count\":3", "\"gaussian_count\":18446744073709551615");
    let infinite = json.replace("\"dynamic_threshold\":0.0", "\"dynamic_threshold\":1e200");
    let lies = u64::MAX.to_le_bytes();
    let nan = {
        let mut bytes = sound_ply();
        let at = bytes.len() - 4;
        bytes[at..].copy_from_slice(&f32::NAN.to_le_bytes());
        bytes
    };
    vec![
        ("empty.cc4d", vec![], "fewer"),
        ("not_an_archive.cc4d", magic, "wrong magic bytes"),
        ("version_9.cc4d", version, "version 9"),
        ("truncated.cc4d", sound()[..sound().len() - 1].to_vec(), "claims"),
        ("trailing.cc4d", trailing, "4 bytes follow the last stream"),
        ("flipped_stream.cc4d", flipped_stream, "checksum"),
        ("flipped_header.cc4d", flipped_header, "checksum of the header"),
        ("header_claims_4gb.cc4d", header_claim, "4294967295 bytes is claimed"),
        ("header_decodes_to_4gb.cc4d", with_claim(u32::MAX), "4294967295 is over the limit of 16777216"),
        ("header_decodes_to_more.cc4d", with_claim(99), "99 decoded bytes were declared"),
        ("header_is_no_frame.cc4d", with_stored_header(&[&[9, 0, 0, 0][..], &[9; 36]].concat(), &[]), "Zstandard frame"),
        ("manifest_deep.cc4d", with_manifest(deep.as_bytes()), "limit of 64"),
        ("manifest_not_json.cc4d", with_manifest(b"{\"format_version\":"), "manifest"),
        ("manifest_huge_count.cc4d", with_manifest(huge.as_bytes()), "max_gaussians"),
        ("manifest_infinite.cc4d", with_manifest(infinite.as_bytes()), "out of range"),
        ("stream_decodes_to_exabytes.cc4d", with_entry(9, &lies), "max_bytes"),
        ("stream_decodes_to_more.cc4d", with_entry(9, &4000u64.to_le_bytes()), "4000 decoded bytes were declared"),
        ("stream_decodes_to_less.cc4d", with_entry(9, &30u64.to_le_bytes()), "means"),
        ("stream_longer_than_file.cc4d", with_entry(17, &lies), "claims"),
        (
            "stream_count_4g.cc4d",
            forged(|h| {
                let at = directory_at(h);
                h[at..at + 4].copy_from_slice(&u32::MAX.to_le_bytes());
            }),
            "over the limit of 16384",
        ),
        ("stream_unknown_encoding.cc4d", with_entry(2, &[9]), "encoding 9"),
        ("stream_unknown_shuffle.cc4d", with_entry(1, &[3]), "shuffle 3"),
        ("stream_name_control.cc4d", with_entry(4, b"me\x07ns"), "printable"),
        ("stream_twice.cc4d", with_entry(4, b"field"), "called 'field'"),
        ("empty.ply", vec![], "header"),
        ("no_magic.ply", ply_with("ply\n", "plx\n"), "'ply'"),
        ("ascii.ply", ply_with("binary_little_endian", "ascii"), "ascii"),
        ("big_endian.ply", ply_with("little", "big"), "binary_big_endian"),
        ("truncated.ply", sound_ply()[..sound_ply().len() - 1].to_vec(), "need"),
        ("trailing.ply", [sound_ply(), vec![0]].concat(), "need"),
        ("count_lies.ply", ply_with("vertex 3", "vertex 2000000"), "need"),
        ("count_huge.ply", ply_with("vertex 3", "vertex 18446744073709551615"), "limit"),
        ("count_negative.ply", ply_with("vertex 3", "vertex -3"), "number of vertices"),
        ("count_missing.ply", ply_with("element vertex 3\n", ""), "not understood"),
        ("no_opacity.ply", ply_with("float opacity", "float opacitx"), "'opacity' is missing"),
        ("double_x.ply", ply_with("float x", "double x"), "need"),
        ("int_x.ply", ply_with("float x", "int x"), "int instead of float"),
        ("twice.ply", ply_with("float ny", "float nx"), "twice"),
        ("list.ply", ply_with("property float nx", "property list uchar int nx"), "not understood"),
        ("rest_odd.ply", ply_with("f_rest_8", "other_8"), "8 properties f_rest"),
        ("rest_gap.ply", ply_with("f_rest_8", "f_rest_9"), "'f_rest_8' is missing"),
        ("compressed.ply", ply_with("element vertex 3", "element chunk 1\nproperty float min_x\nelement vertex 3"), "chunk"),
        ("no_end.ply", ply_with("end_header\n", "end_headr\n"), "not understood"),
        ("nan.ply", nan, "NaN"),
    ]
}

fn attempt(name: &str, bytes: &[u8]) -> Result<()> {
    if name.ends_with(".ply") { ply::from_bytes(name, bytes, &Limits::default()).map(|_| ()) } else { read_all(bytes, &Limits::default()) }
}

#[test]
fn the_corpus_is_refused_with_the_reason() {
    let folder = PathBuf::from("../../tests/bad");
    let write = std::env::var_os("CC4DGS_WRITE_BAD").is_some();
    let files = bad_files();
    for (name, bytes, reason) in &files {
        let path = folder.join(name);
        if write {
            write_atomically(&path, bytes).unwrap();
        }
        let stored = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(stored == *bytes, "{name} is not what the generator makes; did the format change?");
        assert!(stored.len() < 4096, "{name} is not small");
        let before = LARGEST.swap(0, Ordering::Relaxed);
        let e = attempt(name, &stored).err().unwrap_or_else(|| panic!("{name} was taken")).to_string();
        let largest = LARGEST.fetch_max(before, Ordering::Relaxed);
        assert!(e.contains(reason), "{name}: '{e}' does not speak of '{reason}'");
        assert!(e.contains(". "), "{name}: '{e}' names no remedy");
        assert!(largest < ALLOCATION_CAP, "{name} made the reader ask for {largest} bytes");
    }
    let ours = |p: &PathBuf| p.extension().is_some_and(|e| e == "cc4d" || e == "ply");
    let listed = std::fs::read_dir(&folder).unwrap().map(|e| e.unwrap().path()).filter(ours).count();
    assert_eq!(listed, files.len(), "a file in tests/bad has no generator");
}

#[test]
fn sound_files_are_taken() {
    read_all(&sound(), &Limits::default()).unwrap();
    assert_eq!(sound(), sound(), "equal inputs give equal bytes");
    let read = ply::from_bytes("t", &sound_ply(), &Limits::default()).unwrap().gaussians;
    assert_eq!(read, gaussians());
    // A kind of a later writer is listed and does not disturb.
    let archive = Archive::from_bytes("t", sound(), &Limits::default()).unwrap();
    assert_eq!(archive.stream_sizes().iter().filter(|s| s.kind == StreamKind::Other(200)).count(), 1);
    assert_eq!(archive.read_kind(StreamKind::Canonical).unwrap().len(), 1);
    let e = archive.read_stream("mean").unwrap_err().to_string();
    assert!(e.contains("means"), "{e}");
}

#[test]
fn one_stream_is_readable_when_another_is_damaged() {
    let mut bytes = sound();
    let archive = Archive::from_bytes("t", bytes.clone(), &Limits::default()).unwrap();
    let sizes = archive.stream_sizes();
    let stored: u64 = sizes.iter().map(|s| s.stored_bytes).sum();
    let field_at = bytes.len() - stored as usize + sizes[0].stored_bytes as usize;
    bytes[field_at] ^= 0xff;
    let archive = Archive::from_bytes("t", bytes, &Limits::default()).unwrap();
    assert_eq!(archive.read_stream("means").unwrap().len(), 360);
    assert!(archive.read_stream("field").unwrap_err().to_string().contains("field"));
}

#[test]
fn every_truncation_is_an_error() {
    let (archive, ply) = (sound(), sound_ply());
    for cut in 0..archive.len() {
        assert!(read_all(&archive[..cut], &Limits::default()).is_err(), "archive cut at {cut}");
    }
    for cut in 0..ply.len() {
        assert!(ply::from_bytes("t", &ply[..cut], &Limits::default()).is_err(), "ply cut at {cut}");
    }
}

#[test]
fn every_flipped_bit_of_an_archive_is_noticed() {
    let mut bytes = sound();
    for at in 0..bytes.len() {
        for bit in 0..8 {
            bytes[at] ^= 1 << bit;
            assert!(read_all(&bytes, &Limits::default()).is_err(), "bit {bit} of byte {at}");
            bytes[at] ^= 1 << bit;
        }
    }
}

#[test]
fn flipped_bits_of_a_ply_never_panic() {
    let mut bytes = sound_ply();
    for at in 0..bytes.len() {
        for bit in 0..8 {
            bytes[at] ^= 1 << bit;
            if let Ok(file) = ply::from_bytes("t", &bytes, &Limits::default()) {
                file.gaussians.validate("t", &Limits::default()).unwrap();
            }
            bytes[at] ^= 1 << bit;
        }
    }
}

#[test]
fn limits_are_obeyed() {
    let tight = Limits { max_bytes: 299, ..Limits::default() };
    assert!(matches!(read_all(&sound(), &tight), Err(Error::Limit { .. })));
    let few = Limits { max_gaussians: 2, ..Limits::default() };
    assert!(matches!(read_all(&sound(), &few), Err(Error::Limit { value: 3, limit: 2, .. })));
    assert!(matches!(ply::from_bytes("t", &sound_ply(), &few), Err(Error::Limit { value: 3, limit: 2, .. })));
    // Streams that are read together count together.
    let three = (0..3u8).map(|i| Stream { name: format!("s{i}"), bytes: vec![i; 4000] });
    let bytes = ArchiveWriter::new(manifest()).add_all(StreamKind::Canonical, three).to_bytes().unwrap();
    let archive = Archive::from_bytes("t", bytes, &Limits { max_bytes: 10_000, ..Limits::default() }).unwrap();
    assert_eq!(archive.read_stream("s1").unwrap(), vec![1; 4000]);
    assert!(matches!(archive.read_kind(StreamKind::Canonical), Err(Error::Limit { value: 12_000, limit: 10_000, .. })));
    let shallow = Limits { max_depth: 1, ..Limits::default() };
    assert!(matches!(read_all(&sound(), &shallow), Err(Error::Limit { .. })));
}

#[test]
fn a_failed_write_leaves_the_old_file_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.cc4d");
    ArchiveWriter::new(manifest()).write_to(&path).unwrap();
    let old = std::fs::read(&path).unwrap();
    let twice = ["a", "a"].map(|name| Stream { name: name.into(), bytes: vec![] });
    assert!(ArchiveWriter::new(manifest()).add_all(StreamKind::Meta, twice).write_to(&path).is_err());
    assert!(ArchiveWriter::new(Manifest { dynamic_threshold: f32::NAN, ..manifest() }).write_to(&path).is_err());
    let mut broken = gaussians();
    broken.means[0] = f32::INFINITY;
    assert!(ply::write(&path, &broken, true).is_err());
    // The target is a folder: the rename fails after the temporary file was written.
    let occupied = folder.path().join("folder");
    std::fs::create_dir(&occupied).unwrap();
    assert!(ArchiveWriter::new(manifest()).write_to(&occupied).is_err());
    assert!(ply::write(folder.path().join("missing/x.ply"), &gaussians(), true).is_err());
    assert_eq!(std::fs::read(&path).unwrap(), old);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "temporary files are left behind");
    assert!(matches!(Archive::open(folder.path().join("absent.cc4d"), &Limits::default()), Err(Error::Io { .. })));
    assert!(Archive::open(&occupied, &Limits::default()).is_err(), "a folder is no archive");
}

#[test]
fn files_on_disk_read_as_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.cc4d");
    let size = ArchiveWriter::new(manifest()).add(StreamKind::Field, Stream { name: "w".into(), bytes: vec![3; 9999] }).write_to(&path).unwrap();
    let archive = Archive::open(&path, &Limits::default()).unwrap();
    assert_eq!((archive.total_bytes().unwrap(), archive.manifest().gaussian_count), (size, 3));
    assert_eq!(archive.read_stream("w").unwrap(), vec![3; 9999]);
    assert!(size < 2000);
    let ply_path = folder.path().join("m.ply");
    ply::write(&ply_path, &gaussians(), false).unwrap();
    assert_eq!(ply::read(&ply_path, &Limits::default()).unwrap().means, gaussians().means);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]
    #[test]
    fn archives_round_trip(streams in proptest::collection::vec((0u8..5, proptest::collection::vec(any::<u8>(), 0..600)), 0..6)) {
        let kind = |k: u8| [StreamKind::Canonical, StreamKind::Field, StreamKind::Meta, StreamKind::Playback, StreamKind::Other(255)][usize::from(k)];
        let mut writer = ArchiveWriter::new(manifest());
        for (i, (k, bytes)) in streams.iter().enumerate() {
            writer = writer.add(kind(*k), Stream { name: format!("s{i}"), bytes: bytes.clone() });
        }
        let archive = Archive::from_bytes("t", writer.to_bytes().unwrap(), &Limits::default()).unwrap();
        for (i, (k, bytes)) in streams.iter().enumerate() {
            prop_assert_eq!(&archive.read_stream(&format!("s{i}")).unwrap(), bytes);
            prop_assert_eq!(archive.stream_sizes()[i].kind, kind(*k));
        }
    }
    #[test]
    fn forged_headers_never_panic(edits in proptest::collection::vec((any::<u16>(), any::<u8>()), 1..8)) {
        let bytes = forged(|header| {
            for &(at, value) in &edits {
                let at = usize::from(at) % header.len();
                header[at] = value;
            }
        });
        read_all(&bytes, &Limits { max_bytes: 1 << 20, ..Limits::default() }).ok();
    }
    #[test]
    fn forged_streams_never_panic(at in any::<u16>(), value in any::<u8>()) {
        // The stream's checksum is mended too, so that the damage reaches Zstandard.
        let bytes = sound();
        let stored = Archive::from_bytes("t", bytes.clone(), &Limits::default()).unwrap().stream_sizes()[0].stored_bytes as usize;
        let (mut header, streams) = header_and_streams(&bytes);
        let mut streams = streams.to_vec();
        streams[usize::from(at) % stored] = value;
        let entry = directory_at(&header) + 4 + 4 + 5 + 16;
        header[entry..entry + 8].copy_from_slice(&xxhash_rust::xxh3::xxh3_64(&streams[..stored]).to_le_bytes());
        let bytes = with_header(&header, &streams);
        let archive = Archive::from_bytes("t", bytes, &Limits::default()).unwrap();
        if let Ok(decoded) = archive.read_stream("means") {
            prop_assert_eq!(decoded.len(), 360);
        }
    }
}
