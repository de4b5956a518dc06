//! Versions 2 and 3: header and attributes in one gzip stream.

use super::{MAGIC, Packed, check_header, unknown_version};
use crate::{Error, Limits, Result};
use flate2::Compression;
use flate2::bufread::GzDecoder;
use flate2::write::GzEncoder;
use std::io::{Read, Write};

const HEADER: usize = 16;
/// Largest vendor extension that is skipped, in bytes.
const MOST_EXTENSION: usize = 1 << 24;

/// A file of version 3.
pub(super) fn write(packed: &Packed) -> Result<Vec<u8>> {
    let mut header = Vec::with_capacity(HEADER);
    header.extend(MAGIC.to_le_bytes());
    header.extend(3u32.to_le_bytes());
    header.extend((packed.count as u32).to_le_bytes());
    header.extend([packed.sh_degree as u8, packed.fraction, packed.flags, 0]);
    let mut encoder = GzEncoder::new(Vec::new(), Compression::best());
    let written = encoder.write_all(&header).and_then(|()| packed.streams.iter().try_for_each(|stream| encoder.write_all(stream)));
    written.and_then(|()| encoder.finish()).map_err(|e| Error::backend("SPZ", e.to_string(), "Report this as a defect"))
}

/// The attributes of a file of version 2 or 3.
pub(super) fn read(object: &str, bytes: &[u8], limits: &Limits) -> Result<Packed> {
    let damaged = |problem: String| Error::data(object, problem, "Fetch the file again");
    let mut decoder = GzDecoder::new(bytes);
    let mut header = [0u8; HEADER];
    decoder.read_exact(&mut header).map_err(|e| damaged(format!("no SPZ header: {e}")))?;
    let word = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    if word(0) != MAGIC {
        return Err(damaged("it is not an SPZ file".into()));
    }
    let version = word(4);
    if !(2..=3).contains(&version) {
        return Err(unknown_version(object, version));
    }
    let (count, sh_degree, fraction) = (u64::from(word(8)), usize::from(header[12]), header[13]);
    check_header(object, count, sh_degree, fraction, limits)?;
    let (count, rotation_bytes) = (count as usize, if version == 3 { 4 } else { 3 });
    let mut streams: [Vec<u8>; 6] = Default::default();
    for (stream, width) in streams.iter_mut().zip(Packed::widths(sh_degree, rotation_bytes)) {
        (&mut decoder).take((count * width) as u64).read_to_end(stream).map_err(|e| damaged(e.to_string()))?;
        if stream.len() != count * width {
            return Err(damaged(format!("it ends early: {} of {} bytes of an attribute", stream.len(), count * width)));
        }
    }
    // Vendor extensions follow. Reading to the end verifies the checksum of the gzip stream.
    let mut beyond = vec![0u8; 1 << 16];
    let mut left = MOST_EXTENSION;
    while left > 0 {
        match decoder.read(&mut beyond).map_err(|e| damaged(e.to_string()))? {
            0 => break,
            more => left = left.saturating_sub(more),
        }
    }
    if left == 0 || !decoder.get_ref().is_empty() {
        return Err(damaged("unknown data follows the Gaussians".into()));
    }
    Ok(Packed { count, sh_degree, fraction, flags: header[14], rotation_bytes, streams })
}
