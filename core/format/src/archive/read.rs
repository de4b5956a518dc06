//! Reading of an archive: manifest and directory once, then any stream separately.

use super::packing::{Encoding, unpack};
use super::{ByteReader, FORMAT_VERSION, LARGEST_HEADER, MAGIC, MOST_STREAMS, Manifest, PREFIX_BYTES, StreamKind};
use crate::{Error, Limits, Result, Stream, unknown_name};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Mutex;
use xxhash_rust::xxh3::xxh3_64;

/// An entry of the directory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StreamInfo {
    /// The stream's name, unique in the archive.
    pub name: String,
    /// Its purpose.
    pub kind: StreamKind,
    /// Declared size in bytes after decoding.
    pub decoded_bytes: u64,
    /// Size in bytes in the file.
    pub stored_bytes: u64,
    /// First byte in the file, so that programs can fetch the stream alone.
    pub offset: u64,
}

struct Entry {
    info: StreamInfo,
    shuffle: u8,
    encoding: Encoding,
    checksum: u64,
}

enum Source {
    File(Mutex<File>),
    Memory(Vec<u8>),
}

impl Source {
    fn len(&self, object: &str) -> Result<u64> {
        match self {
            Self::Memory(bytes) => Ok(bytes.len() as u64),
            Self::File(file) => Ok(lock(file)?.metadata().map_err(|e| Error::io(object, e))?.len()),
        }
    }
    /// `count` bytes from `offset`; the caller has checked both against the length.
    fn read(&self, object: &str, offset: u64, count: u64) -> Result<Vec<u8>> {
        let bytes = match self {
            Self::Memory(bytes) => bytes.get(offset as usize..(offset + count) as usize).unwrap_or_default().to_vec(),
            Self::File(file) => {
                let mut file = lock(file)?;
                file.seek(SeekFrom::Start(offset)).map_err(|e| Error::io(object, e))?;
                let mut bytes = Vec::with_capacity(count as usize);
                file.by_ref().take(count).read_to_end(&mut bytes).map_err(|e| Error::io(object, e))?;
                bytes
            }
        };
        if bytes.len() as u64 == count {
            Ok(bytes)
        } else {
            Err(damaged(object, format!("{count} bytes expected at byte {offset}, {} are there", bytes.len())))
        }
    }
}

fn lock(file: &Mutex<File>) -> Result<std::sync::MutexGuard<'_, File>> {
    file.lock().map_err(|_| Error::backend("archive", "another thread panicked while reading", "Open the archive again"))
}

fn damaged(object: &str, problem: String) -> Error {
    Error::data(object, problem, "The file is damaged; fetch or write it again")
}

/// Refuses headers of more bytes than any writer makes.
fn check_header(object: &str, bytes: u64) -> Result<()> {
    if bytes <= u64::from(LARGEST_HEADER) {
        return Ok(());
    }
    Err(Error::limit(object, bytes, u64::from(LARGEST_HEADER), "The file is damaged; fetch or write it again"))
}

/// An open archive. The manifest and the directory are checked on opening, each stream when it is read.
pub struct Archive {
    object: String,
    limits: Limits,
    manifest: Manifest,
    entries: Vec<Entry>,
    source: Source,
}

