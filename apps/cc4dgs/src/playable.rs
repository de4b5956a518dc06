//! Models as archives that players without the deformer show: with a playback layer, cameras and a poster.

use crate::Session;
use crate::play::bake::{AddedMotion, Additions, BakeOptions, BakeReport, MaxError, bake, with_additions};
use crate::play::source::{Source, SourceKind};
use burn::tensor::Device;
use cc4dgs_core::archive::{Archive, Presentation, StreamKind};
use cc4dgs_core::playback::PlaybackLayer;
use cc4dgs_core::{Camera, EventSink, Limits, Registry, Result};
use cc4dgs_play::model::Model as PlayModel;
use cc4dgs_play::{ArchiveOptions, Player, presentation};
use cc4dgs_train::images::encode_png;
use std::path::Path;
use std::sync::atomic::AtomicBool;

/// Longer side of the poster in pixels.
const POSTER: u32 = 320;

/// Registry, device, limits, events and stop flag of the work.
#[derive(Clone, Copy)]
pub struct Surroundings<'a> {
    /// The linked plug-ins.
    pub registry: &'a Registry,
    /// The device of the deformer.
    pub device: &'a Device,
    /// Limits on what is read.
    pub limits: &'a Limits,
    /// Receives progress.
    pub events: &'a dyn EventSink,
    /// Ends baking with [`Error::Interrupted`](crate::Error::Interrupted) once it is set.
    pub stop: &'a AtomicBool,
}

impl<'a> Surroundings<'a> {
    /// Those of a session, with its own stop flag.
    pub fn of(session: &'a Session, stop: &'a AtomicBool) -> Self {
        Self { registry: session.registry(), device: session.device(), limits: session.limits(), events: session.events(), stop }
    }
}

/// How models that are no archive yet are stored.
#[derive(Clone, Copy, Debug)]
pub struct Storage<'a> {
    /// Codec of the Gaussians: `name` or `name:profile`.
    pub codec: &'a str,
    /// Weight codec of the deformer.
    pub field_weights: &'a str,
}

impl Default for Storage<'_> {
    fn default() -> Self {
        Self { codec: "quantize:high", field_weights: "fp16" }
    }
}

/// An archive and the model that is decoded from it: codecs round and reorder Gaussians.
pub struct Stored {
    /// The archive.
    pub archive: Archive,
    /// Its model.
    pub model: PlayModel,
}

/// How [`Stored::playable`] completes an archive.
pub struct PlayableOptions<'a> {
    /// How far a point may be off; `None` keeps a layer that the archive has, and bakes within 0.1 pixels where there is none.
    pub max_error: Option<MaxError>,
    /// Cameras of the recording, in the coordinates of the model: those in which pixels are counted. Without any, those of the archive, or an orbit.
    pub cameras: &'a [Camera],
    /// Clock and cameras that players offer.
    pub presentation: Presentation,
    /// Whether to store a small image of the home camera at half time.
    pub poster: bool,
    /// Whether to leave the deformer's weights out, unless players compute the motion from them.
    pub without_field: bool,
    /// Whether to bake a layer even where players can compute the motion from the deformer's weights.
    pub baked: bool,
}

/// An archive that plays, and the report about its layer.
pub struct Playable {
    /// The archive.
    pub bytes: Vec<u8>,
    /// Figures of the layer; absent where nothing moves, or where the layer was there before.
    pub report: Option<BakeReport>,
}

