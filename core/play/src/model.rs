//! A trained model: canonical Gaussians, the field that moves them, and how they want to be drawn.

use crate::checkpoint;
use crate::source::{Source, SourceKind};
use crate::{Moving, RenderConfig, default_rasterizer};
use burn::tensor::Device;
use cc4dgs_core::archive::{Archive, Provenance};
use cc4dgs_core::format::near_without_units;
use cc4dgs_core::{Deformer, DeformerContext, Error, Event, EventSink, GaussianFile, HostGaussians, Limits, Registry, Result, Similarity, ply, spz};
use serde::Serialize;
use std::path::Path;

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
    /// From the coordinates of the dataset to those of the model.
    pub normalisation: Similarity,
    /// Where it came from.
    pub provenance: Provenance,
    /// Bytes per share.
    pub size: ModelSize,
}

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

/// Sizes in bytes. For archives, PLY and SPZ files these are bytes on disk, headers included in `total`; for a checkpoint and a pruned model the float32 size
/// of what playback needs.
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

impl ModelSize {
    /// Bytes of Gaussians and deformer as float32: what playback needs of a checkpoint.
    pub fn float32(gaussians: &HostGaussians, field: Option<&ModelDeformer>) -> Self {
        let (deform_grid, deform_net) = field.map_or((0, 0), |f| f.field.size_bytes());
        let extra = gaussians.extra.values().map(|a| a.values.len()).sum::<usize>();
        let floats = gaussians.columns().iter().map(|(_, _, v)| v.len()).sum::<usize>() + extra;
        let (deform, point_cloud) = (deform_grid + deform_net, 4 * floats as u64);
        Self { deform_grid, deform_net, deform, point_cloud, total: deform + point_cloud }
    }
}

impl Model {
    /// Opens the folder of a run, a checkpoint, a `.cc4d` archive, a PLY file of 3D Gaussian splatting or an SPZ file; the first bytes decide which
    /// ([`SourceKind`]). PLY and SPZ files become static models, drawn by the default rasterizer.
    ///
    /// # Errors
    /// [`Error::Parameter`] for a path that does not exist, [`Error::Data`] for files that are no model or damaged, [`Error::Unsupported`] for versions and
    /// plug-ins this program does not have, [`Error::Limit`] for claims over `limits`.
    pub fn open(path: &Path, registry: &Registry, device: &Device, limits: &Limits, events: &dyn EventSink) -> Result<Self> {
        let Source { kind, file } = Source::expect(path)?;
        let of_static = |found: GaussianFile, bytes: u64| {
            for message in &found.remarks {
                events.emit(&Event::Note { object: file.display().to_string(), message: message.clone() });
            }
            Self::from_static(found, bytes)
        };
        match kind {
            SourceKind::Checkpoint => checkpoint::read_model(&file, registry, device, limits),
            SourceKind::Archive => {
                let archive = Archive::open(&file, limits)?;
                Self::of_archive(&file.display().to_string(), &archive, registry, device, limits, events)
            }
            SourceKind::Ply => Ok(of_static(ply::read_file(&file, limits)?, file_bytes(&file)?)),
            SourceKind::Spz => {
                let content = limits.read_file(&file)?;
                Ok(of_static(spz::from_spz(&file.display().to_string(), &content, limits)?, content.len() as u64))
            }
        }
    }
    /// A static model of `gaussians` that take `bytes` in their file. The file does not say its units: cameras around a small model are near it too.
    pub(crate) fn from_static(file: GaussianFile, bytes: u64) -> Self {
        let GaussianFile { gaussians, antialiased, .. } = file;
        let usual = RenderConfig::default();
        let near = near_without_units(gaussians.shown_box(), usual.rules.near());
        Self {
            gaussians,
            field: None,
            moving: Moving::Nothing,
            render: RenderConfig { near: (near < usual.rules.near()).then_some(near), antialiased, ..usual },
            background: None,
            rasterizer: default_rasterizer(),
            frame_count: 1,
            normalisation: Similarity::IDENTITY,
            provenance: Provenance::default(),
            size: ModelSize { point_cloud: bytes, total: bytes, ..Default::default() },
        }
    }
    /// The background it is drawn on: its own, else that of the scene whose images it is compared with, else black as in 3D Gaussian splatting.
    pub fn background_on(&self, scene: Option<[f32; 3]>) -> [f32; 3] {
        self.background.or(scene).unwrap_or_default()
    }
    /// Lower and upper corner of the box around all canonical centres, world units; zeros without Gaussians.
    pub fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        let [lower, upper] = self.gaussians.central_box(1.0);
        (lower, upper)
    }
    /// Brings Gaussians of this model into the coordinates of the dataset it was trained on, as other programs expect them.
    pub fn to_dataset(&self, gaussians: &mut HostGaussians) {
        self.normalisation.inverse().apply_gaussians(gaussians);
    }
    /// Bytes of Gaussians and field as float32, whatever the model was read from.
    pub fn float32_size(&self) -> ModelSize {
        ModelSize::float32(&self.gaussians, self.field.as_ref())
    }
}

fn file_bytes(path: &Path) -> Result<u64> {
    Ok(std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len())
}

#[cfg(all(test, feature = "cpu"))]
mod tests {
    use super::*;
    use cc4dgs_core::Recorder;

    #[test]
    fn what_is_not_read_of_an_spz_file_is_told() {
        let gaussians = HostGaussians {
            means: vec![0.0; 3],
            log_scales: vec![-3.0; 3],
            quaternions: vec![1.0, 0.0, 0.0, 0.0],
            opacity_logits: vec![2.0],
            sh_dc: vec![0.1; 3],
            dynamic_scores: vec![0.0],
            ..Default::default()
        };
        let mut bytes = spz::to_spz(&gaussians, &spz::SpzOptions::version(4)).unwrap();
        // The flag of vendor extensions.
        bytes[14] |= 2;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.spz");
        std::fs::write(&path, bytes).unwrap();
        let events = Recorder::default();
        let model = Model::open(&path, &Registry::collect().unwrap(), &Device::flex(), &Limits::default(), &events).unwrap();
        assert_eq!(model.gaussians.len(), 1);
        let told = events.events();
        assert!(matches!(told.as_slice(), [Event::Note { message, .. }] if message.contains("vendor extensions")), "{told:?}");
    }
}
