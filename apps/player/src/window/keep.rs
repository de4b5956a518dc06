//! What a user takes along: images, and the command that opens the window at this time and pose.

use super::{Start, Window};
use crate::View;
use cc4dgs_format::archive::write_atomically;
use cc4dgs_format::{Error, Image8, Result};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Files of one frame that are looked for before the user is asked to tidy up.
const MOST_FILES: usize = 1000;

impl Window {
    /// Saves the image in the window as PNG: the exact one where it is shown and complete, else the player's.
    pub(super) fn save_png(&mut self) {
        let saved = self.current_image().and_then(|(image, by)| {
            let name = self.file().and_then(Path::file_stem).map_or_else(|| "training".into(), |stem| stem.to_string_lossy().into_owned());
            let path = free_name(Path::new(""), &format!("{name}_frame_{:04}", self.clock.frame()))?;
            write_atomically(&path, &png_bytes(&image)?)?;
            let full = std::path::absolute(&path).unwrap_or(path);
            Ok(format!("Saved {} ({}×{} pixels, {by})", full.display(), image.width, image.height))
        });
        match saved {
            Ok(text) => self.notice = Some(text),
            Err(e) => self.complain(e.to_string()),
        }
    }
    /// The image that the window shows, and what drew it.
    fn current_image(&mut self) -> Result<(Image8, &'static str)> {
        if let Some(image) = self.exact.complete() {
            return Ok((image.clone(), "exact"));
        }
        let (width, height) = self.drawn;
        let view: View = self.view(width, height);
        Ok((self.renderer.image(&view)?, "drawn by the player"))
    }
    /// The command that opens this file at this time and pose, where there is a file.
    pub(super) fn command(&self) -> Option<String> {
        let start = Start { time: Some(self.clock.time), pose: Some(self.navigator.pose()) };
        self.source.as_ref().map(|source| start.command(&source.command, &source.path))
    }
    /// Writes the command that opens this file at this time and pose to standard output, and shows it. Clipboards need a library per window system, which is not here.
    pub(super) fn print_command(&mut self) {
        if let Some(command) = self.command() {
            // Nobody reads it where standard output is closed; the window shows it, too.
            writeln!(std::io::stdout(), "{command}").ok();
            self.notice = Some(format!("Printed: {command}"));
        }
    }
}

/// `stem`.png in `folder`, or the first of `stem`-2.png and so on that does not exist.
fn free_name(folder: &Path, stem: &str) -> Result<PathBuf> {
    let names = (1..=MOST_FILES).map(|k| folder.join(if k == 1 { format!("{stem}.png") } else { format!("{stem}-{k}.png") }));
    let free = names.into_iter().find(|path| !path.exists());
    free.ok_or_else(|| Error::limit(format!("files {stem}-….png"), MOST_FILES as u64 + 1, MOST_FILES as u64, "Move some of them elsewhere"))
}

fn png_bytes(image: &Image8) -> Result<Vec<u8>> {
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
