//! Reading of untrusted files: sizes are checked before memory is allocated.

use crate::{DepthImage, Error, Image8, Limits, Result};
use image::error::ImageFormatHint;
use image::{DynamicImage, ImageError, ImageReader};
use serde::de::DeserializeOwned;
use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};

/// The bytes of a regular file of at most `limits.max_bytes`.
///
/// # Errors
/// [`Error::Io`], [`Error::Data`] for other than regular files, [`Error::Limit`].
pub fn read_bytes(path: &Path, limits: &Limits) -> Result<Vec<u8>> {
    let object = path.display().to_string();
    let meta = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if !meta.is_file() {
        // Reading a pipe could block for ever.
        return Err(Error::data(object, "is not a regular file", "Point to a file"));
    }
    limits.check_bytes(&object, meta.len())?;
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    file.take(limits.max_bytes).read_to_end(&mut bytes).map_err(|e| Error::io(path, e))?;
    Ok(bytes)
}

/// The file as UTF-8 text, without the byte order mark that some programs begin it with.
///
/// # Errors
/// As [`read_bytes`], and [`Error::Data`] for other text.
pub fn read_text(path: &Path, limits: &Limits) -> Result<String> {
    let text = String::from_utf8(read_bytes(path, limits)?)
        .map_err(|e| Error::data(path.display().to_string(), format!("byte {} is not UTF-8 text", e.utf8_error().valid_up_to()), "Fetch the file again"))?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_string).unwrap_or(text))
}

/// The JSON document of a file, nested at most `limits.max_depth` deep.
///
/// # Errors
/// As [`read_text`], and [`Error::Data`] for invalid JSON.
pub fn read_json<T: DeserializeOwned>(path: &Path, limits: &Limits) -> Result<T> {
    let text = read_text(path, limits)?;
    let object = path.display().to_string();
    limits_depth(&text, &object, limits)?;
    serde_json::from_str(&text).map_err(|e| Error::data(object, e.to_string(), "Correct the JSON"))
}

