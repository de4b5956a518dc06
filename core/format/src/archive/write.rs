//! Writing of an archive, deterministically and atomically.

use super::packing::PackedStreams;
use super::zstandard::compress;
use super::{FORMAT_VERSION, LARGEST_HEADER, MAGIC, MOST_STREAMS, Manifest, StreamKind};
use crate::{Error, Limits, Result, Stream};
use std::path::Path;
use std::sync::Arc;
use xxhash_rust::xxh3::xxh3_64;

/// Collects a manifest and streams and writes them as one archive. Equal inputs give equal bytes.
pub struct ArchiveWriter {
    manifest: Manifest,
    streams: Vec<(StreamKind, Stream)>,
    packed: Option<Arc<PackedStreams>>,
}

impl ArchiveWriter {
    /// An archive without streams; the manifest's format version is set to this build's.
    pub fn new(manifest: Manifest) -> Self {
        Self { manifest: Manifest { format_version: FORMAT_VERSION, ..manifest }, streams: Vec::new(), packed: None }
    }
    /// Takes streams that another archive with the same `packed` had last as they were compressed there. The bytes of the archive do not depend on it.
    pub fn reusing(self, packed: &Arc<PackedStreams>) -> Self {
        Self { packed: Some(Arc::clone(packed)), ..self }
    }
    /// Adds a stream. Names must be unique in the archive and 1 to 255 bytes long; [`ArchiveWriter::to_bytes`] checks them.
    pub fn add(mut self, kind: StreamKind, stream: Stream) -> Self {
        self.streams.push((kind, stream));
        self
    }
    /// Adds several streams of one kind.
    pub fn add_all(mut self, kind: StreamKind, streams: impl IntoIterator<Item = Stream>) -> Self {
        self.streams.extend(streams.into_iter().map(|s| (kind, s)));
        self
    }
    /// The archive in memory.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        let refuse = |name: &str, problem: &str| Error::parameter(format!("archive stream '{name}'"), problem, "Rename the stream");
        let mut names: Vec<&str> = self.streams.iter().map(|(_, s)| s.name.as_str()).collect();
        names.sort_unstable();
        if let Some(pair) = names.windows(2).find(|w| w[0] == w[1]) {
            return Err(refuse(pair[0], "the name is used twice"));
        }
        if let Some(name) = names.iter().find(|n| n.is_empty() || n.len() > 255 || n.chars().any(char::is_control)) {
            return Err(refuse(name, "the name is empty, over 255 bytes or not printable"));
        }
        if names.len() > MOST_STREAMS as usize {
            return Err(Error::limit("streams of an archive", names.len() as u64, u64::from(MOST_STREAMS), "Store several columns in one stream"));
        }
        self.check_manifest()?;
        let packed = match &self.packed {
            Some(packed) => packed.pack_all(&self.streams)?,
            None => PackedStreams::default().pack_all(&self.streams)?,
        };
        let manifest = self.manifest.to_json()?;
        let mut plain = Vec::with_capacity(manifest.len() + 64 * packed.len());
        plain.extend((manifest.len() as u32).to_le_bytes());
        plain.extend(&manifest);
        plain.extend((packed.len() as u32).to_le_bytes());
        for ((kind, stream), packed) in self.streams.iter().zip(&packed) {
            plain.extend([kind.code(), packed.shuffle, packed.encoding.code(), stream.name.len() as u8]);
            plain.extend(stream.name.as_bytes());
            plain.extend((stream.bytes.len() as u64).to_le_bytes());
            plain.extend((packed.bytes.len() as u64).to_le_bytes());
            plain.extend(xxh3_64(&packed.bytes).to_le_bytes());
        }
        let plain_len = u32::try_from(plain.len()).ok().filter(|len| *len <= LARGEST_HEADER);
        let plain_len = plain_len
            .ok_or_else(|| Error::limit("archive header", plain.len() as u64, u64::from(LARGEST_HEADER), "Shorten the manifest's configuration and extras"))?;
        let header = [plain_len.to_le_bytes().to_vec(), compress(&plain)?].concat();
        let mut out = Vec::with_capacity(super::PREFIX_BYTES + header.len() + packed.iter().map(|p| p.bytes.len()).sum::<usize>());
        out.extend(MAGIC);
        out.extend(FORMAT_VERSION.to_le_bytes());
        out.extend((header.len() as u32).to_le_bytes());
        out.extend(xxh3_64(&header).to_le_bytes());
        out.extend(header);
        for packed in packed {
            out.extend(&packed.bytes);
        }
        Ok(out)
    }
    /// Refuses a manifest that readers refuse, whatever their limits.
    fn check_manifest(&self) -> Result<()> {
        let limits = Limits { max_gaussians: u64::MAX, ..Limits::default() };
        self.manifest.validate("archive manifest", &limits).map_err(|error| match error {
            Error::Data { object, problem, .. } => Error::parameter(object, problem, "Correct the program that made it"),
            other => other,
        })
    }
    /// Writes the archive to `path` and returns its size in bytes. On failure `path` is unchanged.
    pub fn write_to(&self, path: impl AsRef<Path>) -> Result<u64> {
        let bytes = self.to_bytes()?;
        write_atomically(path, &bytes)?;
        Ok(bytes.len() as u64)
    }
}

/// Writes `bytes` to a temporary name in the folder of `path`, flushes them to the disk and renames. On failure `path` is unchanged. Where `path` is a symbolic
/// link, it stays one: the file that it leads to, which need not exist yet, is written in this way. Devices and pipes get the bytes as they are.
///
/// On `wasm32` there is no file system and the call is an error; use [`ArchiveWriter::to_bytes`] and similar functions.
pub fn write_atomically(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    write_file(path.as_ref(), bytes)
}

