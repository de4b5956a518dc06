//! Images as PNG files under names of their own.

use cc4dgs_format::{Error, Image8, Result};
use std::path::{Path, PathBuf};

/// Files of one frame that are looked for before the user is asked to tidy up.
const MOST_FILES: usize = 1000;

/// `stem`.png in `folder`, or the first of `stem`-2.png and so on that does not exist.
pub(crate) fn free_name(folder: &Path, stem: &str) -> Result<PathBuf> {
    let names = (1..=MOST_FILES).map(|k| folder.join(if k == 1 { format!("{stem}.png") } else { format!("{stem}-{k}.png") }));
    let free = names.into_iter().find(|path| !path.exists());
    free.ok_or_else(|| Error::limit(format!("files {stem}-….png"), MOST_FILES as u64 + 1, MOST_FILES as u64, "Move some of them elsewhere"))
}

/// `image`, RGB or RGBA, as PNG.
pub(crate) fn png_bytes(image: &Image8) -> Result<Vec<u8>> {
    image.validate("saved image")?;
    let failed = |e: png::EncodingError| Error::backend("PNG encoder", e.to_string(), "Report this: every 8-bit image should encode");
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width, image.height);
    encoder.set_color(if image.channels == 4 { png::ColorType::Rgba } else { png::ColorType::Rgb });
    encoder.set_depth(png::BitDepth::Eight);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&image.data).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_whole_and_none_is_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let image = Image8 { width: 3, height: 2, channels: 3, data: (0..18).collect() };
        for name in ["a.png", "a-2.png"] {
            let path = free_name(folder.path(), "a").unwrap();
            assert_eq!(path.file_name().unwrap(), name);
            std::fs::write(&path, png_bytes(&image).unwrap()).unwrap();
            let mut reader = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&path).unwrap())).read_info().unwrap();
            let mut data = vec![0; 18];
            reader.next_frame(&mut data).unwrap();
            assert_eq!(data, image.data);
        }
        assert!(png_bytes(&Image8 { width: 4, ..image }).is_err());
    }
}
