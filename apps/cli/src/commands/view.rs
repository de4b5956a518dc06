//! `cc4dgs view`.

use super::{Context, exact};
use crate::args::View;
use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings};
use cc4dgs_core::archive::Archive;
use cc4dgs_core::{Error, Limits, Result, StoredModel, parse_device};
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_player::Content;
use cc4dgs_player::window::{self, Opened, Shown};
use std::path::Path;

/// Loads the model; what moves and has no playback layer is baked now. [`show`] opens the window, on the main thread.
pub fn prepare(context: &Context, args: &View) -> Result<Opened> {
    // First, so that a change of the file after this is noticed.
    let exact = exact::of_file(&args.model, &args.device, context.limits);
    Ok(Opened { content: content(context, args)?, exact })
}

fn content(context: &Context, args: &View) -> Result<Content> {
    let events = context.listeners(None)?;
    let source = Source::expect(&args.model)?;
    let object = source.file.display().to_string();
    match source.kind {
        SourceKind::Ply | SourceKind::Spz => return read(&source.file, &context.limits),
        SourceKind::Archive => {
            let archive = Archive::open(&source.file, &context.limits)?;
            let stored = StoredModel::read(&object, &archive, &context.limits, &events)?;
            if stored.playback.is_some() || !stored.moves() {
                return Content::of_model(stored, archive.total_bytes()?);
            }
        }
        SourceKind::Checkpoint => {}
    }
    let device = parse_device(&args.device)?;
    let around = Surroundings { registry: &context.registry, device: &device, limits: &context.limits, events: &events };
    let stored = Stored::open(&args.model, Storage { codec: "raw", field_weights: "fp32" }, around)?;
    let presentation = stored.presentation(&[], None)?;
    let options = PlayableOptions { max_error: Some(args.max_error.parse()?), cameras: &[], presentation, poster: false, without_field: true };
    let playable = stored.playable(options, around)?;
    Content::read(&object, playable.bytes, &context.limits)
}

fn read(file: &Path, limits: &Limits) -> Result<Content> {
    Content::read(&file.display().to_string(), std::fs::read(file).map_err(|e| Error::io(file, e))?, limits)
}

/// Opens the window until it is closed.
pub fn show(args: &View, limits: Limits, opened: Opened) -> Result<()> {
    let title = args.model.file_name().map_or_else(|| args.model.display().to_string(), |n| n.to_string_lossy().into_owned());
    let device = args.device.clone();
    let open = move |path: &Path| {
        let exact = exact::of_file(path, &device, limits);
        Ok(Opened { content: read(path, &limits)?, exact })
    };
    window::show(&title, Shown::Model(Box::new(opened), Box::new(open)))
}
