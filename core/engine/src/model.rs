//! A trained model: canonical Gaussians, the field that moves them, and how they want to be drawn.

use crate::checkpoint;
use crate::codec_services::{ModelServices, SceneViews};
use crate::config::{RenderConfig, RunConfig};
use crate::source::{Source, SourceKind};
use crate::train::{Moving, TrainState};
use burn::tensor::{Device, Tensor, TensorData};
use cc4dgs_core::archive::{Archive, ArchiveWriter, CodecEntry, DeformerEntry, Manifest, Provenance, RasterizerEntry, StreamKind};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{
    CodecContext, DeclaredLoss, Deformer, DeformerContext, Error, Event, EventSink, HostGaussians, Limits, NeededRows, Registry, Result, Scene, Seed, Stream,
    TrainingViews, WeightArray, config, ply, split_kind, spz,
};
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// Key of the manifest's `extra` under which [`Moving`] is stored.
const MOVING: &str = "moving";
/// Key of the manifest's `extra` with the plug-in attributes: floats per Gaussian by name. Absent where there are none.
const ATTRIBUTES: &str = "attributes";

/// A model, wherever it came from.
pub struct Model {
    /// The canonical Gaussians.
    pub gaussians: HostGaussians,
    /// The deformation field, absent from static models.
    pub field: Option<ModelDeformer>,
    /// What may move.
    pub moving: Moving,
    /// How it wants to be drawn.
    pub render: RenderConfig,
    /// Colour behind everything, RGB in 0..1; `None` where the file does not say (PLY and SPZ). See [`Model::background_on`].
    pub background: Option<[f32; 3]>,
    /// The `[rasterizer]` section.
    pub rasterizer: toml::Table,
    /// Frames in the sequence.
    pub frame_count: usize,
    /// Where it came from.
    pub provenance: Provenance,
    /// Bytes per share.
    pub size: ModelSize,
}

/// How [`Model::save_archive`] stores a model.
pub struct ArchiveOptions<'a> {
    /// Codec of the Gaussians: `name` or `name:profile`.
    pub codec: &'a str,
    /// Settings of that codec.
    pub settings: &'a toml::Table,
    /// Name of the weight codec of the field.
    pub field_weights: &'a str,
    /// The scene that the model was trained on and the device that its field is on, for codecs that make use of the training views, of renders and of the
    /// field. Every codec works without.
    pub scene: Option<(&'a Scene, &'a Device)>,
}

/// Weights of a field are stored in streams of these names, before the names that the weight codec gave them.
const FIELD_STREAMS: &str = "field.";

/// A field with what is needed to build it again.
pub struct ModelDeformer {
    /// The field.
    pub field: Box<dyn Deformer>,
    /// Its `[deformer]` section.
    pub section: toml::Table,
    /// What it was built with.
    pub context: DeformerContext,
}

impl ModelDeformer {
    /// Its name in the registry.
    pub fn name(&self) -> &str {
        self.section.get("kind").and_then(|kind| kind.as_str()).unwrap_or("without a name")
    }
}

/// Sizes in bytes. For archives, PLY and SPZ files these are bytes on disk, headers included in `total`; for a checkpoint the float32 size of what playback
/// needs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ModelSize {
    /// Weights of the field: spatial encoding (the paper's Deform-Grid).
    pub deform_grid: u64,
    /// Weights of the field: everything else (the paper's Deform-Net).
    pub deform_net: u64,
    /// The field as stored.
    pub deform: u64,
    /// The Gaussians as stored.
    pub point_cloud: u64,
    /// Everything.
    pub total: u64,
}

