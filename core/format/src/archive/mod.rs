//! The `.cc4d` archive: one manifest and independent compressed streams.
//!
//! Layout (little-endian):
//!
//! ```text
//!  0  magic      8 bytes   89 'C' 'C' '4' 'D' 0D 0A 1A
//!  8  version    u32       3
//! 12  header     u32       bytes of the header
//! 16  checksum   u64       XXH3-64 of the header
//! 24  header     u32       decoded bytes, and a Zstandard frame of
//!                u32 + JSON manifest, u32 stream count, then per stream
//!                u8 kind, u8 shuffle (0, 2 or 4), u8 encoding (0 stored, 1 Zstandard), u8 + name,
//!                u64 decoded bytes, u64 stored bytes, u64 XXH3-64 of the stored bytes
//!     streams, one after the other, in the order of the directory; nothing follows the last
//! ```
//!
//! The directory is at the front and offsets follow from the stored lengths, so that one stream can be read alone and none can point
//! outside the file. Kinds this version does not know are listed and skipped; versions it does not know are refused.

mod bytes;
mod manifest;
mod packing;
mod presentation;
mod read;
mod write;
pub(crate) mod zstandard;

pub use bytes::ByteReader;
pub use manifest::{CodecEntry, DeformerEntry, FORMAT_VERSION, MOST_FRAMES, Manifest, Provenance, RasterizerEntry};
pub use packing::{PackedStreams, estimate_stored_len};
pub use presentation::{MAX_CAMERAS, Presentation};
pub use read::{Archive, StreamInfo};
#[cfg(not(target_arch = "wasm32"))]
pub use write::behind_links;
pub use write::{ArchiveWriter, write_atomically};

/// First bytes of every archive. The high bit, the line ends and the control character reveal damage by transfers in text mode.
pub const MAGIC: [u8; 8] = *b"\x89CC4D\r\n\x1a";

/// Bytes before the header: magic, version, header length, header checksum.
const PREFIX_BYTES: usize = 24;

/// Most bytes of a header, decoded: hundreds of times those of a manifest and a directory.
const LARGEST_HEADER: u32 = 16 << 20;
/// Most streams of an archive.
const MOST_STREAMS: u32 = 1 << 14;

/// Purpose of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamKind {
    /// Canonical Gaussians, written and read by the codec.
    Canonical,
    /// Weights of the deformer.
    Field,
    /// Any other data of this version.
    Meta,
    /// The playback layer: see [`crate::playback`].
    Playback,
    /// A small PNG or JPEG to show while the rest is fetched.
    Poster,
    /// A kind of a later version; readers skip it.
    Other(u8),
}

impl StreamKind {
    fn code(self) -> u8 {
        match self {
            Self::Canonical => 0,
            Self::Field => 1,
            Self::Meta => 2,
            Self::Playback => 3,
            Self::Poster => 4,
            Self::Other(code) => code,
        }
    }
    fn from_code(code: u8) -> Self {
        match code {
            0 => Self::Canonical,
            1 => Self::Field,
            2 => Self::Meta,
            3 => Self::Playback,
            4 => Self::Poster,
            other => Self::Other(other),
        }
    }
}
