//! `cc4dgs view`.

use super::Context;
use crate::args::View;
use crate::models::load_model;
use cc4dgs_core::archive::{Archive, Presentation};
use cc4dgs_core::{Error, EventSink, Result, StoredModel};
use cc4dgs_play::bake::{Additions, BakeOptions, bake, write_archive};
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_play::{ArchiveOptions, presentation};
use cc4dgs_player::{Content, window};
use std::path::Path;

/// Loads the model; what moves and has no playback layer is baked now. [`show`] opens the window, on the main thread.
pub fn prepare(context: &Context, args: &View) -> Result<Content> {
    let events = context.listeners(None)?;
    let source = Source::expect(&args.model)?;
    let object = source.file.display().to_string();
    let whole = |path: &Path| Content::read(&object, std::fs::read(path).map_err(|e| Error::io(path, e))?, &context.limits);
    match source.kind {
        SourceKind::Ply | SourceKind::Spz => whole(&source.file),
        SourceKind::Checkpoint => {
            let folder = temporary()?;
            let plain = folder.path().join("model.cc4d");
            let loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
            let options = ArchiveOptions { codec: "raw", settings: &toml::Table::new(), field_weights: "fp32", scene: None };
            loaded.model.save_archive(&plain, &options, &context.registry, &context.limits, &events)?;
            baked(context, args, &plain, folder.path(), &events)
        }
        SourceKind::Archive => {
            let archive = Archive::open(&source.file, &context.limits)?;
            let stored = StoredModel::read(&object, &archive, &context.limits, &events)?;
            if stored.playback.is_some() || !stored.moves() {
                return Content::of_model(stored, archive.total_bytes()?);
            }
            let folder = temporary()?;
            baked(context, args, &source.file, folder.path(), &events)
        }
    }
}

fn temporary() -> Result<tempfile::TempDir> {
    tempfile::tempdir().map_err(|e| Error::io(std::env::temp_dir(), e))
}

/// The content of the archive at `path` with a layer.
fn baked(context: &Context, args: &View, path: &Path, folder: &Path, events: &dyn EventSink) -> Result<Content> {
    let loaded = load_model(path, &args.device, &context.registry, &context.limits, events)?;
    let archive = Archive::open(path, &context.limits)?;
    let stored = &archive.manifest().presentation;
    let options = BakeOptions { max_error: args.max_error.parse()?, cameras: &stored.cameras };
    let baked = bake(&loaded.model, &options, &loaded.device, events)?;
    let presentation = if *stored == Presentation::default() { presentation::of_gaussians(&loaded.model.gaussians, [0.0, 0.0, 1.0])? } else { stored.clone() };
    let out = folder.join("baked.cc4d");
    write_archive(&archive, Additions { baked: baked.as_ref(), presentation, poster: None, without_field: true }, &out)?;
    let archive = Archive::open(&out, &context.limits)?;
    Content::of_archive(&args.model.display().to_string(), &archive, &context.limits)
}

/// Opens the window until it is closed.
pub fn show(args: &View, content: Content) -> Result<()> {
    let title = args.model.file_name().map_or_else(|| args.model.display().to_string(), |n| n.to_string_lossy().into_owned());
    window::show(&title, content)
}
