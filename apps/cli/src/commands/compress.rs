//! `cc4dgs compress`.

use super::{Context, check_file, create_parent, megabytes};
use crate::args::{COMPRESS_CODEC, COMPRESS_WEIGHTS, Compress};
use crate::ignored::{Stated, refuse_ignored};
use crate::models::load_model;
use cc4dgs::scenes::open_as_trained;
use cc4dgs_core::archive::{Archive, Presentation, StreamInfo, StreamKind, write_atomically};
use cc4dgs_core::{
    CodecPlugin, Error, Event, EventSink, Plugin, PluginEntry, Registry, Result, TuneModel, WeightCodecPlugin, config, read_gaussians, read_weights,
};
use cc4dgs_play::field_weights::FieldWeights;
use cc4dgs_play::model::ModelSize;
use cc4dgs_play::source::{Source, SourceKind};
use cc4dgs_play::{ArchiveOptions, Model, OrbitViews, ViewSource};
use cc4dgs_train::eval::SizeMb;
use cc4dgs_train::train::{TuneJob, Tuner};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::time::Instant;

/// The result of compression.
#[derive(Serialize)]
pub struct CompressReport {
    pub archive: PathBuf,
    pub codec: String,
    pub gaussians: usize,
    pub bytes: u64,
    pub size_mb: SizeMb,
    /// Float32 size of what the archive stands for, over the archive's.
    pub ratio: f64,
    pub seconds: f64,
    /// What decoding the Gaussians of the file that was written took.
    pub decode_seconds: f64,
    /// What was warned of while the model was stored.
    pub warnings: Vec<String>,
    pub streams: Vec<StreamSize>,
}

/// One stream of an archive.
#[derive(Serialize)]
pub struct StreamSize {
    pub name: String,
    /// `canonical`, `field`, `meta`, `playback`, `poster` or `other`.
    pub kind: &'static str,
    pub decoded_bytes: u64,
    pub stored_bytes: u64,
}

impl From<StreamInfo> for StreamSize {
    fn from(info: StreamInfo) -> Self {
        let kind = match info.kind {
            StreamKind::Canonical => "canonical",
            StreamKind::Field => "field",
            StreamKind::Meta => "meta",
            StreamKind::Playback => "playback",
            StreamKind::Poster => "poster",
            StreamKind::Other(_) => "other",
        };
        Self { name: info.name, kind, decoded_bytes: info.decoded_bytes, stored_bytes: info.stored_bytes }
    }
}

/// Passes events on and keeps the warnings.
struct Warnings<'a> {
    to: &'a dyn EventSink,
    kept: Mutex<Vec<String>>,
}

impl EventSink for Warnings<'_> {
    fn emit(&self, event: &Event) {
        if let Event::Warning { object, message } = event
            && let Ok(mut kept) = self.kept.lock()
        {
            kept.push(format!("{object}: {message}"));
        }
        self.to.emit(event);
    }
}

static NEVER: AtomicBool = AtomicBool::new(false);

pub fn run(context: &Context, args: &Compress) -> Result<()> {
    check_file(&args.out, args.overwrite)?;
    let mut settings = toml::Table::new();
    let (scene_sets, codec_sets): (Vec<String>, Vec<String>) = args.sets.iter().cloned().partition(|set| set.starts_with("scene."));
    if args.scene.is_none() && !scene_sets.is_empty() {
        return Err(Error::parameter("--set", "scene options without --scene", "Name the dataset that the model was trained on"));
    }
    config::set_all(&mut settings, &codec_sets)?;
    // Unknown names and settings, what needs a scene, and options without effect are refused before anything is read.
    ArchiveOptions::check(&args.codec, &settings, &args.field_weights, args.scene.is_some(), &context.registry)?;
    // Runs and archives state their background; where there is no model, loading it says so.
    let has_background = matches!(Source::find(&args.model), Ok(Some(source)) if matches!(source.kind, SourceKind::Checkpoint | SourceKind::Archive));
    refuse_unused_views(&context.registry, args, true, !has_background)?;
    let events = context.listeners(None)?;
    let mut loaded = load_model(&args.model, &args.device, &context.registry, &context.limits, &events)?;
    say_what_is_lost(context, &args.model, &events)?;
    let has_weights = loaded.model.field.as_ref().is_some_and(|of| !of.field.is_static());
    refuse_unused_views(&context.registry, args, has_weights, loaded.model.background.is_none())?;
    let scene =
        args.scene.as_ref().map(|path| open_as_trained(path, &loaded.model, &scene_sets, &context.registry, &context.limits)).transpose()?.map(Arc::new);
    // PLY files state no background.
    loaded.model.background = loaded.model.background.or(scene.as_ref().and_then(|scene| scene.background));
    let tuner = scene.as_ref().map(|scene| {
        let (registry, limits, events) = (&context.registry, &context.limits, &events);
        // Ctrl-C ends the process: the archive is not there before it is complete.
        Tuner::new(TuneJob {
            model: &loaded.model,
            scene: scene.clone(),
            field_weights: &args.field_weights,
            registry,
            device: &loaded.device,
            limits,
            events,
            stop: &NEVER,
        })
    });
    let orbit = args.orbit.map(|count| OrbitViews::around(&loaded.model.gaussians, OrbitViews::SIZE, count)).transpose()?;
    let source = scene.as_deref().map(ViewSource::Scene).or(orbit.as_ref().map(ViewSource::Orbit));
    let options = ArchiveOptions {
        codec: &args.codec,
        settings: &settings,
        field_weights: &args.field_weights,
        views: source.map(|source| (source, &loaded.device)),
        tuner: tuner.as_ref().map(|tuner| tuner as &dyn TuneModel),
    };
    let report = compress(context, &loaded.model, &options, &args.out, &events)?;
    if let Some(message) = smaller(&args.codec, &args.field_weights, report.size_mb.deform > 0.0) {
        events.emit(&Event::Note { object: report.archive.display().to_string(), message });
    }
    context.output.result(&report, || text(&report))
}

