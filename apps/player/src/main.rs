//! A window for archives with a playback layer, PLY and SPZ files: `cc4dgs view` without burn, and without what needs it.

use cc4dgs_format::{Error, Limits, Result};
use cc4dgs_player::Content;
use cc4dgs_player::window::{Opened, Shown, show};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            // Nobody is left to be told where standard error is closed.
            writeln!(std::io::stderr(), "error: {e}").ok();
            ExitCode::from(e.exit_code())
        }
    }
}

fn run() -> Result<()> {
    let usage = || Error::parameter("cc4dgs-view", "no file is named", "Write cc4dgs-view FILE, with a .cc4d archive, a PLY or an SPZ file");
    let path = std::env::args_os().nth(1).map(PathBuf::from).ok_or_else(usage)?;
    show(&path.file_name().unwrap_or_default().to_string_lossy(), Shown::Model(Box::new(open(&path)?), Box::new(open)))
}

fn open(path: &Path) -> Result<Opened> {
    let bytes = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let content = Content::read(&path.display().to_string(), bytes, &Limits::default())?;
    Ok(Opened { content, exact: Err("This program has no deformers. `cc4dgs view` has.".to_string()) })
}
