//! Writes an archive with every codec into a folder, and two of `compact` that have layers and coded attributes of plug-ins, and prints what each decodes to,
//! as `CHECKSUM FILE`; with files instead of a folder it prints those. CI compares with what `plugins_on_wasm` finds in the same files.
//!
//! `cargo run --release -p cc4dgs-codecs --example archives -- FOLDER | FILE...`

#![allow(clippy::print_stdout)]

#[path = "wasm/decoded.rs"]
mod decoded;

use cc4dgs_format::archive::{ArchiveWriter, CodecEntry, DeformerEntry, Manifest, StreamKind, write_atomically};
use cc4dgs_format::{
    Camera, CodecContext, CodecPlugin, DeformerContext, Entries, Error, EvaluateDeformer, ExtraAttribute, FIELD_STREAMS, HostGaussians, Image8, Limits, Plugin,
    RenderModel, RenderedPlanes, Result, Seed, Silent, Stream, TrainingViews, WeightArray, WeightCodecPlugin, toml, weight_seed,
};
use std::path::{Path, PathBuf};

/// Gaussians of a case: more than one block of 2^14.
const COUNT: usize = 20_000;
/// Gaussians of the case with three layers: each layer has more than one block.
const MANY: usize = 80_000;
/// The root of all seeds.
const ROOT: u64 = 5;
/// Gaussians with larger scores move.
const THRESHOLD: f32 = 0.5;
/// Streams that archives with three layers have, and those with coded attributes in two layers.
const LAYERED: &[&str] = &["means.2", "sh.0.2", "sh.2"];
const CODED: &[&str] = &["means.1", "coded", "coded.fade.rows", "coded.fade.0", "coded.life.1", "coded.velocity.2"];

fn main() -> Result<()> {
    cc4dgs_codecs::link();
    let given: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let files = match given.as_slice() {
        [folder] if folder.is_dir() => write_all(folder)?,
        _ => given,
    };
    for file in files {
        let bytes = std::fs::read(&file).map_err(|e| Error::io(&file, e))?;
        println!("{:016x} {}", decoded::checksum(bytes)?, file.display());
    }
    Ok(())
}

/// The contents of an archive.
struct Case<'a> {
    name: &'static str,
    codec: &'static CodecPlugin,
    profile: &'static str,
    settings: toml::Table,
    gaussians: &'a HostGaussians,
    context: &'a CodecContext<'a>,
    /// Streams that the archive must have; otherwise it would not test what it is for.
    streams: &'static [&'static str],
}

/// Writes all archives. Weight codecs are used in turn.
fn write_all(folder: &Path) -> Result<Vec<PathBuf>> {
    let codecs = Entries::<CodecPlugin>::collect()?;
    let context = CodecContext { dynamic_threshold: Some(THRESHOLD), ..CodecContext::new(Seed::root(ROOT).child("codec"), Limits::default(), &Silent) };
    let view = View(Camera::look_at("view", (400, 300), 0.8, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]));
    let seen = CodecContext { views: Some(&view), renderer: Some(&view), deformer: Some(&view), ..context };
    let (plain, many, moved) = (gaussians(COUNT), gaussians(MANY), with_attributes(gaussians(COUNT)));
    let mut cases = Vec::new();
    for codec in codecs.iter() {
        let mut settings = toml::Table::new();
        if codec.info.schema.contains("sample_budget") {
            settings.insert("sample_budget".into(), 20_000.into());
        }
        cases.push(Case { name: codec.info.name, codec, profile: "", settings, gaussians: &plain, context: &context, streams: &[] });
    }
    let codec = codecs.get("compact")?;
    let layers = |number: i64| toml::Table::from_iter([("layers".into(), number.into())]);
    cases.push(Case { name: "compact-layers", codec, profile: "", settings: layers(3), gaussians: &many, context: &context, streams: LAYERED });
    // The size is bounded, not the error of images: images of `View` depend neither on the order of Gaussians nor on rows that are not needed.
    cases.push(Case { name: "compact-coded", codec, profile: "max-size=1MB", settings: layers(2), gaussians: &moved, context: &seen, streams: CODED });
    let weight_codecs: Vec<&WeightCodecPlugin> = Entries::<WeightCodecPlugin>::collect()?.iter().collect();
    cases.iter().zip(weight_codecs.into_iter().cycle()).map(|(case, weight_codec)| case.write(folder, weight_codec)).collect()
}

