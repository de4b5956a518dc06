//! A window for archives with a playback layer or the weights of `cdf-basis` or `hash-basis`, PLY and SPZ files: `cc4dgs view` without burn, and without what
//! needs it.

use cc4dgs_format::{Error, Limits, Result};
use cc4dgs_player::Content;
use cc4dgs_player::window::{Opened, Shown, Source, Start, show};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

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
    let usage =
        |problem: String| Error::parameter("cc4dgs-view", problem, "Write cc4dgs-view FILE [--time T] [--pose=P], with a .cc4d archive, a PLY or an SPZ file");
    let (mut path, mut start) = (None, Start::default());
    let mut arguments = std::env::args_os().skip(1);
    while let Some(argument) = arguments.next() {
        let text = argument.to_string_lossy().into_owned();
        let (name, joined) = text.split_once('=').map_or((text.as_str(), None), |(name, value)| (name, Some(value.to_string())));
        let mut value =
            || joined.clone().or_else(|| arguments.next().map(|v| v.to_string_lossy().into_owned())).ok_or_else(|| usage(format!("{name} has no value")));
        match name {
            "--time" => start.time = Some(Start::parse_time(&value()?)?),
            "--pose" => start.pose = Some(Start::parse_pose(&value()?)?),
            _ if text.starts_with('-') => return Err(usage(format!("{name} is none of its options"))),
            _ if path.is_none() => path = Some(PathBuf::from(&argument)),
            _ => return Err(usage(format!("{text:?} is one argument too many"))),
        }
    }
    let path = path.ok_or_else(|| usage("no file is named".into()))?;
    let title = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let opened = Box::new(open(&path)?);
    show(&title, Shown::Model(opened, Source { path, open: Arc::new(open), start, command: "cc4dgs-view".into() }))
}

fn open(path: &Path) -> Result<Opened> {
    let limits = Limits::default();
    let content = Content::read(&path.display().to_string(), limits.read_file(path)?, &limits)?;
    Ok(Opened { content, exact: Err("This program has no deformers. `cc4dgs view` has.".to_string()) })
}
