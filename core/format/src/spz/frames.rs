//! Version 4: a plain header, a table of (compressed, raw) sizes, and a Zstandard frame per attribute.

use super::{MAGIC, Packed, check_header, unknown_version};
use crate::archive::zstandard;
use crate::{Error, Limits, Result};

/// Bytes of the header: magic, version, count, degree, fractional bits, flags, number of streams, offset of the table, twelve zeros.
const HEADER: usize = 32;
/// Bytes of an entry of the table.
const ENTRY: usize = 16;

/// A file of version 4. Without harmonics it has five streams, else six.
pub(super) fn write(packed: &Packed) -> Result<Vec<u8>> {
    let streams = &packed.streams[..if packed.sh_degree == 0 { 5 } else { 6 }];
    let mut out = Vec::with_capacity(HEADER + ENTRY * streams.len());
    out.extend(MAGIC.to_le_bytes());
    out.extend(4u32.to_le_bytes());
    out.extend((packed.count as u32).to_le_bytes());
    out.extend([packed.sh_degree as u8, packed.fraction, packed.flags, streams.len() as u8]);
    out.extend((HEADER as u32).to_le_bytes());
    out.resize(HEADER, 0);
    let frames = streams.iter().map(|stream| zstandard::compress(stream)).collect::<Result<Vec<_>>>()?;
    for (frame, stream) in frames.iter().zip(streams) {
        out.extend((frame.len() as u64).to_le_bytes());
        out.extend((stream.len() as u64).to_le_bytes());
    }
    frames.iter().for_each(|frame| out.extend(frame));
    Ok(out)
}

/// The attributes of a file of version 4. Vendor extensions, which lie between header and table, are skipped.
pub(super) fn read(object: &str, bytes: &[u8], limits: &Limits) -> Result<Packed> {
    let damaged = |problem: String| Error::data(object, problem, "Fetch the file again");
    let Some(header) = bytes.first_chunk::<HEADER>() else {
        return Err(damaged(format!("{} bytes are no SPZ header", bytes.len())));
    };
    let word = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if word(4) != 4 {
        return Err(unknown_version(object, word(4)));
    }
    let (count, sh_degree, fraction, flags) = (u64::from(word(8)), usize::from(header[12]), header[13], header[14]);
    check_header(object, count, sh_degree, fraction, limits)?;
    let (count, held, table) = (count as usize, usize::from(header[15]), word(16) as usize);
    let needed = if sh_degree == 0 { 5 } else { 6 };
    if held < needed || held > 6 {
        return Err(damaged(format!("{held} streams, {needed} are needed")));
    }
    let entries = bytes.get(table..).and_then(|rest| rest.get(..held * ENTRY)).filter(|_| table >= HEADER);
    let Some(entries) = entries else {
        return Err(damaged(format!("the table of {held} streams at byte {table} is not inside the file")));
    };
    let mut rest = &bytes[table + held * ENTRY..];
    let mut streams: [Vec<u8>; 6] = Default::default();
    for (index, (entry, width)) in entries.as_chunks::<ENTRY>().0.iter().zip(Packed::widths(sh_degree, 4)).enumerate() {
        let (compressed, raw) = entry.split_at(8);
        let size = |b: &[u8]| b.iter().rev().fold(0u64, |size, &byte| size << 8 | u64::from(byte));
        let (compressed, raw, expected) = (size(compressed), size(raw), (count * width) as u64);
        if raw != expected || compressed > rest.len() as u64 {
            return Err(damaged(format!("stream {index} claims {raw} bytes in {compressed}, {expected} in at most {} are possible", rest.len())));
        }
        let (frame, after) = rest.split_at(compressed as usize);
        rest = after;
        // An empty attribute may be stored without a frame.
        if raw > 0 || compressed > 0 {
            streams[index] = zstandard::decompress(frame, raw).map_err(|e| damaged(format!("stream {index}: {e}")))?;
        }
        if streams[index].len() as u64 != expected {
            return Err(damaged(format!("stream {index} has {} bytes, {expected} are needed", streams[index].len())));
        }
    }
    if !rest.is_empty() {
        return Err(damaged(format!("{} unknown bytes follow the Gaussians", rest.len())));
    }
    Ok(Packed { count, sh_degree, fraction, flags, rotation_bytes: 4, streams })
}