fn limits_depth(text: &str, object: &str, limits: &Limits) -> Result<()> {
    let (mut depth, mut deepest, mut in_string, mut escaped) = (0u64, 0u64, false, false);
    for b in text.bytes() {
        if in_string {
            (in_string, escaped) = (escaped || b != b'"', !escaped && b == b'\\');
            continue;
        }
        match b {
            b'"' => in_string = true,
            b'[' | b'{' => {
                depth += 1;
                deepest = deepest.max(depth);
            }
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    if deepest > u64::from(limits.max_depth) {
        return Err(Error::limit(format!("{object}: nesting"), deepest, u64::from(limits.max_depth), "Raise limits.max_depth if the file is trusted"));
    }
    Ok(())
}

/// Sorted entries of a folder for which `keep` is true.
///
/// # Errors
/// [`Error::Io`].
pub fn list(folder: &Path, keep: impl Fn(&Path) -> bool) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| Error::io(folder, e))? {
        let path = entry.map_err(|e| Error::io(folder, e))?.path();
        if keep(&path) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// Whether the extension is that of an image this build decodes, and the file exists. The `._` files that macOS writes beside images are none.
pub fn is_image(path: &Path) -> bool {
    has_extension(path, &["png", "jpg", "jpeg"]) && !file_name(path).starts_with("._") && path.is_file()
}

/// Whether the extension, in lower case, is one of `known`.
pub fn has_extension(path: &Path, known: &[&str]) -> bool {
    path.extension().and_then(|e| e.to_str()).is_some_and(|e| known.contains(&e.to_ascii_lowercase().as_str()))
}

/// The last component of a path as text.
pub fn file_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_else(|| path.display().to_string())
}

fn image_error(path: &Path, e: impl std::fmt::Display) -> Error {
    Error::data(path.display().to_string(), format!("not a readable image: {e}"), "Fetch the file again, or remove it from the dataset")
}

/// The error of an image that is not decoded. Fetching a file of another format again does not help. Formats of which not even the first bytes are known, such
/// as HEIC, are told by the file's extension.
fn not_decoded(path: &Path, e: ImageError) -> Error {
    let is_other = |hint: ImageFormatHint| matches!(hint, ImageFormatHint::Exact(_)) || !has_extension(path, &["png", "jpg", "jpeg"]);
    match &e {
        ImageError::Unsupported(unsupported) if is_other(unsupported.format_hint()) => {
            Error::data(path.display().to_string(), format!("not a readable image: {e}"), "Convert it to PNG or JPEG, the formats that are read")
        }
        _ => image_error(path, &e),
    }
}

/// Width and height in pixels from an image's header.
///
/// # Errors
/// [`Error::Data`] for unreadable images, [`Error::Limit`] for large ones.
pub fn image_size(path: &Path, limits: &Limits) -> Result<(u32, u32)> {
    let file = File::open(path).map_err(|e| Error::io(path, e))?;
    let reader = ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(|e| Error::io(path, e))?;
    let (w, h) = reader.into_dimensions().map_err(|e| not_decoded(path, e))?;
    limits.check_pixels(&path.display().to_string(), u64::from(w), u64::from(h))?;
    Ok((w, h))
}

/// Decodes a PNG or JPEG of at most `limits.max_pixels` into 8-bit RGB or RGBA.
///
/// # Errors
/// [`Error::Data`] for unreadable or truncated images, [`Error::Limit`].
pub fn read_png_or_jpeg(path: &Path, limits: &Limits) -> Result<Image8> {
    let decoded = decoded(path, limits)?;
    let (width, height) = (decoded.width(), decoded.height());
    let (channels, data) = match decoded {
        DynamicImage::ImageRgb8(i) => (3, i.into_raw()),
        DynamicImage::ImageRgba8(i) => (4, i.into_raw()),
        other if other.color().has_alpha() => (4, other.into_rgba8().into_raw()),
        other => (3, other.into_rgb8().into_raw()),
    };
    Ok(Image8 { width, height, channels, data })
}

/// Decodes a PNG of 16-bit grey values as depth: `unit` world units per step, and 0 where the depth is unknown.
///
/// # Errors
/// [`Error::Data`] for a unit that is no positive number, for unreadable images, for values that are not 16-bit grey and for depths that are not finite;
/// [`Error::Limit`].
pub fn read_depth(path: &Path, unit: f64, limits: &Limits) -> Result<DepthImage> {
    let object = path.display().to_string();
    if !(unit.is_finite() && unit > 0.0) {
        let remedy = "Correct the unit that the dataset states: depth_unit_scale_factor of a transforms.json is 0.001 for millimetres in a world of metres";
        return Err(Error::data(object, format!("a step of depth is {unit} units, which is no positive number"), remedy));
    }
    let steps = match decoded(path, limits)? {
        DynamicImage::ImageLuma16(steps) => steps,
        other => {
            let problem = format!("it is no depth: its pixels are {:?}, not 16-bit grey", other.color());
            return Err(Error::data(object, problem, "Write depth as a PNG of 16-bit grey values"));
        }
    };
    let (width, height) = steps.dimensions();
    let depth = DepthImage { width, height, values: steps.into_raw().into_iter().map(|step| (f64::from(step) * unit) as f32).collect() };
    depth.validate(&object)?;
    Ok(depth)
}

/// A PNG or JPEG of at most `limits.max_pixels`, as it is stored.
fn decoded(path: &Path, limits: &Limits) -> Result<DynamicImage> {
    let bytes = read_bytes(path, limits)?;
    if bytes.starts_with(&[0xff, 0xd8]) && jpeg_is_cut(&bytes) {
        return Err(image_error(path, "the JPEG ends before its end marker"));
    }
    let mut reader = ImageReader::new(Cursor::new(&bytes)).with_guessed_format().map_err(|e| Error::io(path, e))?;
    let (w, h) =
        ImageReader::new(Cursor::new(&bytes)).with_guessed_format().map_err(|e| Error::io(path, e))?.into_dimensions().map_err(|e| not_decoded(path, e))?;
    limits.check_pixels(&path.display().to_string(), u64::from(w), u64::from(h))?;
    let mut caps = image::Limits::default();
    caps.max_alloc = Some(limits.max_bytes);
    reader.limits(caps);
    let decoded = reader.decode().map_err(|e| not_decoded(path, e))?;
    if decoded.width() == 0 || decoded.height() == 0 {
        return Err(image_error(path, "it has no pixels"));
    }
    Ok(decoded)
}

/// Whether a JPEG ends before its end marker. A truncated one still decodes, with grey for missing data. What follows the end marker, such as the film of a
/// photo that moves, does not count; nor do thumbnails, which lie within a segment.
fn jpeg_is_cut(bytes: &[u8]) -> bool {
    let mut at = 2;
    loop {
        // The next marker: no escaped 0xff, restart of the entropy-coded data or fill byte.
        let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff | 0xd0..=0xd7);
        let Some(next) = bytes.get(at..).and_then(|rest| rest.windows(2).position(is_marker)) else { return true };
        at += next + 2;
        if bytes[at - 1] == 0xd9 {
            return false;
        }
        let Some(length) = bytes.get(at..at + 2) else { return true };
        at += usize::from(u16::from_be_bytes([length[0], length[1]])).max(2);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jpeg_ends_at_its_own_end_marker() {
        // A segment with a thumbnail, whose markers do not count; a scan with an escaped 0xff; the end.
        let whole = [&[0xff, 0xd8, 0xff, 0xe1, 0, 8, 0xff, 0xd8, 9, 9, 0xff, 0xd9][..], &[0xff, 0xda, 0, 3, 1, 7, 0xff, 0, 5, 0xff, 0xd9]].concat();
        assert!(!jpeg_is_cut(&whole));
        assert!((2..whole.len()).all(|end| jpeg_is_cut(&whole[..end])));
        let followed = [&whole[..], &[0, 1, 0xff, 0xda, 0, 0, 0xff]].concat();
        assert!(!jpeg_is_cut(&followed), "what follows is not of the image");
    }

    #[test]
    fn other_formats_are_to_be_converted_and_damaged_files_to_be_fetched() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str, bytes: &[u8]| {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let errors = [image_size(&path, &Limits::default()).unwrap_err(), read_png_or_jpeg(&path, &Limits::default()).unwrap_err()];
            errors.map(|e| e.to_string())
        };
        let others: [(&str, &[u8]); 4] = [
            ("a.webp", b"RIFF\x1a\0\0\0WEBPVP8L"),
            ("a.bmp", b"BM\x46\0\0\0\0\0"),
            ("a.tiff", b"II*\0\x08\0\0\0"),
            ("a.HEIC", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
        ];
        for (name, bytes) in others {
            assert!(of(name, bytes).iter().all(|e| e.contains(name) && e.contains("Convert it to PNG or JPEG")), "{:?}", of(name, bytes));
        }
        for damaged in [of("a.png", b"\x89PNG\r\n\x1a\n"), of("b.png", b"<html>")] {
            assert!(damaged.iter().all(|e| e.contains("Fetch the file again")), "{damaged:?}");
        }
    }

    #[test]
    fn what_macos_writes_beside_images_is_none() {
        let folder = tempfile::tempdir().unwrap();
        let of = |name: &str| {
            std::fs::write(folder.path().join(name), "").unwrap();
            is_image(&folder.path().join(name))
        };
        assert!(of("a.png") && of(".b.JPG") && !of("._a.png") && !of("a.txt"));
    }

    #[test]
    fn a_byte_order_mark_is_no_text() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        for text in ["\u{feff}[1, 2]", "[1, 2]"] {
            std::fs::write(&path, text).unwrap();
            assert_eq!(read_text(&path, &Limits::default()).unwrap(), "[1, 2]");
            assert_eq!(read_json::<Vec<u8>>(&path, &Limits::default()).unwrap(), [1, 2]);
        }
    }

    #[test]
    fn depth_ignores_brackets_in_strings() {
        let limits = Limits { max_depth: 2, ..Default::default() };
        assert!(limits_depth(r#"{"a": "[[[[\"[[[", "b": [1]}"#, "t", &limits).is_ok());
        assert!(limits_depth("[[[1]]]", "t", &limits).is_err());
    }
}