/// Refuses --scene and --orbit where neither the codec nor the weight codec makes use of views. `has_weights` says whether the model has weights of a deformer,
/// `takes_background` whether it gets the background of the scene, which is of use with any codec.
fn refuse_unused_views(registry: &Registry, args: &Compress, has_weights: bool, takes_background: bool) -> Result<()> {
    let codec = args.codec.split(':').next().unwrap_or_default();
    let weights = FieldWeights::parse(&args.field_weights, registry)?;
    let of_weights = has_weights && (weights.max_drop_db.is_some() || uses_views(&registry.weight_codec(&weights.name)?.info));
    let used = of_weights || uses_views(&registry.codec(codec)?.info);
    let names = |kind: &str| {
        let users = registry.plugins().into_iter().filter(|(of, info)| *of == kind && uses_views(info));
        users.map(|(_, info)| info.name).collect::<Vec<_>>().join(", ")
    };
    let (beside, weight_codecs) = match has_weights {
        true => (format!("beside the weight codec {}", args.field_weights), format!(", --field-weights {}", names(WeightCodecPlugin::KIND))),
        false => ("of a model without a deformer".to_string(), String::new()),
    };
    let subject = format!("the codec {} {beside}", args.codec);
    let remedy = format!("Leave it out, or choose what makes use of views: --codec {}{weight_codecs}", names(CodecPlugin::KIND));
    let options = [
        ("--scene", args.scene.as_ref().map(|scene| scene.display().to_string()), used || takes_background),
        ("--orbit", args.orbit.map(|count| count.to_string()), used),
    ];
    refuse_ignored(&subject, options.map(|(option, value, used)| Stated { option, value, used, remedy: remedy.clone() }))
}

/// Whether a codec or a weight codec makes use of views, which it says by its capabilities.
fn uses_views(info: &Plugin) -> bool {
    ["views", "importance"].iter().any(|capability| info.capabilities.contains(capability))
}

/// What makes a smaller file where no codec was chosen; `deforms` says whether there are weights of a deformer.
fn smaller(codec: &str, field_weights: &str, deforms: bool) -> Option<String> {
    let weights = if deforms && field_weights == COMPRESS_WEIGHTS { ", and --field-weights fp16 or compact" } else { "" };
    let options = "--codec compact:max-drop=0.05dB with the dataset (--scene), compact:psnr=45dB without it (--orbit 64)";
    (codec == COMPRESS_CODEC).then(|| format!("what makes it smaller: {options}{weights}"))
}

/// Warns where `model` is an archive that was baked: a new one plays at another rate and from another camera.
pub fn say_what_is_lost(context: &Context, model: &Path, events: &dyn EventSink) -> Result<()> {
    let source = Source::expect(model)?;
    if source.kind == SourceKind::Archive && Archive::open(&source.file, &context.limits)?.manifest().presentation != Presentation::default() {
        let message = "frame rate, cameras, poster and playback layer are left out: bake the new archive again".into();
        events.emit(&Event::Warning { object: model.display().to_string(), message });
    }
    Ok(())
}