impl Model {
    /// Opens the folder of a run, a checkpoint, a `.cc4d` archive, a PLY file of 3D Gaussian splatting or an SPZ file; the first bytes decide which
    /// ([`SourceKind`]). PLY and SPZ files become static models, drawn by the default rasterizer.
    ///
    /// # Errors
    /// [`Error::Data`] for files that are no model or damaged, [`Error::Unsupported`] for versions and plug-ins this program does not have,
    /// [`Error::Limit`] for claims over `limits`.
    pub fn open(path: &Path, registry: &Registry, device: &Device, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let Source { kind, file } = Source::expect(path)?;
        match kind {
            SourceKind::Checkpoint => Self::from_checkpoint(&file, registry, device, limits),
            SourceKind::Archive => Self::from_archive(&file, registry, device, limits, events),
            SourceKind::Ply => {
                let (gaussians, remarks) = ply::read_reporting(&file, limits)?;
                for message in remarks {
                    events.emit(&Event::Note { object: file.display().to_string(), message });
                }
                Self::from_static(gaussians, file_bytes(&file)?)
            }
            SourceKind::Spz => {
                let (object, bytes) = (file.display().to_string(), file_bytes(&file)?);
                limits.check_bytes(&object, bytes)?;
                let content = std::fs::read(&file).map_err(|e| Error::io(&file, e))?;
                Self::from_static(spz::from_spz(&object, &content, limits)?, bytes)
            }
        }
    }
    /// A static model of `gaussians` that take `bytes` in their file.
    fn from_static(gaussians: HostGaussians, bytes: u64) -> Result<Self> {
        let defaults: RunConfig = config::parse_section("configuration", &toml::Table::new())?;
        Ok(Self {
            gaussians,
            field: None,
            moving: Moving::Nothing,
            render: defaults.render,
            background: None,
            rasterizer: defaults.rasterizer,
            frame_count: 1,
            provenance: Provenance::default(),
            size: ModelSize { point_cloud: bytes, total: bytes, ..Default::default() },
        })
    }
    /// The background it is drawn on: its own, else that of the scene whose images it is compared with, else black as in 3D Gaussian splatting.
    pub fn background_on(&self, scene: Option<[f32; 3]>) -> [f32; 3] {
        self.background.or(scene).unwrap_or_default()
    }
    /// Lower and upper corner of the box around all canonical centres, world units; zeros without Gaussians.
    pub fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        let corner = |start: f32, pick: fn(f32, f32) -> f32| -> [f32; 3] {
            let axis = |k: usize| self.gaussians.means.iter().skip(k).step_by(3).copied().fold(start, pick);
            std::array::from_fn(|k| if self.gaussians.is_empty() { 0.0 } else { axis(k) })
        };
        (corner(f32::INFINITY, f32::min), corner(f32::NEG_INFINITY, f32::max))
    }
    /// Bytes of Gaussians and field as float32, whatever the model was read from.
    pub fn float32_size(&self) -> ModelSize {
        let (deform_grid, deform_net) = self.field.as_ref().map_or((0, 0), |f| f.field.size_bytes());
        let extra = self.gaussians.extra.values().map(|a| a.values.len()).sum::<usize>();
        let floats = self.gaussians.columns().iter().map(|(_, _, v)| v.len()).sum::<usize>() + extra;
        let (deform, point_cloud) = (deform_grid + deform_net, 4 * floats as u64);
        ModelSize { deform_grid, deform_net, deform, point_cloud, total: deform + point_cloud }
    }
    fn from_checkpoint(path: &Path, registry: &Registry, device: &Device, limits: &Limits) -> Result<Self> {
        let stored = checkpoint::load(path, registry, device, limits)?;
        let config = stored.config().clone();
        let (gaussians, moving, frame_count) = (stored.gaussians()?, stored.moving(), stored.frame_count());
        Self::assembled(gaussians, stored.into_deformer(), moving, frame_count, &config)
    }
    /// The model that a run ends with.
    pub fn from_training(state: TrainState, config: &RunConfig) -> Result<Self> {
        let frame_count = state.deformer.as_ref().map_or(1, |d| d.context.frame_count);
        Self::assembled(state.set.host_gaussians()?, state.deformer, state.moving, frame_count, config)
    }
    fn assembled(gaussians: HostGaussians, field: Option<ModelDeformer>, moving: Moving, frame_count: usize, config: &RunConfig) -> Result<Self> {
        let mut model = Self {
            gaussians,
            field,
            moving,
            background: Some(config.background()?),
            render: config.render.clone(),
            rasterizer: config.rasterizer.clone(),
            frame_count,
            provenance: provenance(config)?,
            size: ModelSize::default(),
        };
        model.size = model.float32_size();
        Ok(model)
    }
    fn from_archive(path: &Path, registry: &Registry, device: &Device, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let archive = Archive::open(path, limits)?;
        let object = path.display().to_string();
        let manifest = archive.manifest().clone();
        let spec = format!("{}:{}", manifest.codec.name, manifest.codec.profile);
        let codec = linked(&object, "codec", &manifest.codec.name, &manifest.codec.version, registry)?;
        check_version(&object, "codec", &manifest.codec.name, &manifest.codec.version, codec)?;
        let codec = registry.build_codec(&spec, &manifest.codec.settings)?;
        let context = CodecContext::new(codec_seed(manifest.provenance.seed), *limits, events);
        let gaussians = codec.decode(&archive.read_kind(StreamKind::Canonical)?, &context)?;
        gaussians.validate(&object, limits)?;
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
        let field = match &manifest.deformer {
            None => None,
            Some(entry) => {
                let known = linked(&object, "deformer", &entry.name, &entry.version, registry)?;
                check_version(&object, "deformer", &entry.name, &entry.version, known)?;
                let mut section = entry.settings.clone();
                section.insert("kind".into(), entry.name.clone().into());
                let mut field = registry.build_deformer(&section, &entry.context, device)?;
                let weights = read_weights(&archive, &object, &entry.weights, registry, limits, events)?;
                load_weights(&object, field.as_mut(), weights, device)?;
                Some(ModelDeformer { field, section, context: entry.context.clone() })
            }
        };
        let moving = match manifest.extra.get(MOVING) {
            Some(value) => {
                serde_json::from_value(value.clone()).map_err(|e| Error::data(&object, format!("moving: {e}"), "The archive is damaged; fetch it again"))?
            }
            None => Moving::Scored { zeta: manifest.dynamic_threshold },
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
                near: manifest.rasterizer.near,
                background: Some(manifest.background),
            },
            rasterizer,
            frame_count: manifest.frame_count,
            provenance: manifest.provenance.clone(),
            size,
        })
    }
    /// Writes a `.cc4d` archive and returns its size in bytes.
    pub fn save_archive(&self, path: &Path, options: &ArchiveOptions, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<u64> {
        let ArchiveOptions { codec: spec, settings, field_weights, scene } = *options;
        let codec = registry.build_codec(spec, settings)?;
        let (name, profile) = spec.split_once(':').unwrap_or((spec, ""));
        let views = scene.map(|(scene, _)| SceneViews::new(scene));
        let services = scene.map(|(_, device)| ModelServices::new(self, registry, device)).transpose()?;
        let context = |seed: Seed| CodecContext {
            views: views.as_ref().map(|v| v as &dyn TrainingViews),
            renderer: services.as_ref().map(|s| s as &dyn cc4dgs_core::RenderModel),
            deformer: services.as_ref().filter(|_| self.field.is_some()).map(|s| s as &dyn cc4dgs_core::EvaluateDeformer),
            ..CodecContext::new(seed, *limits, events)
        };
        let streams = codec.encode(&self.for_codec(&codec.losses()), &context(codec_seed(self.provenance.seed)))?;
        // A field that moves nothing is not stored.
        let movable = self.moving.rows(&self.gaussians.dynamic_scores).is_none_or(|rows| !rows.is_empty());
        let field = self.field.as_ref().filter(|f| movable && !f.field.is_static());
        let deformer = match field {
            None => None,
            Some(f) => {
                let (name, settings) = split_kind("deformer", &f.section)?;
                let version = registry.deformer(&name)?.info.version.to_string();
                let weight_version = registry.weight_codec(field_weights)?.info.version.to_string();
                let weights = CodecEntry { name: field_weights.into(), version: weight_version, ..Default::default() };
                Some(DeformerEntry { name, version, settings, context: f.context.clone(), weights })
            }
        };
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
            deformer,
            rasterizer: RasterizerEntry {
                name: rasterizer,
                rules: self.render.rules,
                antialiased: self.render.antialiased,
                near: self.render.near,
                settings: rasterizer_settings,
            },
            frame_count: self.frame_count,
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
        let mut writer = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, streams);
        if let Some(f) = field {
            let codec = registry.build_weight_codec(field_weights, &toml::Table::new())?;
            let streams = codec.encode(&weights_of(f.field.as_ref())?, &context(weight_seed(self.provenance.seed)))?;
            writer = writer.add_all(StreamKind::Field, streams.into_iter().map(|s| Stream { name: format!("{FIELD_STREAMS}{}", s.name), ..s }));
        }
        writer.write_to(path)
    }
    /// The Gaussians, with what a codec may lose of the field's attributes: nobody reads those of Gaussians that do not move. `losses` are the codec's.
    fn for_codec(&self, losses: &[DeclaredLoss]) -> HostGaussians {
        let mut out = self.gaussians.clone();
        let Some(field) = &self.field else { return out };
        // A score just under the threshold may come back over it.
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
        for spec in field.field.attributes() {
            if let Some(attribute) = out.extra.get_mut(&spec.name) {
                attribute.tolerance = spec.tolerance;
                attribute.needed = needed.clone().map(|rows| NeededRows { rows, start: spec.start });
            }
        }
        out
    }
}