impl Stored {
    /// The model at `path`: an archive as it is, all others stored in memory first.
    ///
    /// # Errors
    /// As [`PlayModel::open`] and [`PlayModel::to_archive`].
    pub fn open(path: &Path, storage: Storage, around: Surroundings) -> Result<Self> {
        let source = Source::expect(path)?;
        if source.kind == SourceKind::Archive {
            return Self::of_archive(&source.file.display().to_string(), Archive::open(&source.file, around.limits)?, around);
        }
        Self::of_model(&PlayModel::open(path, around.registry, around.device, around.limits, around.events)?, storage, around)
    }
    /// `model` stored in memory.
    ///
    /// # Errors
    /// As [`PlayModel::to_archive`].
    pub fn of_model(model: &PlayModel, storage: Storage, around: Surroundings) -> Result<Self> {
        let Storage { codec, field_weights } = storage;
        let options = ArchiveOptions { codec, settings: &toml::Table::new(), field_weights, views: None, tuner: None };
        let bytes = model.to_archive(&options, around.registry, around.limits, around.events)?;
        Self::of_archive("the stored model", Archive::from_bytes("the stored model", bytes, around.limits)?, around)
    }
    fn of_archive(object: &str, archive: Archive, around: Surroundings) -> Result<Self> {
        let model = PlayModel::of_archive(object, &archive, around.registry, around.device, around.limits, around.events)?;
        Ok(Self { archive, model })
    }
    /// Bytes of the archive's streams of one kind, as stored.
    pub fn bytes_of(&self, kind: StreamKind) -> u64 {
        self.archive.stream_sizes().iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum()
    }
    /// What the archive says of clock and cameras; where it has no home camera, that of `cameras`, or of an orbit with `up` if there are none.
    ///
    /// # Errors
    /// As [`presentation::of_gaussians`].
    pub fn presentation(&self, cameras: &[Camera], up: Option<[f64; 3]>) -> Result<Presentation> {
        let stored = &self.archive.manifest().presentation;
        if stored.home.is_some() {
            return Ok(stored.clone());
        }
        let found = presented(&self.model, cameras, up)?;
        Ok(Presentation { frames_per_second: stored.frames_per_second, seconds: stored.seconds, ..found })
    }
    /// The motion as players compute it from the deformer's weights; `None` where the archive has a layer, or needs one.
    ///
    /// # Errors
    /// As [`PlaybackLayer::computed`].
    pub fn computed_motion(&self, around: Surroundings) -> Result<Option<PlaybackLayer>> {
        if !PlaybackLayer::may_be_computed(&self.archive)? {
            return Ok(None);
        }
        PlaybackLayer::computed("the stored model", &self.archive, &self.model.gaussians, self.model.moving, around.limits)
    }
    /// The archive with a playback layer, cameras and a poster.
    ///
    /// # Errors
    /// What baking, rendering and the presentation report.
    pub fn playable(&self, options: PlayableOptions, around: Surroundings) -> Result<Playable> {
        options.presentation.validate("presentation")?;
        let stored = &self.archive.manifest().presentation.cameras;
        let cameras = if options.cameras.is_empty() { stored.as_slice() } else { options.cameras };
        let computed = !options.baked && self.computed_motion(around)?.is_some();
        let kept = computed || options.max_error.is_none() && self.bytes_of(StreamKind::Playback) > 0;
        let baked = if kept {
            None
        } else {
            let max_error = options.max_error.unwrap_or(MaxError::Pixels(0.1));
            bake(&self.model, &BakeOptions { max_error, cameras, stop: around.stop }, around.device, around.events)?
        };
        let poster = match &options.presentation.home {
            Some(home) if options.poster => Some(poster(&self.model, home, around)?),
            _ => None,
        };
        let additions = Additions {
            motion: if kept { AddedMotion::Kept } else { AddedMotion::Replaced(baked.as_ref()) },
            presentation: options.presentation,
            poster,
            without_field: options.without_field && !computed,
        };
        Ok(Playable { bytes: with_additions(&self.archive, additions)?, report: baked.map(|b| b.report) })
    }
}

/// The presentation of `model` that was recorded by `cameras`, or of an orbit around it if there are none; `up` points up where it is given.
///
/// # Errors
/// As [`presentation::of_gaussians`].
pub fn presented(model: &PlayModel, cameras: &[Camera], up: Option<[f64; 3]>) -> Result<Presentation> {
    if cameras.is_empty() {
        presentation::of_gaussians(&model.gaussians, up.unwrap_or([0.0, 0.0, 1.0]))
    } else {
        Ok(presentation::of_recorded(model, cameras, up))
    }
}

/// The model at half time, from its home camera, as a PNG.
fn poster(model: &PlayModel, home: &Camera, around: Surroundings) -> Result<Vec<u8>> {
    let scale = f64::from(POSTER) / f64::from(home.width.max(home.height));
    let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    let camera = home.resized(side(home.width), side(home.height));
    encode_png(&Player::new(model, around.registry, around.device)?.frame(&camera, 0.5)?)
}
