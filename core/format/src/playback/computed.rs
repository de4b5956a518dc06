//! Layers that are computed from the weights of a deformer when a model is opened, so that a file needs no layer of its own.

use super::layer::{MAX_SAMPLES, PlaybackLayer, Segment, Track};
use crate::archive::{Archive, Manifest, StreamKind};
use crate::plugin::{Entries, Plugin};
use crate::{DeformerContext, Error, HostGaussians, Limits, Moving, Result, Silent, WeightArray, read_weights};

/// Samples of time per frame, and the fewest of a sequence: functions bend between frames, and are shared by all Gaussians.
const SAMPLES_PER_FRAME: usize = 8;
const LEAST_SAMPLES: usize = 257;
/// Coefficients of a layer at most: players hold them in one buffer of the GPU.
const MOST_COEFFICIENTS: usize = 32 << 20;

/// What a [`MotionPlugin`] makes tracks of.
pub struct MotionSource<'a> {
    /// Names the model in errors.
    pub object: &'a str,
    /// The deformer's settings, without `kind`.
    pub settings: &'a toml::Table,
    /// What the deformer knows of its scene.
    pub context: &'a DeformerContext,
    /// Its weights.
    pub weights: &'a [WeightArray],
    /// The canonical Gaussians that move, M.
    pub gaussians: &'a HostGaussians,
    /// Samples of time at least.
    pub least_samples: usize,
    /// Coefficients at most.
    pub most_coefficients: usize,
}

impl MotionSource<'_> {
    /// The values of the weights `name`, of which there must be `count`.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn weights(&self, name: &str, count: usize) -> Result<&[f32]> {
        let object = format!("weights {name} of {}", self.object);
        let found = self.weights.iter().find(|array| array.name == name).map(|array| array.values.as_slice());
        let found = found.ok_or_else(|| Error::data(&object, "the file has none", "The archive is damaged; fetch it again"))?;
        if found.len() == count {
            Ok(found)
        } else {
            Err(Error::data(object, format!("{} values instead of {count}", found.len()), "The archive is damaged; fetch it again"))
        }
    }
}

/// A deformer whose offsets are linear in functions of time that all Gaussians share, evaluated without burn. Its name and version are those of the deformer.
pub struct MotionPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// How many weights a deformer with these settings, without `kind`, has; `None` where [`MotionPlugin::motion`] gives none for them, or there are too many.
    pub weights: fn(&toml::Table, &DeformerContext) -> Option<u64>,
    /// The motion; `None` where it is not linear with these settings, some of them belong to something else, such as a layer around the deformer, or a player
    /// would need too many coefficients, samples, memory or multiplications. Such models are baked.
    pub motion: fn(&MotionSource) -> Result<Option<ComputedMotion>>,
}
crate::plugin_kind!(MotionPlugin, "motion");

/// What a [`MotionPlugin`] computes: one segment.
#[derive(Clone, Debug)]
pub struct ComputedMotion {
    /// Samples of time S, at most [`MAX_SAMPLES`](super::MAX_SAMPLES): sample k is at normalised time k / (S - 1).
    pub samples: usize,
    /// The heads that change.
    pub tracks: Vec<Track>,
}

/// The linked plug-in for the deformer of an archive.
fn plugin_of(manifest: &Manifest) -> Result<Option<&'static MotionPlugin>> {
    let Some(deformer) = &manifest.deformer else { return Ok(None) };
    Ok(Entries::<MotionPlugin>::collect()?.iter().find(|p| p.info.name == deformer.name && p.info.version == deformer.version))
}

impl PlaybackLayer {
    /// Whether the motion of an archive may be computed from its deformer's weights: it has no layer, and a [`MotionPlugin`] for its deformer is linked.
    ///
    /// # Errors
    /// As [`Entries::collect`].
    pub fn may_be_computed(archive: &Archive) -> Result<bool> {
        let stored = archive.stream_sizes().iter().any(|s| s.kind == StreamKind::Playback);
        Ok(!stored && plugin_of(archive.manifest())?.is_some())
    }
    /// The motion of an archive: its layer, or [`PlaybackLayer::computed`].
    ///
    /// # Errors
    /// As [`PlaybackLayer::decode`] and [`PlaybackLayer::computed`].
    pub fn of_archive(object: &str, archive: &Archive, gaussians: &HostGaussians, moving: Moving, limits: &Limits) -> Result<Option<Self>> {
        let streams = archive.read_kind(StreamKind::Playback)?;
        if streams.is_empty() {
            return Self::computed(object, archive, gaussians, moving, limits);
        }
        Self::decode(&streams, gaussians.len(), gaussians.sh_degree, limits).map(Some).map_err(|e| e.within(object))
    }
    /// The motion of an archive without a layer, from its deformer's weights; `None` where nothing moves, or no [`MotionPlugin`] for this deformer is linked.
    ///
    /// # Errors
    /// [`Error::Data`] for weights that are damaged, and what their codec reports.
    pub fn computed(object: &str, archive: &Archive, gaussians: &HostGaussians, moving: Moving, limits: &Limits) -> Result<Option<Self>> {
        let manifest = archive.manifest();
        let (Some(deformer), Some(plugin)) = (&manifest.deformer, plugin_of(manifest)?) else { return Ok(None) };
        let rows = moving.rows(&gaussians.dynamic_scores).unwrap_or_else(|| (0..gaussians.len()).collect());
        if rows.is_empty() {
            return Ok(None);
        }
        if deformer.context.sh_degree != gaussians.sh_degree {
            let problem = format!("its deformer is of degree {}, its Gaussians of degree {}", deformer.context.sh_degree, gaussians.sh_degree);
            return Err(Error::data(object, problem, "The archive is damaged; fetch it again"));
        }
        // What settings say is known before any weight is decoded.
        let Some(count) = (plugin.weights)(&deformer.settings, &deformer.context) else { return Ok(None) };
        let weights = read_weights(object, archive, &deformer.weights, Some(count), limits, &Silent)?;
        let least_samples = manifest.frame_count.saturating_sub(1).saturating_mul(SAMPLES_PER_FRAME).saturating_add(1).clamp(LEAST_SAMPLES, MAX_SAMPLES);
        let moved = gaussians.select(&rows);
        let source = MotionSource {
            object,
            settings: &deformer.settings,
            context: &deformer.context,
            weights: &weights,
            gaussians: &moved,
            least_samples,
            most_coefficients: MOST_COEFFICIENTS,
        };
        let Some(ComputedMotion { samples, mut tracks }) = (plugin.motion)(&source)? else { return Ok(None) };
        if let Some((head, value)) = tracks.iter().find_map(|track| Some((track.head.name(), track.impossible()?))) {
            let problem = format!("a coefficient or function of {head} is {value}");
            return Err(Error::data(object, problem, "The archive is damaged; fetch it again"));
        }
        tracks.sort_by_key(|track| track.head);
        let rows = rows.iter().map(|&row| row as u32).collect();
        Ok(Some(Self { rows, samples, sh_degree: gaussians.sh_degree, segments: vec![Segment { first: 0, last: samples - 1, tracks }] }))
    }
}
