//! Compression of a stream: byte planes and Zstandard.

use super::StreamKind;
use super::zstandard::{compress, decompress};
use crate::{Error, Limits, Result, Stream};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use xxhash_rust::xxh3::xxh3_128;

/// The shuffle width is chosen on this many leading bytes of a stream, which bounds the time for long streams.
const TRIAL_BYTES: usize = 1 << 20;
/// Element sizes whose byte planes are tried.
const SHUFFLES: [u8; 3] = [0, 2, 4];

/// Encoding of the stored bytes of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Stored,
    Zstd,
}

impl Encoding {
    pub(super) fn code(self) -> u8 {
        match self {
            Self::Stored => 0,
            Self::Zstd => 1,
        }
    }
    pub(super) fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Stored),
            1 => Some(Self::Zstd),
            _ => None,
        }
    }
}

/// A stream as it is stored.
pub(super) struct Packed {
    pub(super) shuffle: u8,
    pub(super) encoding: Encoding,
    pub(super) bytes: Vec<u8>,
}

/// The streams of the archive that was made last, as they are stored, for an archive that has some of them too
/// ([`ArchiveWriter::reusing`](super::ArchiveWriter::reusing)): these are not compressed again. They are kept in memory.
#[derive(Default)]
pub struct PackedStreams {
    /// By a hash of the bytes before compression.
    last: Mutex<BTreeMap<u128, Arc<Packed>>>,
}