impl Case<'_> {
    /// Writes the archive, with weights of a deformer.
    fn write(&self, folder: &Path, weight_plugin: &WeightCodecPlugin) -> Result<PathBuf> {
        let entry = |of: &Plugin, profile: &str, settings: toml::Table| {
            let (name, profile, version) = (of.name.into(), profile.into(), of.version.into());
            CodecEntry { name, profile, version, settings }
        };
        let deformer = DeformerEntry {
            name: "none".into(),
            version: String::new(),
            settings: toml::Table::new(),
            context: DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: 2, seed: Seed::root(ROOT) },
            weights: entry(&weight_plugin.info, "", toml::Table::new()),
        };
        let codec = entry(&self.codec.info, self.profile, self.settings.clone());
        let mut manifest = Manifest { codec, deformer: Some(deformer), frame_count: 2, ..Default::default() };
        (manifest.gaussian_count, manifest.sh_degree, manifest.provenance.seed) = (self.gaussians.len() as u64, self.gaussians.sh_degree, ROOT);
        let streams = (self.codec.build)(self.profile, &self.settings)?.encode(self.gaussians, self.context)?;
        if let Some(missing) = self.streams.iter().find(|name| !streams.iter().any(|s| s.name == **name)) {
            let problem = format!("it has no stream '{missing}'");
            return Err(Error::backend(format!("archive {}", self.name), problem, "Choose Gaussians and settings for which the codec writes it"));
        }
        let weights = [WeightArray { name: "table".into(), shape: vec![64, 48], values: (0..64 * 48).map(|i| draw(i, 8)).collect() }];
        // The importance of weights, from which some codecs choose steps per row.
        let importance = [(0..64 * 48).map(|i| 2f32.powi(i / 16 % 20)).collect::<Vec<f32>>()];
        let context = CodecContext { weight_importance: Some(&importance), ..CodecContext::new(weight_seed(ROOT), Limits::default(), &Silent) };
        let weights = (weight_plugin.build)(&toml::Table::new())?.encode(&weights, &context)?;
        let weights = weights.into_iter().map(|s| Stream { name: format!("{FIELD_STREAMS}{}", s.name), ..s });
        let bytes = ArchiveWriter::new(manifest).add_all(StreamKind::Canonical, streams).add_all(StreamKind::Field, weights).to_bytes()?;
        let file = folder.join(format!("{}.cc4d", self.name));
        write_atomically(&file, &bytes)?;
        Ok(file)
    }
}

/// A view of a renderer that draws only attributes of plug-ins, each in pixels of its own. The weight of an attribute is constant, or depends on size or
/// visibility of its Gaussian, so that every way in which steps can grow is used.
struct View(Camera);

impl RenderModel for View {
    fn render(&self, gaussians: &HostGaussians, camera: &Camera, _: f32) -> Result<RenderedPlanes> {
        let pixels = (camera.width * camera.height) as usize;
        let mut planes = vec![0.0; 5 * pixels];
        for (i, (scales, logit)) in gaussians.log_scales.chunks_exact(3).zip(&gaussians.opacity_logits).enumerate() {
            let mut sizes = [scales[0].exp(), scales[1].exp(), scales[2].exp()];
            sizes.sort_unstable_by(f32::total_cmp);
            let seen = (sizes[1] * sizes[2]).sqrt() / (1.0 + (-logit).exp());
            for (name, attribute) in &gaussians.extra {
                let shows = match name.as_str() {
                    "fade" => 5.0 * seen,
                    "velocity" => seen / sizes[1],
                    _ => 0.2,
                };
                for (k, value) in attribute.values[i * attribute.width..(i + 1) * attribute.width].iter().enumerate() {
                    planes[(7 * i + k) % (3 * pixels)] += shows * value;
                }
            }
        }
        Ok(RenderedPlanes { width: camera.width, height: camera.height, planes })
    }
    fn background(&self) -> [f32; 3] {
        [0.0; 3]
    }
}

impl EvaluateDeformer for View {
    fn deform(&self, gaussians: &HostGaussians, _: f32) -> Result<HostGaussians> {
        Ok(gaussians.clone())
    }
}

impl TrainingViews for View {
    fn len(&self) -> usize {
        1
    }
    fn view(&self, _: usize) -> (&Camera, f32) {
        (&self.0, 0.5)
    }
    fn image(&self, _: usize) -> Result<Image8> {
        let (width, height) = (self.0.width, self.0.height);
        Ok(Image8 { width, height, channels: 3, data: vec![0; (3 * width * height) as usize] })
    }
}

/// A number from -1 to 1.
fn draw(index: usize, column: usize) -> f32 {
    (Seed::root(ROOT).index(index as u64).index(column as u64).value() >> 40) as f32 / (1u64 << 23) as f32 - 1.0
}

fn gaussians(count: usize) -> HostGaussians {
    let mut out = HostGaussians { sh_degree: 2, opacity_logits: vec![0.0; count], ..Default::default() };
    for (column, (name, width, values)) in out.columns_mut().into_iter().enumerate() {
        let shift = if name == "log_scales" { -4.0 } else { 0.0 };
        *values = (0..count * width).map(|i| shift + draw(i, column)).collect();
    }
    out.extra.insert("life".into(), ExtraAttribute::exact(2, (0..2 * count).map(|i| draw(i, 9)).collect()).within(0.01));
    out
}

/// `gaussians` with attributes that are needed in moving rows, and in some rows.
fn with_attributes(mut gaussians: HostGaussians) -> HostGaussians {
    let count = gaussians.len();
    let attribute = |width: usize, column: usize| ExtraAttribute::exact(width, (0..width * count).map(|i| draw(i, column)).collect());
    let moves = gaussians.dynamic_scores.iter().map(|score| *score > THRESHOLD).collect();
    gaussians.extra.insert("velocity".into(), attribute(3, 10).needed_in(moves, 0.0));
    gaussians.extra.insert("fade".into(), attribute(1, 11).needed_in((0..count).map(|i| i % 3 == 0).collect(), 1.0));
    gaussians
}