/// Attributes are kept of Gaussians whose score is under the threshold by at most so many root-mean-square errors of the codec.
const SCORE_SLACK: f64 = 6.0;

fn deviation(values: &[f32]) -> f64 {
    let n = values.len().max(1) as f64;
    let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    (values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n).sqrt()
}

fn weight_seed(root: u64) -> Seed {
    Seed::root(root).child("weight-codec")
}

/// The field's weights, decoded by the codec that the manifest names.
fn read_weights(archive: &Archive, object: &str, entry: &CodecEntry, registry: &Registry, limits: &Limits, events: &dyn EventSink) -> Result<Vec<WeightArray>> {
    check_version(object, "weight codec", &entry.name, &entry.version, linked(object, "weight-codec", &entry.name, &entry.version, registry)?)?;
    let codec = registry.build_weight_codec(&entry.name, &entry.settings)?;
    let streams = archive.read_kind(StreamKind::Field)?;
    let streams: Vec<Stream> =
        streams.into_iter().filter_map(|s| Some(Stream { name: s.name.strip_prefix(FIELD_STREAMS)?.to_string(), bytes: s.bytes })).collect();
    codec.decode(&streams, &CodecContext::new(weight_seed(archive.manifest().provenance.seed), *limits, events))
}

/// Floats per Gaussian of all plug-in attributes that the archive of `manifest` holds.
pub fn attribute_width(manifest: &Manifest) -> u64 {
    let widths = manifest.extra.get(ATTRIBUTES).and_then(Value::as_object);
    widths.map_or(0, |all| all.values().filter_map(Value::as_u64).fold(0, u64::saturating_add))
}