impl PackedStreams {
    /// Packs `streams`, in their order, and keeps the results instead of those of the archive before.
    pub(super) fn pack_all(&self, streams: &[(StreamKind, Stream)]) -> Result<Vec<Arc<Packed>>> {
        let known = std::mem::take(&mut *self.last());
        let keyed = |(_, stream): &(StreamKind, Stream)| -> Result<(u128, Arc<Packed>)> {
            let key = xxh3_128(&stream.bytes);
            let packed = match known.get(&key) {
                Some(packed) => Arc::clone(packed),
                None => Arc::new(pack(&stream.bytes)?),
            };
            Ok((key, packed))
        };
        let packed = streams.par_iter().map(keyed).collect::<Result<Vec<_>>>()?;
        self.last().extend(packed.iter().map(|(key, packed)| (*key, Arc::clone(packed))));
        Ok(packed.into_iter().map(|(_, packed)| packed).collect())
    }
    fn last(&self) -> MutexGuard<'_, BTreeMap<u128, Arc<Packed>>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Packs `bytes` in the smallest form.
fn pack(bytes: &[u8]) -> Result<Packed> {
    let (shuffle, trial) = best_shuffle(bytes)?;
    let compressed = if bytes.len() <= TRIAL_BYTES { trial } else { compress(&shuffled(bytes, shuffle))? };
    if compressed.len() < bytes.len() {
        Ok(Packed { shuffle, encoding: Encoding::Zstd, bytes: compressed })
    } else {
        Ok(Packed { shuffle: 0, encoding: Encoding::Stored, bytes: bytes.to_vec() })
    }
}

/// Estimated stored size of a stream in an archive, in bytes (exact up to 1 MiB), for encoders that choose between forms.
pub fn estimate_stored_len(bytes: &[u8]) -> Result<u64> {
    let (_, trial) = best_shuffle(bytes)?;
    let tried = bytes.len().clamp(1, TRIAL_BYTES) as f64;
    Ok((trial.len() as f64 * (bytes.len() as f64 / tried)).min(bytes.len() as f64) as u64)
}

/// The shuffle width that compresses the leading bytes best (no shuffle on a tie), and those bytes compressed.
fn best_shuffle(bytes: &[u8]) -> Result<(u8, Vec<u8>)> {
    let sample = &bytes[..bytes.len().min(TRIAL_BYTES)];
    let fits = |shuffle: &u8| *shuffle > 0 && sample.len() >= 2 * usize::from(*shuffle);
    let trial = |shuffle: u8| Ok((shuffle, compress(&shuffled(sample, shuffle))?));
    let trials = || SHUFFLES.into_par_iter().filter(fits).map(trial).collect::<Result<Vec<(u8, Vec<u8>)>>>();
    let (plain, trials) = rayon::join(|| compress(sample), trials);
    let mut best = (0, plain?);
    for (shuffle, trial) in trials? {
        if trial.len() < best.1.len() {
            best = (shuffle, trial);
        }
    }
    Ok(best)
}

/// Undoes [`pack`]: at most `decoded_len` bytes, which `limits` must allow. Memory grows with the bytes actually decoded.
pub(super) fn unpack(object: &str, stored: Vec<u8>, encoding: Encoding, shuffle: u8, decoded_len: u64, limits: &Limits) -> Result<Vec<u8>> {
    limits.check_bytes(object, decoded_len)?;
    let damaged = |problem: String| Error::data(object, problem, "The file is damaged; fetch or write it again");
    let planes = match encoding {
        Encoding::Stored => stored,
        Encoding::Zstd => decompress(&stored, decoded_len).map_err(damaged)?,
    };
    if planes.len() as u64 != decoded_len {
        let seen = if planes.len() as u64 > decoded_len { "more".to_string() } else { planes.len().to_string() };
        return Err(damaged(format!("{decoded_len} decoded bytes were declared, {seen} are there")));
    }
    Ok(unshuffled(planes, shuffle))
}

/// Byte planes of `width`-byte elements: all first bytes, all second bytes, ...; a partial last element follows unchanged.
fn shuffled(bytes: &[u8], width: u8) -> Vec<u8> {
    let width = usize::from(width);
    if width < 2 {
        return bytes.to_vec();
    }
    let whole = bytes.len() - bytes.len() % width;
    let mut out = Vec::with_capacity(bytes.len());
    for plane in 0..width {
        out.extend(bytes[..whole].iter().skip(plane).step_by(width));
    }
    out.extend_from_slice(&bytes[whole..]);
    out
}

fn unshuffled(planes: Vec<u8>, width: u8) -> Vec<u8> {
    let width = usize::from(width);
    if width < 2 {
        return planes;
    }
    let count = planes.len() / width;
    let mut out = planes.clone();
    for plane in 0..width {
        for (i, &byte) in planes[plane * count..(plane + 1) * count].iter().enumerate() {
            out[i * width + plane] = byte;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip(bytes: &[u8]) -> Packed {
        let packed = pack(bytes).unwrap();
        let back = unpack("test", packed.bytes.clone(), packed.encoding, packed.shuffle, bytes.len() as u64, &Limits::default()).unwrap();
        assert_eq!(back, bytes);
        packed
    }

    #[test]
    fn every_shape_of_stream_comes_back() {
        for n in [0usize, 1, 3, 4, 5, 7, 8, 1000, 1001, 1002, 1003] {
            round_trip(&(0..n).map(|i| (i * i % 251) as u8).collect::<Vec<_>>());
        }
        // Longer than TRIAL_BYTES, so that the choice on the leading bytes applies to the whole.
        let floats: Vec<u8> = (0..400_000).flat_map(|i| (1.0f32 + i as f32 * 1e-6).to_le_bytes()).collect();
        let packed = round_trip(&floats);
        assert_eq!(packed.shuffle, 4, "slowly varying floats compress better in byte planes");
    }

    #[test]
    fn what_the_archive_before_has_is_not_compressed_again() {
        let stream = |name: &str, text: &str| (StreamKind::Field, Stream { name: name.into(), bytes: text.repeat(50).into_bytes() });
        let (weights, first, second) = (stream("weights", "the same "), stream("means", "first "), stream("means", "second "));
        let reused = PackedStreams::default();
        let before = reused.pack_all(&[weights.clone(), first.clone()]).unwrap();
        let after = reused.pack_all(&[second.clone(), weights.clone()]).unwrap();
        assert!(Arc::ptr_eq(&before[0], &after[1]), "the weights were compressed twice");
        for ((_, stream), found) in [&second, &weights].into_iter().zip(&after) {
            let alone = pack(&stream.bytes).unwrap();
            assert!(found.bytes == alone.bytes && (found.shuffle, found.encoding) == (alone.shuffle, alone.encoding), "{}", stream.name);
        }
        // Streams of earlier archives are not kept.
        let again = reused.pack_all(&[first]).unwrap();
        assert!(!Arc::ptr_eq(&before[1], &again[0]) && before[1].bytes == again[0].bytes);
    }

    #[test]
    fn noise_is_stored_as_it_is() {
        let noise: Vec<u8> = (0u64..500).flat_map(|i| xxhash_rust::xxh3::xxh3_64(&i.to_le_bytes()).to_le_bytes()).collect();
        assert_eq!(round_trip(&noise).encoding, Encoding::Stored);
    }

    #[test]
    fn a_bomb_ends_at_its_declared_length() {
        let bomb = compress(&vec![0u8; 50 << 20]).unwrap();
        assert!(unpack("test", bomb.clone(), Encoding::Zstd, 0, 1000, &Limits::default()).is_err(), "its window is too large");
        let e = unpack("test", compress(&[0u8; 1500]).unwrap(), Encoding::Zstd, 0, 1400, &Limits::default()).unwrap_err().to_string();
        assert!(e.contains("1400 decoded bytes were declared, more are there"), "{e}");
        let small = Limits { max_bytes: 1 << 20, ..Limits::default() };
        let e = unpack("test", bomb, Encoding::Zstd, 0, 50 << 20, &small).unwrap_err().to_string();
        assert!(e.contains("max_bytes"), "{e}");
    }
}
