//! A model as an archive holds it, opened without its deformer.

use crate::archive::{Archive, CodecEntry, Manifest, StreamKind};
use crate::playback::PlaybackLayer;
use crate::plugin::{Entries, PluginEntry, check_linked};
use crate::{
    AttributeCodec, CodecContext, CodecPlugin, Error, EventSink, HostGaussians, Limits, Moving, Result, Seed, Silent, Stream, StreamStage, WeightArray,
    WeightCodecPlugin,
};
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
    /// The motion: the layer of the archive, or one that was computed from the deformer's weights.
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
        let playback = PlaybackLayer::of_archive(object, archive, &gaussians, moving, limits)?;
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

/// Weights of a deformer are stored in streams of these names, before the names that the weight codec gave them.
pub const FIELD_STREAMS: &str = "field.";

/// The seed of the weight codec of a model with the root seed `root`.
pub fn weight_seed(root: u64) -> Seed {
    Seed::root(root).child("weight-codec")
}

/// What names and shapes of weights may take beside their values, in bytes.
const NAMES_OF_WEIGHTS: u64 = 1 << 20;

/// The weights of the deformer of `archive`, decoded by the weight codec `entry`, which must be linked; `object` names the archive in errors. Where it is known
/// how many the deformer has by its settings, no memory is allocated for more.
///
/// # Errors
/// As [`read_gaussians`].
pub fn read_weights(
    object: &str,
    archive: &Archive,
    entry: &CodecEntry,
    count: Option<u64>,
    limits: &Limits,
    events: &dyn EventSink,
) -> Result<Vec<WeightArray>> {
    let most = count.map_or(u64::MAX, |count| count.saturating_mul(4).saturating_add(NAMES_OF_WEIGHTS));
    let own = Limits { max_bytes: limits.max_bytes.min(most), ..*limits };
    let stored = archive.stream_sizes().iter().filter(|s| s.kind == StreamKind::Field).fold(0u64, |sum, s| sum.saturating_add(s.decoded_bytes));
    let checked = own.check_bytes("deformer weights", stored).and_then(|()| decode_weights(object, archive, entry, &own, events));
    checked.map_err(|error| match error {
        Error::Limit { value, .. } if value <= limits.max_bytes => {
            contradiction(object, format!("the weights of its deformer have {value} bytes, and by its settings at most {most}"))
        }
        other => other,
    })
}

fn decode_weights(object: &str, archive: &Archive, entry: &CodecEntry, limits: &Limits, events: &dyn EventSink) -> Result<Vec<WeightArray>> {
    let codec = (linked::<WeightCodecPlugin>(object, entry)?.build)(&entry.settings).map_err(|e| e.of_file(object))?;
    let own = |s: Stream| Some(Stream { name: s.name.strip_prefix(FIELD_STREAMS)?.to_string(), bytes: s.bytes });
    let streams: Vec<Stream> = archive.read_kind(StreamKind::Field)?.into_iter().filter_map(own).collect();
    codec.decode(&streams, &CodecContext::new(weight_seed(archive.manifest().provenance.seed), *limits, events)).map_err(|e| e.within(object))
}

/// The linked plug-in that `object` names, of the version that it names.
fn linked<P: PluginEntry>(object: &str, entry: &CodecEntry) -> Result<&'static P> {
    let linked = Entries::<P>::collect()?;
    check_linked(object, &P::KIND.replace('-', " "), &entry.name, Some(&entry.version), linked.facts().map(|(_, plugin)| plugin))?;
    linked.get(&entry.name)
}