#[cfg(target_arch = "wasm32")]
fn write_file(path: &Path, _bytes: &[u8]) -> Result<()> {
    Err(Error::unsupported(path.display().to_string(), "this build has no file system to write to", "Take the bytes with to_bytes() and store them"))
}

#[cfg(not(target_arch = "wasm32"))]
fn write_file(path: &Path, bytes: &[u8]) -> Result<()> {
    use std::io::Write;
    if std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return std::fs::OpenOptions::new().write(true).open(path).and_then(|mut device| device.write_all(bytes)).map_err(|e| Error::io(path, e));
    }
    let path = &behind_links(path)?;
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    let mut builder = tempfile::Builder::new();
    builder.prefix(".cc4dgs-").suffix(".part");
    // Temporary files are private by default; the result gets the permissions of an ordinary new file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder).map_err(|e| Error::io(folder, e))?;
    file.write_all(bytes).map_err(|e| Error::io(path, e))?;
    file.as_file().sync_all().map_err(|e| Error::io(path, e))?;
    file.persist(path).map_err(|e| Error::io(path, e.error))?;
    // Syncing the folder makes the rename durable; skipped on systems that cannot open a folder.
    if let Ok(folder) = std::fs::File::open(folder) {
        folder.sync_all().ok();
    }
    Ok(())
}

/// Where `path` leads: itself, or what is behind symbolic links, whether it exists or not. A rename would put the file in the place of the link.
///
/// # Errors
/// [`Error::Io`] for links that lead in a circle.
#[cfg(not(target_arch = "wasm32"))]
pub fn behind_links(path: &Path) -> Result<std::path::PathBuf> {
    /// As many as Linux follows.
    const MOST_LINKS: usize = 40;
    let mut at = path.to_path_buf();
    for _ in 0..MOST_LINKS {
        match std::fs::read_link(&at) {
            // What is relative counts from the folder of the link.
            Ok(to) => at = at.parent().unwrap_or(Path::new("")).join(to),
            // A file, or nothing yet.
            Err(_) => return Ok(at),
        }
    }
    Err(Error::io(path, std::io::Error::other(format!("it leads through more than {MOST_LINKS} symbolic links"))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::archive::Archive;

    #[cfg(unix)]
    #[test]
    fn a_symbolic_link_stays_and_its_file_is_replaced() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        let is_link = |name: &str| at(name).symlink_metadata().unwrap().is_symlink();
        std::fs::create_dir(at("real")).unwrap();
        std::fs::write(at("real/old"), "before").unwrap();
        // To a file in another folder, to a link, and to nothing yet.
        symlink("real/old", at("one")).unwrap();
        symlink(at("one"), at("two")).unwrap();
        symlink("real/new", at("dangling")).unwrap();
        for (link, file) in [("one", "real/old"), ("two", "real/old"), ("dangling", "real/new")] {
            write_atomically(at(link), link.as_bytes()).unwrap();
            assert!(is_link(link) && !is_link(file), "{link}");
            assert_eq!(std::fs::read_to_string(at(file)).unwrap(), link);
        }
        assert!(is_link("one"));
        assert_eq!(std::fs::read_dir(at("real")).unwrap().count(), 2, "nothing else is left there");
        // Links that lead nowhere stay as they are.
        symlink("round", at("round")).unwrap();
        let error = write_atomically(at("round"), b"lost").unwrap_err().to_string();
        assert!(error.contains("symbolic links") && is_link("round"), "{error}");
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_gets_the_bytes_and_stays() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || std::fs::read(pipe).unwrap()
        });
        write_atomically(&pipe, b"through").unwrap();
        assert_eq!(reader.join().unwrap(), b"through");
        assert!(!pipe.metadata().unwrap().is_file());
    }

    #[test]
    fn archives_that_reuse_packed_streams_have_the_same_bytes() {
        let reused = Arc::new(PackedStreams::default());
        for text in ["first ", "second ", "second "] {
            let archive = || {
                let stream = |name: &str, text: &str| Stream { name: name.into(), bytes: text.repeat(50).into_bytes() };
                let writer = ArchiveWriter::new(Manifest { frame_count: 1, ..Default::default() });
                writer.add(StreamKind::Canonical, stream("means", text)).add(StreamKind::Field, stream("weights", "the same "))
            };
            assert_eq!(archive().reusing(&reused).to_bytes().unwrap(), archive().to_bytes().unwrap(), "{text}");
        }
    }

    #[test]
    fn what_cannot_be_read_again_is_not_written() {
        let sound = Manifest { frame_count: 1, ..Default::default() };
        let many = Manifest { gaussian_count: u64::MAX, ..sound.clone() };
        assert!(ArchiveWriter::new(many).to_bytes().is_ok(), "limits are those of readers");
        let bytes = ArchiveWriter::new(sound.clone()).to_bytes().unwrap();
        assert!(Archive::from_bytes("t", bytes, &Limits::default()).is_ok());
        for manifest in [Manifest { frame_count: 0, ..sound.clone() }, Manifest { sh_degree: 5, ..sound }] {
            let error = ArchiveWriter::new(manifest).to_bytes().unwrap_err();
            assert!(matches!(error, Error::Parameter { .. }) && error.to_string().starts_with("archive manifest: "), "{error}");
        }
    }
}
