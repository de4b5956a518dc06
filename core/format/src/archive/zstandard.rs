//! Zstandard: the C library, or a Rust implementation on `wasm32`. Both decoders have the same bounds.

use crate::Error;
use crate::Result;
use std::io::Read;

/// First bytes of a Zstandard frame.
const MAGIC: [u8; 4] = 0xfd2f_b528u32.to_le_bytes();
/// Largest window that a frame may require, in bytes. Level 19 requires 8 MiB.
const LARGEST_WINDOW: u64 = 128 << 20;
/// Every frame may require the window of one block, as the encoder on `wasm32` always does.
const SMALLEST_WINDOW: u64 = 128 << 10;
/// Initial capacity of a decoder in bytes; more is allocated only for decoded bytes.
const FIRST_CAPACITY: u64 = 1 << 20;

#[cfg(not(target_arch = "wasm32"))]
use c_library as library;
#[cfg(target_arch = "wasm32")]
use rust_library as library;

/// One frame of `bytes`.
pub(crate) fn compress(bytes: &[u8]) -> Result<Vec<u8>> {
    library::compress(bytes).map_err(|problem| Error::backend("Zstandard", problem, "Free some memory and try again"))
}

/// Decodes `frame`, which must be a single frame that fills the bytes: at most `decoded_len` + 1 bytes, so that the caller sees a frame that is too long.
/// The error is the problem as text.
pub(crate) fn decompress(frame: &[u8], decoded_len: u64) -> Result<Vec<u8>, String> {
    let window = check_window(frame, decoded_len)?;
    library::decompress(frame, decoded_len, window)
}

/// Refuses frames that require a larger window than a stream of `decoded_len` bytes can need. Returns the largest allowed window in bytes.
fn check_window(frame: &[u8], decoded_len: u64) -> Result<u64, String> {
    let allowed = decoded_len.saturating_mul(2).clamp(SMALLEST_WINDOW, LARGEST_WINDOW).next_power_of_two();
    match frame_window(frame) {
        None => Err("it does not begin with a Zstandard frame".into()),
        Some(window) if window > allowed => Err(format!("its Zstandard frame requires a window of {window} bytes, {allowed} are allowed")),
        Some(_) => Ok(allowed),
    }
}

/// The window that a frame's header requires, in bytes (RFC 8878, section 3.1.1.1); `None` without a complete header.
fn frame_window(frame: &[u8]) -> Option<u64> {
    let descriptor = *frame.strip_prefix(&MAGIC)?.first()?;
    let single_segment = descriptor & 0x20 != 0;
    if !single_segment {
        let window = *frame.get(5)?;
        let base = 1u64 << (10 + u32::from(window >> 3));
        return Some(base + base / 8 * u64::from(window & 7));
    }
    // A single segment: the window is the content size, which follows the dictionary identifier.
    let size_at = 5 + [0, 1, 2, 4][usize::from(descriptor & 3)];
    let size_len = [1, 2, 4, 8][usize::from(descriptor >> 6)];
    let bytes = frame.get(size_at..size_at + size_len)?;
    let size = bytes.iter().rev().fold(0u64, |size, &byte| size << 8 | u64::from(byte));
    Some(if size_len == 2 { size + 256 } else { size })
}

#[cfg(not(target_arch = "wasm32"))]
mod c_library {
    use super::{FIRST_CAPACITY, Read};

    /// Level for archives (paper Section IV-D names Zstandard; 19 is the highest level without long-window memory).
    const LEVEL: i32 = 19;

    pub(super) fn compress(bytes: &[u8]) -> Result<Vec<u8>, String> {
        zstd::bulk::compress(bytes, LEVEL).map_err(|e| e.to_string())
    }

    pub(super) fn decompress(frame: &[u8], decoded_len: u64, window: u64) -> Result<Vec<u8>, String> {
        let mut decoder = zstd::stream::read::Decoder::with_buffer(frame).map_err(|e| e.to_string())?.single_frame();
        decoder.window_log_max(window.ilog2()).map_err(|e| e.to_string())?;
        let mut out = Vec::with_capacity(decoded_len.min(FIRST_CAPACITY) as usize);
        decoder.by_ref().take(decoded_len.saturating_add(1)).read_to_end(&mut out).map_err(|e| format!("Zstandard: {e}"))?;
        let rest = decoder.finish();
        if out.len() as u64 == decoded_len && !rest.is_empty() {
            return Err(format!("{} bytes follow the Zstandard frame", rest.len()));
        }
        Ok(out)
    }
}

#[cfg(any(target_arch = "wasm32", test))]
mod rust_library {
    use super::{FIRST_CAPACITY, Read};
    use ruzstd::decoding::StreamingDecoder;
    use ruzstd::encoding::{CompressionLevel, compress_to_vec};

    pub(super) fn compress(bytes: &[u8]) -> Result<Vec<u8>, String> {
        Ok(compress_to_vec(bytes, CompressionLevel::Fastest))
    }