impl Archive {
    /// Opens the archive at `path` and reads manifest and directory. Memory is allocated only for bytes that are present.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Data`] for invalid files, [`Error::Unsupported`] for other versions, [`Error::Limit`].
    pub fn open(path: impl AsRef<Path>, limits: &Limits) -> Result<Self> {
        let path = path.as_ref();
        let file = File::open(path).map_err(|e| Error::io(path, e))?;
        Self::from_source(path.display().to_string(), Source::File(Mutex::new(file)), limits)
    }
    /// Reads an archive in memory; `object` names it in errors.
    pub fn from_bytes(object: impl Into<String>, bytes: Vec<u8>, limits: &Limits) -> Result<Self> {
        Self::from_source(object.into(), Source::Memory(bytes), limits)
    }
    /// Bytes from the start of a file to the end of its header, from its first [`Archive::PREFIX_BYTES`]; `object` names it in errors. With them, and `total`
    /// bytes altogether, [`Archive::from_bytes`] reads the manifest and the directory; streams that are missing fail their checksum when they are read.
    ///
    /// # Errors
    /// [`Error::Data`] for a file that is no archive, [`Error::Limit`].
    pub fn header_end(object: &str, prefix: &[u8], limits: &Limits) -> Result<u64> {
        let mut reader = ByteReader::new(object, prefix);
        if reader.take(8)? != MAGIC {
            return Err(Error::data(object, "it is not a .cc4d archive (wrong magic bytes)", "Check the address"));
        }
        reader.u32()?;
        let header = u64::from(reader.u32()?);
        let what = format!("header of {object}");
        limits.check_bytes(&what, header)?;
        check_header(&what, header)?;
        Ok(Self::PREFIX_BYTES as u64 + header)
    }
    /// Bytes before the header.
    pub const PREFIX_BYTES: usize = PREFIX_BYTES;
    fn from_source(object: String, source: Source, limits: &Limits) -> Result<Self> {
        let total = source.len(&object)?;
        if total < PREFIX_BYTES as u64 {
            return Err(damaged(&object, format!("{total} bytes are fewer than the {PREFIX_BYTES} bytes of an archive's prefix")));
        }
        let prefix = source.read(&object, 0, PREFIX_BYTES as u64)?;
        let mut reader = ByteReader::new(object.clone(), &prefix);
        if reader.take(8)? != MAGIC {
            return Err(Error::data(object, "it is not a .cc4d archive (wrong magic bytes)", "Check the path; transfers in text mode also damage archives"));
        }
        let version = reader.u32()?;
        if version != FORMAT_VERSION {
            return Err(Error::unsupported(object, format!("archive version {version} is not {FORMAT_VERSION}"), "Use a release of cc4dgs that knows it"));
        }
        let (header_len, checksum) = (u64::from(reader.u32()?), reader.u64()?);
        limits.check_bytes(&format!("header of {object}"), header_len)?;
        if header_len > total - PREFIX_BYTES as u64 {
            return Err(damaged(&object, format!("a header of {header_len} bytes is claimed in a file of {total}")));
        }
        let header = source.read(&object, PREFIX_BYTES as u64, header_len)?;
        if xxh3_64(&header) != checksum {
            return Err(damaged(&object, "the checksum of the header does not match".into()));
        }
        let what = format!("header of {object}");
        let mut reader = ByteReader::new(&what, &header);
        let plain_len = u64::from(reader.u32()?);
        check_header(&what, plain_len)?;
        let plain = unpack(&what, reader.rest().to_vec(), Encoding::Zstd, 0, plain_len, limits)?;
        let mut reader = ByteReader::new(what, &plain);
        let manifest_len = reader.u32()? as usize;
        let manifest = Manifest::from_json(&object, reader.take(manifest_len)?, limits)?;
        let entries = read_directory(&mut reader, PREFIX_BYTES as u64 + header_len, total)?;
        reader.finish()?;
        Ok(Self { object, limits: *limits, manifest, entries, source })
    }
    /// The manifest.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }
    /// The directory, in file order.
    pub fn stream_sizes(&self) -> Vec<StreamInfo> {
        self.entries.iter().map(|e| e.info.clone()).collect()
    }
    /// The size of the whole file in bytes.
    pub fn total_bytes(&self) -> Result<u64> {
        self.source.len(&self.object)
    }
    /// Reads, checks and decodes one stream.
    pub fn read_stream(&self, name: &str) -> Result<Vec<u8>> {
        match self.entries.iter().find(|e| e.info.name == name) {
            Some(entry) => self.read_entry(entry),
            None => Err(unknown_name(&format!("{}: stream", self.object), name, self.entries.iter().map(|e| e.info.name.as_str()))),
        }
    }
    /// Reads all streams of `kind`, in file order. The limit on bytes is one of all of them together.
    pub fn read_kind(&self, kind: StreamKind) -> Result<Vec<Stream>> {
        self.read_those(|info| info.kind == kind)
    }
    /// Reads the streams that are `wanted`, in file order. The limit on bytes is one of all of them together.
    pub(crate) fn read_those(&self, wanted: impl Fn(&StreamInfo) -> bool) -> Result<Vec<Stream>> {
        let entries: Vec<&Entry> = self.entries.iter().filter(|e| wanted(&e.info)).collect();
        let total = entries.iter().fold(0u64, |sum, e| sum.saturating_add(e.info.decoded_bytes));
        self.limits.check_bytes(&format!("{} streams of {}", entries.len(), self.object), total)?;
        entries.into_par_iter().map(|e| Ok(Stream { name: e.info.name.clone(), bytes: self.read_entry(e)? })).collect()
    }
    fn read_entry(&self, entry: &Entry) -> Result<Vec<u8>> {
        let object = format!("stream '{}' of {}", entry.info.name, self.object);
        self.limits.check_bytes(&object, entry.info.decoded_bytes)?;
        self.limits.check_bytes(&object, entry.info.stored_bytes)?;
        let stored = self.source.read(&object, entry.info.offset, entry.info.stored_bytes)?;
        if xxh3_64(&stored) != entry.checksum {
            return Err(damaged(&object, "its checksum does not match".into()));
        }
        unpack(&object, stored, entry.encoding, entry.shuffle, entry.info.decoded_bytes, &self.limits)
    }
}

