//! An archive that arrives in pieces.

use super::error;
use crate::{Content, memory};
use cc4dgs_format::archive::{Archive, StreamKind};
use cc4dgs_format::playback::PlaybackLayer;
use cc4dgs_format::{Error, HostGaussians, Limits, Moving, Result, Silent, StoredModel, StreamStage, canonical_stages, read_stage};
use wasm_bindgen::prelude::*;

/// Bytes of an archive, some of which are still missing. The page fetches ranges, in the order that [`Download::streams`] suggests.
#[wasm_bindgen]
pub struct Download {
    name: String,
    bytes: Vec<u8>,
    archive: Option<Archive>,
    /// The Gaussians without their motion, and the stage up to which they are there: kept until the motion has arrived.
    model: Option<(StoredModel, StreamStage)>,
}

#[wasm_bindgen]
impl Download {
    /// An archive of `total` bytes of which nothing has arrived; `name` names it in errors.
    #[wasm_bindgen(constructor)]
    pub fn new(name: String, total: f64) -> std::result::Result<Download, JsError> {
        let most = super::LIMITS.max_bytes as f64;
        if !(0.0..=most).contains(&total) {
            return Err(error(Error::limit(name, total.max(0.0) as u64, most as u64, "Open it on the desktop")));
        }
        // An archive that is opened has a copy of the bytes.
        memory::check(&name, 2 * total as u64).map_err(error)?;
        let mut bytes = Vec::new();
        bytes.try_reserve_exact(total as usize).map_err(error)?;
        bytes.resize(total as usize, 0);
        Ok(Self { name, bytes, archive: None, model: None })
    }
    /// Stores bytes that arrived; what lies outside the file is ignored.
    pub fn put(&mut self, offset: usize, piece: &[u8]) {
        let end = offset.saturating_add(piece.len()).min(self.bytes.len());
        if offset < end {
            self.bytes[offset..end].copy_from_slice(&piece[..end - offset]);
            self.archive = None;
        }
    }
    /// Bytes to the end of the header, once the first 24 have arrived.
    #[wasm_bindgen(js_name = headerEnd)]
    pub fn header_end(&self) -> std::result::Result<f64, JsError> {
        let prefix = &self.bytes[..self.bytes.len().min(Archive::PREFIX_BYTES)];
        Ok(Archive::header_end(&self.name, prefix, &super::LIMITS).map_err(error)? as f64)
    }
    /// The streams as JSON: name, kind, stage (layer of Gaussians, degree of harmonics), first byte and bytes of each. The header must have arrived. Models
    /// that take too much memory are refused.
    pub fn streams(&mut self) -> std::result::Result<String, JsError> {
        crate::link();
        let name = self.name.clone();
        let archive = self.opened().map_err(error)?;
        memory::check_archive(&name, archive).map_err(error)?;
        let computed = PlaybackLayer::may_be_computed(archive).map_err(error)?;
        let streams = archive.stream_sizes();
        let mut stages = canonical_stages(&name, archive).map_err(error)?.into_iter();
        let mut kind = |kind| match kind {
            StreamKind::Canonical => match stages.next().unwrap_or(StreamStage::WHOLE) {
                StreamStage::Layer(layer) => ("canonical", layer),
                StreamStage::Harmonics(degree) => ("harmonics", degree),
            },
            StreamKind::Playback => ("playback", 0),
            // The page needs the weights where it computes the motion from them.
            StreamKind::Field if computed => ("playback", 0),
            StreamKind::Poster => ("poster", 0),
            _ => ("other", 0),
        };
        let mut list = Vec::with_capacity(streams.len());
        for stream in &streams {
            let (kind, stage) = kind(stream.kind);
            list.push(serde_json::json!({ "name": stream.name, "kind": kind, "stage": stage, "offset": stream.offset, "bytes": stream.stored_bytes }));
        }
        Ok(serde_json::Value::from(list).to_string())
    }
    /// The poster's bytes (PNG or JPEG), if the archive has one and it has arrived.
    pub fn poster(&mut self) -> std::result::Result<Option<Vec<u8>>, JsError> {
        Content::poster(self.opened().map_err(error)?).map_err(error)
    }
}

impl Download {
    fn opened(&mut self) -> Result<&Archive> {
        if self.archive.is_none() {
            self.archive = Some(Archive::from_bytes(self.name.clone(), self.bytes.clone(), &super::LIMITS)?);
        }
        self.archive.as_ref().ok_or_else(|| Error::data(self.name.clone(), "nothing has arrived", "Load it again"))
    }
    /// The Gaussians up to `stage`.
    pub(super) fn gaussians(&mut self, stage: StreamStage, limits: &Limits) -> Result<HostGaussians> {
        crate::link();
        let name = self.name.clone();
        read_stage(&name, self.opened()?, stage, limits, &Silent)
    }
    /// What the archive holds up to `stage`, with motion or still without.
    pub(super) fn content(&mut self, stage: StreamStage, motion: bool, limits: &Limits) -> Result<Content> {
        let name = self.name.clone();
        let known = self.model.take().filter(|(_, known)| *known >= stage);
        let model = match known {
            Some((model, _)) => model,
            None => {
                let gaussians = self.gaussians(stage, limits)?;
                let manifest = self.opened()?.manifest().clone();
                let moving = Moving::of_manifest(&name, &manifest)?;
                StoredModel { manifest, gaussians, moving, playback: None }
            }
        };
        let bytes = self.opened()?.total_bytes()?;
        if !motion {
            self.model = Some((model.clone(), stage));
            // Whether it has any is not known yet.
            return Ok(Content { lacks_motion: false, remarks: Vec::new(), ..Content::of_model(model, bytes)? });
        }
        let playback = PlaybackLayer::of_archive(&name, self.opened()?, &model.gaussians, model.moving, limits)?;
        Content::of_model(StoredModel { playback, ..model }, bytes)
    }
}
