//! A model as a `.cc4d` archive.

use crate::codec_services::{ModelServices, SceneViews};
use crate::encoded_once::EncodedOnce;
use crate::field_weights::{FieldWeights, StoredField};
use crate::layer_deformer::{PLAYBACK_LAYER, of_layer};
use crate::model::{Model, ModelDeformer, ModelSize};
use crate::{Moving, OrbitViews, RenderConfig};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::{Archive, ArchiveWriter, CodecEntry, Manifest, PackedStreams, StreamKind};
use cc4dgs_core::format::check_linked;
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::playback::PlaybackLayer;
use cc4dgs_core::{
    AttributeCodec, CodecContext, Deformer, EncodedWeights, Error, EventSink, HostGaussians, Limits, MOVING, NeededRows, Registry, Result, Scene, Seed, Stream,
    StreamStage, TrainingViews, TuneModel, WeightArray, read_gaussians, read_weights, split_kind, weight_seed,
};
use serde::Serialize;
use serde_json::Value;
use std::borrow::Cow;
use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Key of the manifest's `extra` with the plug-in attributes: floats per Gaussian by name. Absent where there are none.
const ATTRIBUTES: &str = "attributes";

/// Where codecs measure a model.
#[derive(Clone, Copy)]
pub enum ViewSource<'a> {
    /// In the training views of the scene that the model was trained on. Its validation views judge what is lost, where it has some.
    Scene(&'a Scene),
    /// In views round the model, which have no images: for models whose scene is not there.
    Orbit(&'a OrbitViews),
}

/// How [`Model::save_archive`] stores a model.
pub struct ArchiveOptions<'a> {
    /// Codec of the Gaussians: `name` or `name:profile`.
    pub codec: &'a str,
    /// Settings of that codec.
    pub settings: &'a toml::Table,
    /// Weight codec of the field: see [`FieldWeights::parse`].
    pub field_weights: &'a str,
    /// Where codecs measure the model, and the device that its field is on: for codecs that make use of views, of renders and of the field. Every codec works
    /// without.
    pub views: Option<(ViewSource<'a>, &'a Device)>,
    /// Trains the model further with rounded values, for codecs that make use of it. The archive's deformer then has the trained weights. It is not used beside
    /// an orbit, which has no images to train on.
    pub tuner: Option<&'a dyn TuneModel>,
}

impl ArchiveOptions<'_> {
    /// Refuses codecs and settings that do not exist, and where there is no scene, those that need one; an orbit is none. Call it before anything is read;
    /// [`Model::to_archive`] refuses the same, but for `field_weights` where the model has no deformer.
    ///
    /// # Errors
    /// [`Error::Parameter`] that names the codec or setting and the remedy.
    pub fn check(codec: &str, settings: &toml::Table, field_weights: &str, has_scene: bool, registry: &Registry) -> Result<()> {
        let (codec, weights) = (registry.build_codec(codec, settings)?, FieldWeights::parse(field_weights, registry)?);
        if has_scene { Ok(()) } else { codec.check_without_scene().and_then(|()| weights.check_without_scene()) }
    }
}

