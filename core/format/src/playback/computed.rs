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

/// What a [`LayerPlugin`] makes tracks of.
pub struct LayerSource<'a> {
    /// The deformer's settings, without `kind`.
    pub settings: &'a toml::Table,
    /// What the deformer knows of its scene.
    pub context: &'a DeformerContext,
    /// Its weights.
    pub weights: &'a [WeightArray],
    /// The canonical Gaussians that move, M.
    pub gaussians: &'a HostGaussians,
    /// Samples of time S: sample k is at normalised time k / (S - 1).
    pub samples: usize,
    /// Coefficients at most.
    pub most_coefficients: usize,
}

impl LayerSource<'_> {
    /// The values of the weights `name`, of which there must be `count`.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn weights(&self, name: &str, count: usize) -> Result<&[f32]> {
        let object = format!("weights {name}");
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
pub struct LayerPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// The tracks of the layer, over one segment of all samples; `None` where these settings are not linear, or there would be too many coefficients.
    pub tracks: fn(&LayerSource) -> Result<Option<Vec<Track>>>,
}
crate::plugin_kind!(LayerPlugin, "layer");

/// The linked plug-in for the deformer of an archive.
fn plugin_of(manifest: &Manifest) -> Result<Option<&'static LayerPlugin>> {
    let Some(deformer) = &manifest.deformer else { return Ok(None) };
    Ok(Entries::<LayerPlugin>::collect()?.iter().find(|p| p.info.name == deformer.name && p.info.version == deformer.version))
}

impl PlaybackLayer {
    /// Whether the motion of an archive may be computed from its deformer's weights: it has no layer, and a [`LayerPlugin`] for its deformer is linked.
    ///
    /// # Errors
    /// As [`Entries::collect`].
    pub fn may_be_computed(archive: &Archive) -> Result<bool> {
        let stored = archive.stream_sizes().iter().any(|s| s.kind == StreamKind::Playback);
        Ok(!stored && plugin_of(archive.manifest())?.is_some())
    }
    /// The motion of an archive without a layer, from its deformer's weights; `None` where nothing moves, or no [`LayerPlugin`] for this deformer is linked.
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
        let weights = read_weights(object, archive, &deformer.weights, limits, &Silent)?;
        let samples = manifest.frame_count.saturating_sub(1).saturating_mul(SAMPLES_PER_FRAME).saturating_add(1).clamp(LEAST_SAMPLES, MAX_SAMPLES);
        let moved = gaussians.select(&rows);
        let source = LayerSource {
            settings: &deformer.settings,
            context: &deformer.context,
            weights: &weights,
            gaussians: &moved,
            samples,
            most_coefficients: MOST_COEFFICIENTS,
        };
        let Some(tracks) = (plugin.tracks)(&source)? else { return Ok(None) };
        let numbers = || tracks.iter().flat_map(|t| t.functions.iter().chain(&t.coefficients));
        if numbers().any(|v| !v.is_finite()) {
            return Err(Error::data(object, "its deformer gives offsets that are not finite", "The archive is damaged; fetch it again"));
        }
        let rows = rows.iter().map(|&row| row as u32).collect();
        Ok(Some(Self { rows, samples, sh_degree: gaussians.sh_degree, segments: vec![Segment { first: 0, last: samples - 1, tracks }] }))
    }
}
