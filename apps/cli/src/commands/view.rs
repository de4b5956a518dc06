//! `cc4dgs view`.

use super::view_command::view_command;
use super::{Context, exact};
use crate::args::View;
use cc4dgs::playable::{PlayableOptions, Storage, Stored, Surroundings};
use cc4dgs_core::archive::{Archive, Manifest};
use cc4dgs_core::{EventSink, Limits, Registry, Result, Silent, StoredModel, parse_device};
use cc4dgs_play::bake::MaxError;
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_player::Content;
use cc4dgs_player::window::{self, Opened, Shown, Start};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// How models are opened.
#[derive(Clone)]
struct Options {
    device: String,
    max_error: MaxError,
    limits: Limits,
}

impl Options {
    fn of(args: &View, limits: Limits) -> Result<Self> {
        Ok(Self { device: args.device.clone(), max_error: args.max_error.parse()?, limits })
    }
    /// Loads the model at `path`; what moves and has no playback layer is baked now.
    fn open(&self, path: &Path, registry: &Registry, events: &dyn EventSink) -> Result<Opened> {
        // First, so that a change of the file after this is noticed.
        let exact = exact::of_file(path, &self.device, self.limits);
        Ok(Opened { content: content(path, self, registry, events)?, exact })
    }
}

/// Loads the model that the command names. [`show`] opens the window, on the main thread.
pub fn prepare(context: &Context, args: &View) -> Result<Opened> {
    start(args)?;
    Options::of(args, context.limits)?.open(&args.model, &context.registry, &context.listeners(None)?)
}

fn start(args: &View) -> Result<Start> {
    Ok(Start { time: args.time.as_deref().map(Start::parse_time).transpose()?, pose: args.pose.as_deref().map(Start::parse_pose).transpose()? })
}

fn content(path: &Path, options: &Options, registry: &Registry, events: &dyn EventSink) -> Result<Content> {
    let Options { device, max_error, limits } = options;
    let source = Source::expect(path)?;
    let object = source.file.display().to_string();
    match source.kind {
        SourceKind::Ply | SourceKind::Spz => return read(&source.file, limits),
        SourceKind::Archive => {
            let archive = Archive::open(&source.file, limits)?;
            let stored = StoredModel::read(&object, &archive, limits, events)?;
            if stored.playback.is_some() || !stored.moves() {
                return Content::of_model(stored, archive.total_bytes()?);
            }
        }
        SourceKind::Checkpoint => {}
    }
    let device = parse_device(device)?;
    // Ctrl-C ends the process: nothing is written.
    let around = Surroundings { registry, device: &device, limits, events, stop: &AtomicBool::new(false) };
    let stored = Stored::open(path, Storage { codec: "raw", field_weights: "fp32" }, around)?;
    let presentation = stored.presentation(&[], None)?;
    if let Some(motion) = stored.computed_motion(around)? {
        let Stored { archive, model } = stored;
        let manifest = Manifest { presentation, ..archive.manifest().clone() };
        let stored = StoredModel { manifest, gaussians: model.gaussians, moving: model.moving, playback: Some(motion) };
        return Content::of_model(stored, archive.total_bytes()?);
    }
    let options = PlayableOptions { max_error: Some(*max_error), cameras: &[], presentation, poster: false, without_field: true, baked: true };
    let playable = stored.playable(options, around)?;
    Content::read(&object, playable.bytes, limits)
}

fn read(file: &Path, limits: &Limits) -> Result<Content> {
    Content::read(&file.display().to_string(), limits.read_file(file)?, limits)
}

/// Opens the window until it is closed.
pub fn show(args: &View, limits: Limits, opened: Opened) -> Result<()> {
    let title = args.model.file_name().map_or_else(|| args.model.display().to_string(), |n| n.to_string_lossy().into_owned());
    let options = Options::of(args, limits)?;
    // On a thread of the pool, as all commands: baking computes in parallel.
    let open = move |path: &Path| rayon::scope(|_| options.open(path, &Registry::collect()?, &Silent));
    let command = view_command(&args.device, &args.max_error, &limits)?;
    let source = window::Source { path: args.model.clone(), open: Arc::new(open), start: start(args)?, command };
    window::show(&title, Shown::Model(Box::new(opened), source))
}