fn json(value: &impl Serialize) -> Result<Value> {
    serde_json::to_value(value).map_err(|e| Error::backend("archive manifest", e.to_string(), "Report this"))
}

fn file_bytes(path: &Path) -> Result<u64> {
    Ok(std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len())
}

/// The version of the linked plug-in that `object` names, or an error that says what to link.
fn linked(object: &str, kind: &str, name: &str, version: &str, registry: &Registry) -> Result<&'static str> {
    let plugins = registry.plugins();
    let known: Vec<_> = plugins.into_iter().filter(|(k, _)| *k == kind).map(|(_, p)| p).collect();
    known.iter().find(|p| p.name == name).map(|p| p.version).ok_or_else(|| {
        let names: Vec<&str> = known.iter().map(|p| p.name).collect();
        let remedy = format!("Use a program that links the crate of this {kind}; this one links {}", names.join(", "));
        Error::unsupported(object, format!("it needs the {kind} '{name}' (version {version}), which is not linked into this program"), remedy)
    })
}

fn codec_seed(root: u64) -> Seed {
    Seed::root(root).child("codec")
}

fn check_version(object: &str, kind: &str, name: &str, stored: &str, known: &str) -> Result<()> {
    if stored == known {
        return Ok(());
    }
    Err(Error::unsupported(format!("{object}: {kind} {name}"), format!("version {stored} of its stored form"), format!("This program reads version {known}")))
}

fn weights_of(field: &dyn Deformer) -> Result<Vec<WeightArray>> {
    field
        .parameters()
        .into_iter()
        .map(|p| Ok(WeightArray { name: p.name.clone(), shape: p.shape.clone(), values: to_vec(p.value.clone(), &p.name)? }))
        .collect()
}

fn load_weights(object: &str, field: &mut dyn Deformer, weights: Vec<WeightArray>, device: &Device) -> Result<()> {
    let wanted: Vec<(String, Vec<usize>)> = field.parameters().iter().map(|p| (p.name.clone(), p.shape.clone())).collect();
    let found: Vec<(String, Vec<usize>)> = weights.iter().map(|w| (w.name.clone(), w.shape.clone())).collect();
    if wanted != found {
        let odd = wanted
            .iter()
            .zip(&found)
            .find(|(a, b)| a != b)
            .map_or_else(|| format!("{} arrays, {} expected", found.len(), wanted.len()), |(a, b)| format!("found {b:?}, expected {a:?}"));
        return Err(Error::data(object, format!("field weights do not fit the field: {odd}"), "The archive is damaged or of another version of the deformer"));
    }
    for (parameter, array) in field.parameters_mut().into_iter().zip(weights) {
        let len = array.values.len();
        parameter.value = Tensor::from_data(TensorData::new(array.values, [len]), device);
    }
    Ok(())
}

fn provenance(config: &RunConfig) -> Result<Provenance> {
    let table = config.to_toml()?.parse().unwrap_or_default();
    Ok(Provenance { commit: env!("CC4DGS_COMMIT").into(), seed: config.seed, device: config.device.clone(), config: table })
}
