//! PNG files, complete or absent.

use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Image8, Result};
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use std::path::Path;

/// The bytes of a PNG file.
pub fn encode_png(image: &Image8) -> Result<Vec<u8>> {
    let color = match image.channels {
        3 => ExtendedColorType::Rgb8,
        4 => ExtendedColorType::Rgba8,
        n => return Err(Error::parameter("PNG", format!("{n} channels"), "Pass RGB or RGBA")),
    };
    if image.data.len() as u64 != u64::from(image.width) * u64::from(image.height) * u64::from(image.channels) || image.data.is_empty() {
        let problem = format!("{} bytes for {}x{} pixels of {} channels", image.data.len(), image.width, image.height, image.channels);
        return Err(Error::parameter("PNG", problem, "Pass a whole image"));
    }
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(&image.data, image.width, image.height, color)
        .map_err(|e| Error::backend("PNG encoder", e.to_string(), "Report this: every 8-bit image should encode"))?;
    Ok(bytes)
}

/// Writes a PNG file, creating its folder; the file appears complete or not at all.
pub fn write_png(path: impl AsRef<Path>, image: &Image8) -> Result<()> {
    let path = path.as_ref();
    let bytes = encode_png(image)?;
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
    }
    write_atomically(path, &bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_appear_whole_and_alone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/er/a.png");
        let image = Image8 { width: 3, height: 2, channels: 3, data: (0..18).collect() };
        write_png(&path, &image).unwrap();
        assert_eq!(image::open(&path).unwrap().to_rgb8().into_raw(), image.data);
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1, "no temporary file may stay");
        assert!(write_png(&path, &Image8 { width: 4, ..image.clone() }).is_err());
        assert_eq!(image::open(&path).unwrap().to_rgb8().into_raw(), image.data, "a failed write leaves the old file");
        assert!(write_png(path.join("below-a-file.png"), &image).is_err());
    }
}