/// Writes `model` to the archive `out` after decoding it, so that what cannot be decoded is an error here and not at its reader, and replaces no file.
pub fn compress(context: &Context, model: &Model, options: &ArchiveOptions, out: &Path, events: &dyn EventSink) -> Result<CompressReport> {
    let began = Instant::now();
    create_parent(out)?;
    let object = out.display().to_string();
    let warned = Warnings { to: events, kept: Mutex::default() };
    let file = model.to_archive(options, &context.registry, &context.limits, &warned)?;
    let (bytes, seconds) = (file.len() as u64, began.elapsed().as_secs_f64());
    let archive = Archive::from_bytes(object.clone(), file.clone(), &context.limits)?;
    let began = Instant::now();
    read_gaussians(&object, &archive, &context.limits, events)?;
    let decode_seconds = began.elapsed().as_secs_f64();
    if let Some(deformer) = &archive.manifest().deformer {
        read_weights(&object, &archive, &deformer.weights, None, &context.limits, events)?;
    }
    write_atomically(out, &file)?;
    events.emit(&Event::Saved { path: object, bytes });
    let stored = archive.stream_sizes();
    let of_kind = |kind| stored.iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum();
    let size = ModelSize { deform: of_kind(StreamKind::Field), point_cloud: of_kind(StreamKind::Canonical), total: bytes, ..model.float32_size() };
    Ok(CompressReport {
        archive: out.to_path_buf(),
        codec: options.codec.to_string(),
        gaussians: model.gaussians.len(),
        bytes,
        size_mb: size.into(),
        ratio: model.float32_size().total as f64 / bytes.max(1) as f64,
        seconds,
        decode_seconds,
        warnings: warned.kept.into_inner().unwrap_or_default(),
        streams: stored.into_iter().map(StreamSize::from).collect(),
    })
}

/// The report for people.
pub fn text(report: &CompressReport) -> String {
    let mut lines = vec![format!(
        "{}: {:.4} MB (deform {:.4} MB, point cloud {:.4} MB), {} Gaussians, {:.1}x smaller than float32, {} in {:.1} s, decoded in {:.3} s",
        report.archive.display(),
        report.size_mb.total,
        report.size_mb.deform,
        report.size_mb.point_cloud,
        report.gaussians,
        report.ratio,
        report.codec,
        report.seconds,
        report.decode_seconds
    )];
    lines.extend(report.streams.iter().map(stream_line));
    lines.join("\n")
}

/// One stream for people.
pub fn stream_line(stream: &StreamSize) -> String {
    format!("  {:<28} {:>12.6} MB stored, {:>12.6} MB decoded", stream.name, megabytes(stream.stored_bytes), megabytes(stream.decoded_bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Cli, Command};
    use cc4dgs_core::Recorder;
    use clap::Parser;

    /// What `compress` says of the views in `line`.
    fn refused(line: &str, has_weights: bool, takes_background: bool) -> Option<String> {
        let cli = Cli::try_parse_from(format!("cc4dgs compress model --out a.cc4d {line}").split_whitespace()).unwrap();
        let Command::Compress(args) = &cli.command else { panic!("{line}") };
        refuse_unused_views(&Registry::collect().unwrap(), args, has_weights, takes_background).err().map(|error| error.to_string())
    }

    #[test]
    fn views_that_nothing_measures_in_are_refused() {
        let message = refused("--orbit 16 --codec raw", true, true).unwrap();
        let expected = "--orbit 16: it has no effect on the codec raw beside the weight codec fp32. \
             Leave it out, or choose what makes use of views: --codec compact, --field-weights compact";
        assert_eq!(message, expected);
        let message = refused("--scene a --field-weights compact", false, false).unwrap();
        let expected = "--scene a: it has no effect on the codec cca:default of a model without a deformer. \
             Leave it out, or choose what makes use of views: --codec compact";
        assert_eq!(message, expected);
        assert!(refused("--scene a --codec quantize:high --field-weights int8", true, false).is_some());
        for (line, has_weights, takes_background) in [
            ("--codec raw", true, false),
            ("--scene a --codec raw", false, true),
            ("--scene a --codec compact", false, false),
            ("--orbit 16 --codec compact:psnr=45dB", false, false),
            ("--orbit 16 --codec raw --field-weights compact:bits=6", true, false),
            ("--scene a --field-weights compact:max-drop=0.01dB", true, false),
        ] {
            assert_eq!(refused(line, has_weights, takes_background), None, "{line}");
        }
    }

    #[test]
    fn who_chose_no_codec_is_told_what_makes_files_smaller() {
        let said = |field_weights, deforms| smaller(COMPRESS_CODEC, field_weights, deforms).unwrap();
        assert!(said(COMPRESS_WEIGHTS, true).contains("--codec compact") && said(COMPRESS_WEIGHTS, true).contains("--field-weights"));
        assert!(!said("fp16", true).contains("--field-weights") && !said(COMPRESS_WEIGHTS, false).contains("--field-weights"));
        assert_eq!(smaller("raw", COMPRESS_WEIGHTS, true), None);
    }

    #[test]
    fn warnings_are_kept_for_the_report() {
        let events = Recorder::default();
        let warned = Warnings { to: &events, kept: Mutex::default() };
        let (object, message) = (|| "codec compact".to_string(), || "the search ended".to_string());
        let all = [Event::Note { object: object(), message: message() }, Event::Warning { object: object(), message: message() }];
        all.iter().for_each(|event| warned.emit(event));
        assert_eq!((events.events().as_slice(), warned.kept.into_inner().unwrap()), (&all[..], vec!["codec compact: the search ended".to_string()]));
    }
}
