//! Archives with a playback layer.

use super::Baked;
use cc4dgs_core::archive::{Archive, ArchiveWriter, Presentation, StreamKind};
use cc4dgs_core::{Error, Result, Stream, StreamStage, canonical_stages};

/// Key of the manifest's `extra` with the figures of the layer.
pub const PLAYBACK: &str = "playback";

/// The playback layer that [`with_additions`] writes.
pub enum Motion<'a> {
    /// The one that the archive has, if any.
    Kept,
    /// This one; `None` for models that do not move.
    Replaced(Option<&'a Baked>),
}

/// What [`with_additions`] adds to an archive.
pub struct Additions<'a> {
    /// The layer.
    pub motion: Motion<'a>,
    /// How a player shows it.
    pub presentation: Presentation,
    /// PNG or JPEG bytes.
    pub poster: Option<Vec<u8>>,
    /// Whether the deformer's weights are left out. The archive then moves by its layer alone.
    pub without_field: bool,
}

/// The bytes of `archive` with `additions`. A poster that it has already is replaced or dropped. Streams come in the order in which a player
/// needs them: poster, Gaussians, their motion (the playback layer, or without one the field), harmonics where the codec has them apart, all others.
///
/// # Errors
/// What reading and writing report.
pub fn with_additions(archive: &Archive, additions: Additions) -> Result<Vec<u8>> {
    let mut manifest = archive.manifest().clone();
    manifest.presentation = additions.presentation;
    let layer = match additions.motion {
        Motion::Kept => archive.read_kind(StreamKind::Playback)?,
        Motion::Replaced(baked) => {
            manifest.extra.remove(PLAYBACK);
            if let Some(baked) = baked {
                // By way of text, so that numbers have the digits of a float32 and come back as they were.
                let report = serde_json::to_string(&baked.report).and_then(|text| serde_json::from_str(&text));
                let report = report.map_err(|e| Error::backend("playback layer", e.to_string(), "Report this"))?;
                manifest.extra.insert(PLAYBACK.into(), report);
            }
            baked.map(|b| b.streams.clone()).unwrap_or_default()
        }
    };
    let field = if additions.without_field { Vec::new() } else { archive.read_kind(StreamKind::Field)? };
    if layer.is_empty() && field.is_empty() {
        // Nothing moves. Readers take a deformer without weights and layer for a motion that was lost.
        manifest.deformer = None;
    }
    let mut writer = ArchiveWriter::new(manifest);
    if let Some(bytes) = additions.poster {
        writer = writer.add(StreamKind::Poster, Stream { name: "poster".into(), bytes });
    }
    let mut canonical: Vec<(StreamStage, Stream)> =
        canonical_stages("the archive", archive)?.into_iter().zip(archive.read_kind(StreamKind::Canonical)?).collect();
    canonical.sort_by_key(|(stage, _)| *stage);
    let harmonics = canonical.split_off(canonical.partition_point(|(stage, _)| *stage <= StreamStage::BASE));
    let streams = |staged: Vec<(StreamStage, Stream)>| staged.into_iter().map(|(_, stream)| stream);
    let (motion, unused) = if layer.is_empty() { (field, Vec::new()) } else { (Vec::new(), field) };
    writer = writer.add_all(StreamKind::Canonical, streams(canonical)).add_all(StreamKind::Playback, layer).add_all(StreamKind::Field, motion);
    writer = writer.add_all(StreamKind::Canonical, streams(harmonics)).add_all(StreamKind::Field, unused);
    let mut kinds = vec![StreamKind::Meta];
    for stream in archive.stream_sizes() {
        if let StreamKind::Other(_) = stream.kind
            && !kinds.contains(&stream.kind)
        {
            kinds.push(stream.kind);
        }
    }
    for kind in kinds {
        writer = writer.add_all(kind, archive.read_kind(kind)?);
    }
    writer.to_bytes()
}