impl Model {
    /// The model of an open archive; `object` names it in errors. Where the weights of its deformer were left out, its playback layer moves the Gaussians.
    ///
    /// # Errors
    /// As [`Model::open`].
    pub fn of_archive(object: &str, archive: &Archive, registry: &Registry, device: &Device, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let manifest = archive.manifest().clone();
        let mut gaussians = read_gaussians(object, archive, limits, events)?;
        let moving = Moving::of_manifest(object, &manifest)?;
        let has = |kind| archive.stream_sizes().iter().any(|s| s.kind == kind);
        let field = match &manifest.deformer {
            None => None,
            // The deformer was left out of an archive that plays.
            Some(entry) if !has(StreamKind::Field) && has(StreamKind::Playback) => {
                let layer = PlaybackLayer::decode(&archive.read_kind(StreamKind::Playback)?, gaussians.len(), gaussians.sh_degree, limits)?;
                let rows = moving.rows(&gaussians.dynamic_scores).unwrap_or_else(|| (0..gaussians.len()).collect());
                Some(of_layer(object, layer, &mut gaussians, &rows, &entry.context, device)?)
            }
            Some(entry) if !has(StreamKind::Field) => {
                let problem = format!("it has neither the weights of its deformer '{}' nor a playback layer, so its motion is lost", entry.name);
                return Err(Error::data(object, problem, "Fetch it again, or compress the run that it was made of"));
            }
            Some(entry) => {
                linked(object, "deformer", &entry.name, Some(&entry.version), registry)?;
                let mut section = entry.settings.clone();
                section.insert("kind".into(), entry.name.clone().into());
                let mut field = registry.build_deformer(&section, &entry.context, device).map_err(|e| e.of_file(object))?;
                let count = field.parameters().iter().map(|p| p.shape.iter().product::<usize>() as u64).sum();
                let weights = read_weights(object, archive, &entry.weights, Some(count), limits, events)?;
                load_weights(object, field.as_mut(), weights, device)?;
                Some(ModelDeformer { field, section, context: entry.context.clone() })
            }
        };
        let mut rasterizer = manifest.rasterizer.settings.clone();
        rasterizer.insert("kind".into(), manifest.rasterizer.name.clone().into());
        let of_kind = |kind| archive.stream_sizes().iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum::<u64>();
        let (deform_grid, deform_net) = field.as_ref().map_or((0, 0), |f| f.field.size_bytes());
        let size = ModelSize {
            deform_grid,
            deform_net,
            deform: of_kind(StreamKind::Field),
            point_cloud: of_kind(StreamKind::Canonical),
            total: archive.total_bytes()?,
        };
        Ok(Self {
            gaussians,
            field,
            moving,
            background: Some(manifest.background),
            render: RenderConfig {
                rules: manifest.rasterizer.rules,
                antialiased: manifest.rasterizer.antialiased,
                blur: manifest.rasterizer.blur,
                focal: manifest.rasterizer.focal,
                near: manifest.rasterizer.near,
                background: Some(manifest.background),
            },
            rasterizer,
            frame_count: manifest.frame_count,
            normalisation: manifest.normalisation,
            provenance: manifest.provenance.clone(),
            size,
        })
    }
    /// Writes a `.cc4d` archive and returns its size in bytes.
    ///
    /// # Errors
    /// As [`Model::to_archive`], and [`Error::Io`].
    pub fn save_archive(&self, path: &Path, options: &ArchiveOptions, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<u64> {
        self.archive_writer(options, registry, limits, events)?.write_to(path)
    }
    /// The bytes of the model's `.cc4d` archive.
    ///
    /// # Errors
    /// What codecs and the deformer report, unknown names, and [`Error::Limit`] for Gaussians that no reader with these limits accepts.
    pub fn to_archive(&self, options: &ArchiveOptions, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<Vec<u8>> {
        self.archive_writer(options, registry, limits, events)?.to_bytes()
    }
    fn archive_writer(&self, options: &ArchiveOptions, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<ArchiveWriter> {
        let ArchiveOptions { codec: spec, settings, field_weights, views: source, tuner } = *options;
        self.check_size(limits)?;
        self.check_storable()?;
        let device = source.map(|(_, device)| device);
        let (scene, orbit) = match source.map(|(views, _)| views) {
            Some(ViewSource::Scene(scene)) => (Some(scene), None),
            Some(ViewSource::Orbit(orbit)) => (None, Some(orbit)),
            None => (None, None),
        };
        let tuner = tuner.filter(|_| orbit.is_none()).map(EncodedOnce::new);
        let tuner = tuner.as_ref().map(|tuner| tuner as &dyn TuneModel);
        let codec = registry.build_codec(spec, settings)?;
        let (name, profile) = spec.split_once(':').unwrap_or((spec, ""));
        let (training, judges) = (scene.map(SceneViews::new), scene.map(SceneViews::judging));
        let views = training.as_ref().map(|v| v as &dyn TrainingViews).or(orbit.map(|v| v as &dyn TrainingViews));
        let services = device.map(|device| ModelServices::new(self, registry, device)).transpose()?;
        let context = |seed: Seed| CodecContext {
            views,
            judges: judges.as_ref().map(|v| v as &dyn TrainingViews),
            renderer: services.as_ref().map(|s| s as &dyn cc4dgs_core::RenderModel),
            deformer: services.as_ref().filter(|_| self.field.is_some()).map(|s| s as &dyn cc4dgs_core::EvaluateDeformer),
            tuner,
            dynamic_threshold: Some(match self.moving {
                _ if self.field.as_ref().is_none_or(|f| f.field.is_static()) => f32::INFINITY,
                Moving::Everything => f32::NEG_INFINITY,
                Moving::Nothing => f32::INFINITY,
                Moving::Scored { zeta } => zeta,
            }),
            ..CodecContext::new(seed, *limits, events)
        };
        let (movable, field) = (self.movable(), self.stored_field());
        let weights = field.map(|f| StoredField::new(f, field_weights, registry)).transpose()?;
        if scene.is_none() {
            codec.check_without_scene()?;
            weights.as_ref().map_or(Ok(()), |of| of.chosen.check_without_scene())?;
        }
        let (rasterizer, rasterizer_settings) = split_kind("rasterizer", &self.rasterizer)?;
        let moving = if movable { self.moving } else { Moving::Nothing };
        let mut extra = serde_json::Map::from_iter([(MOVING.to_string(), json(&moving)?)]);
        if !self.gaussians.extra.is_empty() {
            let widths: BTreeMap<&str, usize> = self.gaussians.extra.iter().map(|(name, a)| (name.as_str(), a.width)).collect();
            extra.insert(ATTRIBUTES.into(), json(&widths)?);
        }
        let (lower, upper) = self.bounds();
        let manifest = Manifest {
            codec: CodecEntry { name: name.into(), profile: profile.into(), version: registry.codec(name)?.info.version.into(), settings: settings.clone() },
            rasterizer: self.render.entry(rasterizer, rasterizer_settings),
            frame_count: self.frame_count,
            normalisation: self.normalisation,
            time_range: [0.0, 1.0],
            box_world: [lower, upper],
            background: self.background_on(None),
            sh_degree: self.gaussians.sh_degree,
            dynamic_threshold: if let Moving::Scored { zeta } = moving { zeta } else { 0.0 },
            gaussian_count: self.gaussians.len() as u64,
            provenance: self.provenance.clone(),
            extra,
            ..Default::default()
        };
        // Where a size is bounded, the codec measures many files with the same weights, and the last of them is often the one that is written.
        let packed = codec.most_bytes().map(|_| Arc::new(PackedStreams::default()));
        let writer = |found: &Option<EncodedWeights>| {
            let deformer = weights.as_ref().zip(found.as_ref()).map(|(w, (_, settings))| w.entry(settings.clone()));
            let writer = ArchiveWriter::new(Manifest { deformer, ..manifest.clone() });
            match &packed {
                Some(packed) => writer.reusing(packed),
                None => writer,
            }
        };
        // Streams in the order in which a player needs them.
        let assembled = |mut streams: Vec<Stream>, found: &Option<EncodedWeights>| {
            streams.sort_by_key(|s| codec.stage(&s.name));
            let harmonics = streams.split_off(streams.partition_point(|s| codec.stage(&s.name) <= StreamStage::BASE));
            let field_streams = found.iter().flat_map(|(streams, _)| streams.iter().map(StoredField::stream));
            let first = writer(found).add_all(StreamKind::Canonical, streams).add_all(StreamKind::Field, field_streams.collect::<Vec<_>>());
            first.add_all(StreamKind::Canonical, harmonics)
        };
        let seed = weight_seed(self.provenance.seed);
        let untuned = OnceCell::new();
        let encode_weights = || -> Result<Option<EncodedWeights>> {
            let Some((stored, f)) = weights.as_ref().zip(field) else { return Ok(None) };
            let of_field = weights_of(f.field.as_ref())?;
            // What a tuner has measured and searched is not measured again.
            if let Some(tuner) = tuner.filter(|_| views.is_some_and(|v| !v.is_empty())) {
                return tuner.encoded_weights(&of_field, 1.0).map(Some);
            }
            let measured = device.zip(views);
            let importance = measured.map(|(device, views)| stored.chosen.importance(self, views, registry, device, events)).transpose()?.flatten();
            let context = CodecContext { weight_importance: importance.as_deref(), ..context(seed) };
            stored.chosen.encode(self, &of_field, device, &context, registry).map(Some)
        };
        // A codec whose size is bounded asks for this.
        let file_bytes = |streams: &[Stream], tuned: Option<(&[WeightArray], f64)>| -> Result<u64> {
            let found = match tuned.zip(tuner) {
                Some(((tuned, steps), tuner)) => weights.as_ref().map(|_| tuner.encoded_weights(tuned, steps)).transpose()?,
                None => {
                    if untuned.get().is_none() {
                        let _ = untuned.set(encode_weights()?);
                    }
                    untuned.get().cloned().flatten()
                }
            };
            Ok(assembled(streams.to_vec(), &found).to_bytes()?.len() as u64)
        };
        let gaussians = self.for_codec(codec.as_ref());
        let streams = codec.encode(&gaussians, &CodecContext { file_bytes: Some(&file_bytes), ..context(codec_seed(self.provenance.seed)) })?;
        let found = match tuner.filter(|_| weights.is_some()).map(TuneModel::adopted).transpose()?.flatten() {
            Some(tuned) => Some(tuned),
            None => untuned.into_inner().map_or_else(encode_weights, Ok)?,
        };
        Ok(assembled(streams, &found))
    }
    /// Refuses a model that a playback layer alone moves, which cannot be stored again. Call it before long work.
    ///
    /// # Errors
    /// [`Error::Unsupported`].
    pub fn check_storable(&self) -> Result<()> {
        if self.stored_field().is_none_or(|f| f.name() != PLAYBACK_LAYER) {
            return Ok(());
        }
        let problem = "its deformer was left out, and a playback layer belongs to the stored Gaussians of its archive";
        Err(Error::unsupported("the model", problem, "Take the run, or an archive that was baked without --without-field"))
    }
    /// Whether a deformer may move some of the Gaussians.
    fn movable(&self) -> bool {
        self.moving.rows(&self.gaussians.dynamic_scores).is_none_or(|rows| !rows.is_empty())
    }
    /// The deformer that archives store: none that moves nothing.
    fn stored_field(&self) -> Option<&ModelDeformer> {
        self.field.as_ref().filter(|f| self.movable() && !f.field.is_static())
    }
    /// Refuses Gaussians that no reader with these limits accepts, before they are encoded.
    fn check_size(&self, limits: &Limits) -> Result<()> {
        let (bytes, limit) = (self.float32_size().point_cloud, limits.max_bytes);
        if bytes <= limit {
            return Ok(());
        }
        let object = format!("decoded bytes of {} Gaussians", self.gaussians.len());
        let remedy = "Remove Gaussians with `cc4dgs prune`, or raise limits.max_bytes (--limit max_bytes=…), which readers of the file need, too";
        Err(Error::limit(object, bytes, limit, remedy))
    }
    /// The Gaussians, with what a codec may lose of the field's attributes: nobody reads those of Gaussians that do not move. A copy only where there are any.
    fn for_codec(&self, codec: &dyn AttributeCodec) -> Cow<'_, HostGaussians> {
        let attributes = self.field.as_ref().map(|f| f.field.attributes()).unwrap_or_default();
        if attributes.iter().all(|spec| !self.gaussians.extra.contains_key(&spec.name)) {
            return Cow::Borrowed(&self.gaussians);
        }
        let mut out = self.gaussians.clone();
        // A score just under the threshold may come back over it.
        let losses = if codec.keeps_motion() { Vec::new() } else { codec.losses() };
        let slack = losses.iter().find(|l| l.attribute == "dynamic_scores").map_or(0.0, |l| SCORE_SLACK * l.relative_rms * deviation(&out.dynamic_scores));
        let moving = match self.moving {
            Moving::Scored { zeta } => Moving::Scored { zeta: zeta - slack as f32 },
            other => other,
        };
        let needed = moving.rows(&out.dynamic_scores).map(|rows| {
            let mut needed = vec![false; out.len()];
            rows.into_iter().for_each(|row| needed[row] = true);
            needed
        });
        for spec in attributes {
            if let Some(attribute) = out.extra.get_mut(&spec.name) {
                attribute.tolerance = spec.tolerance;
                attribute.needed = needed.clone().map(|rows| NeededRows { rows, start: spec.start });
            }
        }
        Cow::Owned(out)
    }
}

/// Attributes are kept of Gaussians whose score is under the threshold by at most so many root-mean-square errors of the codec.
const SCORE_SLACK: f64 = 6.0;

fn deviation(values: &[f32]) -> f64 {
    let n = values.len().max(1) as f64;
    let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    (values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n).sqrt()
}

/// Floats per Gaussian of all plug-in attributes that the archive of `manifest` holds.
pub fn attribute_width(manifest: &Manifest) -> u64 {
    let widths = manifest.extra.get(ATTRIBUTES).and_then(Value::as_object);
    widths.map_or(0, |all| all.values().filter_map(Value::as_u64).fold(0, u64::saturating_add))
}

/// `value` by way of text, so that a float32 has its own few digits and not those of the float64 beside it.
fn json(value: &impl Serialize) -> Result<Value> {
    serde_json::to_string(value).and_then(|text| serde_json::from_str(&text)).map_err(|e| Error::backend("archive manifest", e.to_string(), "Report this"))
}

/// Refuses a plug-in that the file `object` names, where it is not linked, or reads another version than the stored one, if the file has it.
pub(crate) fn linked(object: &str, kind: &str, name: &str, version: Option<&str>, registry: &Registry) -> Result<()> {
    let known = registry.plugins().into_iter().filter(|(of, _)| *of == kind).map(|(_, plugin)| plugin);
    check_linked(object, kind, name, version, known)
}

fn codec_seed(root: u64) -> Seed {
    Seed::root(root).child("codec")
}

/// The weights of `field`.
///
/// # Errors
/// [`Error::Backend`] if a tensor cannot be read.
pub fn weights_of(field: &dyn Deformer) -> Result<Vec<WeightArray>> {
    field
        .parameters()
        .into_iter()
        .map(|p| Ok(WeightArray { name: p.name.clone(), shape: p.shape.clone(), values: to_vec(p.value.clone(), &p.name)? }))
        .collect()
}

/// Replaces the weights of `field`, which must have arrays of the same names and shapes. `object` names them in errors.
///
/// # Errors
/// [`Error::Data`] if they do not.
pub fn load_weights(object: &str, field: &mut dyn Deformer, weights: Vec<WeightArray>, device: &Device) -> Result<()> {
    let wanted: Vec<(String, Vec<usize>)> = field.parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect();
    let found: Vec<(String, Vec<usize>)> = weights.iter().map(|w| (w.name.clone(), w.shape.clone())).collect();
    if wanted != found {
        let odd = wanted
            .iter()
            .zip(&found)
            .find(|(a, b)| a != b)
            .map_or_else(|| format!("{} arrays, {} expected", found.len(), wanted.len()), |(a, b)| format!("found {b:?}, expected {a:?}"));
        return Err(Error::data(
            object,
            format!("the stored weights do not fit the deformer: {odd}"),
            "The archive is damaged or of another version of the deformer",
        ));
    }
    for (parameter, array) in field.parameters_mut().into_iter().zip(weights) {
        let len = array.values.len();
        parameter.value = Tensor::from_data(TensorData::new(array.values, [len]), device);
    }
    Ok(())
}