/// The codec of `archive`, which must be linked, and the context of decoding with it: no memory is allocated for more Gaussians than the manifest says.
fn codec_of<'a>(object: &str, archive: &Archive, limits: &Limits, events: &'a dyn EventSink) -> Result<(Box<dyn AttributeCodec>, CodecContext<'a>)> {
    let (manifest, entry) = (archive.manifest(), &archive.manifest().codec);
    let codec = (linked::<CodecPlugin>(object, entry)?.build)(&entry.profile, &entry.settings).map_err(|e| e.of_file(object))?;
    let own = Limits { max_gaussians: limits.max_gaussians.min(manifest.gaussian_count), ..*limits };
    Ok((codec, CodecContext::new(Seed::root(manifest.provenance.seed).child("codec"), own, events)))
}

/// An error of decoding `archive`. Where the streams have more Gaussians than the manifest says, they contradict each other.
fn of_decoding(error: Error, object: &str, archive: &Archive, limits: &Limits) -> Error {
    let said = archive.manifest().gaussian_count;
    match error {
        Error::Limit { value, limit, .. } if limit == said && value > said && said < limits.max_gaussians => {
            contradiction(object, format!("the manifest says {said} Gaussians, the streams hold {value}"))
        }
        other => other.within(object),
    }
}

fn contradiction(object: &str, problem: String) -> Error {
    Error::data(object, problem, "The archive is damaged; fetch it again")
}

/// The canonical Gaussians of `archive`, decoded by its codec, which must be linked; `object` names the archive in errors.
///
/// # Errors
/// [`Error::Unsupported`] for a codec that is not linked or has another version, [`Error::Data`] for streams that are damaged or contradict the manifest,
/// [`Error::Limit`].
pub fn read_gaussians(object: &str, archive: &Archive, limits: &Limits, events: &dyn EventSink) -> Result<HostGaussians> {
    let (codec, context) = codec_of(object, archive, limits, events)?;
    let gaussians = codec.decode(&archive.read_kind(StreamKind::Canonical)?, &context).map_err(|e| of_decoding(e, object, archive, limits))?;
    checked(object, archive, limits, gaussians, true)
}

/// The stage of each canonical stream of `archive`, in file order.
///
/// # Errors
/// [`Error::Unsupported`] for a codec that is not linked or has another version.
pub fn canonical_stages(object: &str, archive: &Archive) -> Result<Vec<StreamStage>> {
    let (codec, _) = codec_of(object, archive, &Limits::default(), &Silent)?;
    Ok(archive.stream_sizes().iter().filter(|s| s.kind == StreamKind::Canonical).map(|s| codec.stage(&s.name)).collect())
}

/// The Gaussians up to `stage`: those of [`read_gaussians`], or as much of them as [`AttributeCodec::decode_stage`] gives.
///
/// # Errors
/// As [`read_gaussians`].
pub fn read_stage(object: &str, archive: &Archive, stage: StreamStage, limits: &Limits, events: &dyn EventSink) -> Result<HostGaussians> {
    if stage == StreamStage::WHOLE {
        return read_gaussians(object, archive, limits, events);
    }
    let (codec, context) = codec_of(object, archive, limits, events)?;
    let streams = archive.read_those(|info| info.kind == StreamKind::Canonical && codec.stage(&info.name) <= stage)?;
    let gaussians = codec.decode_stage(&streams, &context).map_err(|e| of_decoding(e, object, archive, limits))?;
    checked(object, archive, limits, gaussians, stage >= StreamStage::BASE)
}

/// `gaussians`, where they are what the manifest says, or the first of them.
fn checked(object: &str, archive: &Archive, limits: &Limits, gaussians: HostGaussians, all: bool) -> Result<HostGaussians> {
    gaussians.validate_read(object, limits)?;
    let (manifest, found) = (archive.manifest(), gaussians.len() as u64);
    if found > manifest.gaussian_count || all && found < manifest.gaussian_count || gaussians.sh_degree != manifest.sh_degree {
        let problem = format!(
            "the manifest says {} Gaussians of degree {}, the streams hold {found} of degree {}",
            manifest.gaussian_count, manifest.sh_degree, gaussians.sh_degree
        );
        return Err(contradiction(object, problem));
    }
    Ok(gaussians)
}
