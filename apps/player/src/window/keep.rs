//! What a user takes along: images, and the command that opens the window at this time and pose.

use super::{Start, Window};
use crate::View;
use crate::desktop::image_file::{free_name, png_bytes};
use cc4dgs_format::archive::write_atomically;
use cc4dgs_format::{Image8, Result};
use std::io::Write;
use std::path::Path;

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
        let start = Start { time: Some(self.clock.time), pose: Some(self.navigator.pose_shown(self.drawn.0, self.drawn.1)) };
        self.source.as_ref().map(|source| start.command(&source.command, &source.path))
    }
    /// Writes the command that opens this file at this time and pose to standard output, and shows it. Clipboards need a library per window system, which is
    /// not here.
    pub(super) fn print_command(&mut self) {
        if let Some(command) = self.command() {
            // Nobody reads it where standard output is closed; the window shows it, too.
            writeln!(std::io::stdout(), "{command}").ok();
            self.notice = Some(format!("Printed: {command}"));
        }
    }
}
