//! A model as an archive holds it, opened without its deformer.

use crate::archive::{Archive, Manifest, StreamKind};
use crate::playback::PlaybackLayer;
use crate::plugin::{Entries, PluginEntry};
use crate::{CodecContext, CodecPlugin, Error, EventSink, HostGaussians, Limits, Moving, Result, Seed};
use std::path::Path;

/// Key of the manifest's `extra` under which [`Moving`] is stored.
pub const MOVING: &str = "moving";

/// The Gaussians of an archive, and their motion if it has a playback layer: what a player without burn needs.
#[derive(Clone, Debug)]
pub struct StoredModel {
    /// The archive's manifest.
    pub manifest: Manifest,
    /// The canonical Gaussians.
    pub gaussians: HostGaussians,
    /// What the deformer may move.
    pub moving: Moving,
    /// The motion.
    pub playback: Option<PlaybackLayer>,
}

impl StoredModel {
    /// Opens the archive at `path`. Codecs are those linked into the program.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for codecs that are not linked and for other versions; [`Error::Data`], [`Error::Limit`] and [`Error::Io`] as [`Archive::open`].
    pub fn open(path: impl AsRef<Path>, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let path = path.as_ref();
        Self::read(&path.display().to_string(), &Archive::open(path, limits)?, limits, events)
    }
    /// As [`StoredModel::open`], from an open archive; `object` names it in errors.
    pub fn read(object: &str, archive: &Archive, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let manifest = archive.manifest().clone();
        let gaussians = read_gaussians(object, archive, limits, events)?;
        let moving = Moving::of_manifest(object, &manifest)?;
        let streams = archive.read_kind(StreamKind::Playback)?;
        let playback = if streams.is_empty() { None } else { Some(PlaybackLayer::decode(&streams, gaussians.len(), gaussians.sh_degree, limits)?) };
        Ok(Self { manifest, gaussians, moving, playback })
    }
    /// Whether the model moves, so that it needs a deformer or a playback layer.
    pub fn moves(&self) -> bool {
        self.manifest.deformer.is_some() && self.moving.rows(&self.gaussians.dynamic_scores).is_none_or(|rows| !rows.is_empty())
    }
    /// The Gaussians at `time_norm` (0..1), in the order of the archive.
    ///
    /// # Errors
    /// [`Error::Unsupported`] for a model that moves and has no playback layer.
    pub fn gaussians_at(&self, time_norm: f32) -> Result<HostGaussians> {
        match &self.playback {
            Some(layer) => Ok(layer.apply(&self.gaussians, time_norm)),
            None if !self.moves() => Ok(self.gaussians.clone()),
            None => Err(Error::unsupported("archive", "it has no playback layer", "Add one with `cc4dgs bake MODEL --out FILE.cc4d`")),
        }
    }
}

impl Moving {
    /// What the deformer of the archive with this manifest may move.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn of_manifest(object: &str, manifest: &Manifest) -> Result<Self> {
        match manifest.extra.get(MOVING) {
            Some(value) => {
                serde_json::from_value(value.clone()).map_err(|e| Error::data(object, format!("moving: {e}"), "The archive is damaged; fetch it again"))
            }
            None => Ok(Self::Scored { zeta: manifest.dynamic_threshold }),
        }
    }
}

/// The canonical Gaussians of `archive`, decoded by its codec, which must be linked; `object` names the archive in errors.
///
/// # Errors
/// [`Error::Unsupported`] for a codec that is not linked or has another version, [`Error::Data`] for streams that are damaged or contradict the manifest,
/// [`Error::Limit`].
pub fn read_gaussians(object: &str, archive: &Archive, limits: &Limits, events: &dyn EventSink) -> Result<HostGaussians> {
    let manifest = archive.manifest();
    let entry = &manifest.codec;
    let linked = Entries::<CodecPlugin>::collect()?;
    let Some(plugin) = linked.iter().find(|p| p.info().name == entry.name) else {
        let names: Vec<&str> = linked.iter().map(|p| p.info().name).collect();
        let remedy = format!("Use a program that links the crate of this codec; this one links {}", names.join(", "));
        let problem = format!("it needs the codec '{}' (version {}), which is not linked into this program", entry.name, entry.version);
        return Err(Error::unsupported(object, problem, remedy));
    };
    if plugin.info.version != entry.version {
        let problem = format!("version {} of its stored form", entry.version);
        return Err(Error::unsupported(format!("{object}: codec {}", entry.name), problem, format!("This program reads version {}", plugin.info.version)));
    }
    let codec = (plugin.build)(&entry.profile, &entry.settings)?;
    let context = CodecContext::new(Seed::root(manifest.provenance.seed).child("codec"), *limits, events);
    let gaussians = codec.decode(&archive.read_kind(StreamKind::Canonical)?, &context)?;
    gaussians.validate(object, limits)?;
    if gaussians.len() as u64 != manifest.gaussian_count || gaussians.sh_degree != manifest.sh_degree {
        let problem = format!(
            "the manifest says {} Gaussians of degree {}, the streams hold {} of degree {}",
            manifest.gaussian_count,
            manifest.sh_degree,
            gaussians.len(),
            gaussians.sh_degree
        );
        return Err(Error::data(object, problem, "The archive is damaged; fetch it again"));
    }
    Ok(gaussians)
}