    pub(super) fn decompress(frame: &[u8], decoded_len: u64, window: u64) -> Result<Vec<u8>, String> {
        let said = |e: &dyn std::fmt::Display| format!("Zstandard: {e}");
        let mut decoder = StreamingDecoder::new_with_max_window_size(frame, window).map_err(|e| said(&e))?;
        let mut out = Vec::with_capacity(decoded_len.min(FIRST_CAPACITY) as usize);
        decoder.by_ref().take(decoded_len.saturating_add(1)).read_to_end(&mut out).map_err(|e| said(&e))?;
        if out.len() as u64 > decoded_len {
            return Ok(out);
        }
        let (rest, frame) = decoder.into_parts();
        match (frame.get_checksum_from_data(), frame.get_calculated_checksum()) {
            (Some(stored), Some(found)) if stored != found => Err("Zstandard: the checksum of the content does not match".into()),
            _ if !rest.is_empty() => Err(format!("{} bytes follow the Zstandard frame", rest.len())),
            _ => Ok(out),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Seed;

    fn both(frame: &[u8], decoded_len: u64) -> [Result<Vec<u8>, String>; 2] {
        let window = match check_window(frame, decoded_len) {
            Ok(window) => window,
            Err(e) => return [Err(e.clone()), Err(e)],
        };
        [c_library::decompress(frame, decoded_len, window), rust_library::decompress(frame, decoded_len, window)]
    }

    /// Streams of several kinds: empty, text-like, floats in planes, noise, long runs.
    fn payloads() -> Vec<Vec<u8>> {
        let noise = |n: u64| (0..n).flat_map(|i| Seed::root(5).index(i).value().to_le_bytes()).collect::<Vec<u8>>();
        vec![
            Vec::new(),
            vec![7],
            b"one level, two levels, three levels, ".repeat(400),
            (0..30_000).flat_map(|i| (1.0f32 + i as f32 * 1e-4).sin().to_le_bytes()).collect(),
            noise(5000),
            vec![0; 3 << 20],
        ]
    }

    #[test]
    fn both_libraries_decode_what_either_encodes() {
        for payload in payloads() {
            for frame in [c_library::compress(&payload).unwrap(), rust_library::compress(&payload).unwrap()] {
                for decoded in both(&frame, payload.len() as u64) {
                    assert!(decoded.unwrap() == payload);
                }
            }
        }
    }

    #[test]
    fn both_libraries_refuse_bombs_and_large_windows() {
        let bomb = c_library::compress(&vec![0u8; 50 << 20]).unwrap();
        for refused in both(&bomb, 1000) {
            assert!(refused.unwrap_err().contains("window"));
        }
        // A window that fits and content that does not: decoding stops one byte after the declared length.
        let frame = c_library::compress(&[0u8; 1500]).unwrap();
        for decoded in both(&frame, 1400) {
            assert_eq!(decoded.unwrap().len(), 1401);
        }
        // No content size, the largest window that a header can state.
        let mut wide = MAGIC.to_vec();
        wide.extend([0x00, 0xff, 0x01, 0x00, 0x00]);
        assert_eq!(frame_window(&wide), Some((1 << 41) + 7 * (1 << 38)));
        for refused in both(&wide, u64::MAX) {
            assert!(refused.unwrap_err().contains("window"));
        }
        // The decoders refuse such a frame by themselves, too.
        assert!(c_library::decompress(&wide, 1000, 1 << 20).is_err());
        assert!(rust_library::decompress(&wide, 1000, 1 << 20).is_err());
    }

    #[test]
    fn both_libraries_refuse_what_follows_the_frame_and_what_is_cut_off() {
        let payload = b"what goes in comes out again ".repeat(50);
        let frame = c_library::compress(&payload).unwrap();
        let longer = [frame.as_slice(), &[0]].concat();
        for refused in both(&longer, payload.len() as u64) {
            assert!(refused.unwrap_err().contains("follow"));
        }
        for cut in 0..frame.len() {
            for decoded in both(&frame[..cut], payload.len() as u64) {
                assert!(decoded.is_err(), "a frame truncated at {cut} was accepted");
            }
        }
    }

    #[test]
    fn damaged_frames_decode_to_the_same_or_not_at_all() {
        let mut agreed = 0;
        for payload in payloads().into_iter().filter(|p| (100..200_000).contains(&p.len())) {
            let frame = c_library::compress(&payload).unwrap();
            for k in 0..300u64 {
                let mut damaged = frame.clone();
                let draw = Seed::root(9).index(k).value();
                // Every second flip is in the first bytes, where the header is.
                let at = (draw >> 8) as usize % if k % 2 == 0 { 24 } else { frame.len() };
                damaged[at] ^= 1 << (draw % 8);
                let length = payload.len() as u64;
                if let [Ok(c), Ok(rust)] = both(&damaged, length) {
                    assert!(c == rust || c.len() as u64 != length, "flip {k} at {at} decodes to different bytes");
                    agreed += 1;
                }
            }
        }
        assert!(agreed > 10, "too few damaged frames could be decoded: {agreed}");
    }
}