/// The directory; stored lengths must fill the file from `start` to `total` exactly.
fn read_directory(reader: &mut ByteReader, start: u64, total: u64) -> Result<Vec<Entry>> {
    let count = reader.u32()?;
    if count > MOST_STREAMS {
        return Err(reader.error(format!("{count} streams, over the limit of {MOST_STREAMS}")));
    }
    // Grown entry by entry, because the stated count is untrusted.
    let mut entries = Vec::new();
    let (mut offset, mut names) = (start, BTreeSet::new());
    for _ in 0..count {
        let (kind, shuffle, encoding) = (StreamKind::from_code(reader.u8()?), reader.u8()?, reader.u8()?);
        let name_len = usize::from(reader.u8()?);
        let name = reader.name(name_len)?;
        let (decoded_bytes, stored_bytes, checksum) = (reader.u64()?, reader.u64()?, reader.u64()?);
        let Some(encoding) = Encoding::from_code(encoding).filter(|_| matches!(shuffle, 0 | 2 | 4)) else {
            return Err(reader.error(format!("stream '{name}' has encoding {encoding} and shuffle {shuffle}, which version {FORMAT_VERSION} does not have")));
        };
        if encoding == Encoding::Stored && decoded_bytes != stored_bytes {
            return Err(reader.error(format!("stream '{name}' is stored plainly in {stored_bytes} bytes but declares {decoded_bytes}")));
        }
        if stored_bytes > total - offset {
            return Err(reader.error(format!("stream '{name}' claims {stored_bytes} bytes, {} are left", total - offset)));
        }
        if !names.insert(name.clone()) {
            return Err(reader.error(format!("two streams are called '{name}'")));
        }
        entries.push(Entry { info: StreamInfo { name, kind, decoded_bytes, stored_bytes, offset }, shuffle, encoding, checksum });
        offset += stored_bytes;
    }
    if offset != total {
        return Err(reader.error(format!("{} bytes follow the last stream", total - offset)));
    }
    Ok(entries)
}

#[cfg(test)]
mod tests {
    use super::super::ArchiveWriter;
    use super::*;

    #[test]
    fn headers_that_are_too_large_are_neither_written_nor_read() {
        let with_note = |bytes: usize| {
            let mut manifest = Manifest { frame_count: 1, ..Default::default() };
            manifest.extra.insert("note".into(), "x".repeat(bytes).into());
            ArchiveWriter::new(manifest).to_bytes()
        };
        let most = LARGEST_HEADER as usize;
        let bytes = with_note(most - 4096).unwrap();
        assert!(bytes.len() < 20_000 && Archive::from_bytes("t", bytes, &Limits::default()).is_ok());
        assert!(matches!(with_note(most), Err(Error::Limit { .. })));
        // One that decodes to a byte more: nothing is decoded.
        let plain = vec![b' '; most + 1];
        let header = [(plain.len() as u32).to_le_bytes().to_vec(), crate::archive::zstandard::compress(&plain).unwrap()].concat();
        let length = (header.len() as u32).to_le_bytes();
        let bytes = [&MAGIC[..], &FORMAT_VERSION.to_le_bytes(), &length, &xxh3_64(&header).to_le_bytes(), &header].concat();
        let error = Archive::from_bytes("t", bytes, &Limits::default()).err().unwrap();
        assert!(matches!(error, Error::Limit { value: 16_777_217, limit: 16_777_216, .. }), "{error}");
        // Nor is one fetched.
        let prefix = [&MAGIC[..], &FORMAT_VERSION.to_le_bytes(), &u32::MAX.to_le_bytes(), &[0; 8]].concat();
        assert!(matches!(Archive::header_end("t", &prefix, &Limits::default()), Err(Error::Limit { limit: 16_777_216, .. })));
    }
}
