//! Runs a cell: the trained model is stored by a codec, read back, and scored.

use super::facts::{PeakMemory, device_facts};
use super::folder::SweepFolder;
use super::hash::name_of;
use super::plan::{Plan, PlannedCell, PlannedTraining};
use super::result::{Axes, Blocks, CellResult, Cost, FrameMs, ImageResult, KIND, ResultProvenance, SCHEMA, Score, Storage, StreamBytes};
use super::training::{FinishedTraining, Worker, config_of, planned_dataset};
use crate::auto::scene_options;
use crate::code;
use crate::config::RunConfig;
use crate::data;
use crate::eval::{EvalReport, Scored, evaluate};
use crate::images::write_png;
use crate::sample::spread_views;
use crate::train::{TuneJob, Tuner};
use burn::tensor::Device;
use cc4dgs_core::archive::{Archive, StreamKind};
use cc4dgs_core::{Error, Limits, Result, Scene, parse_device};
use cc4dgs_play::{ArchiveOptions, Model, ViewSource};
use serde::Serialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

/// A trained model with its scene: what all codecs of a training share.
pub(super) struct Trained<'a> {
    pub training: &'a PlannedTraining,
    pub finished: FinishedTraining,
    config: RunConfig,
    /// Those of the configuration, with those of this machine laid over them; results state the former.
    limits: Limits,
    device: Device,
    model: Model,
    scene: Arc<Scene>,
}

impl<'a> Trained<'a> {
    /// Opens the checkpoint of `training` and the scene as it was trained on.
    pub fn open(worker: &Worker, folder: &SweepFolder, training: &'a PlannedTraining, finished: FinishedTraining) -> Result<Self> {
        let config = config_of(folder, training)?;
        let limits = worker.limits_over(&config.limits)?;
        let device = parse_device(&config.device)?;
        let model = Model::open(&folder.training(&training.id), worker.registry, &device, &limits, worker.events)?;
        let trained = data::Trained { normalisation: model.normalisation, frames: config.scene.frames };
        let scene = data::open_in(&planned_dataset(training)?, &scene_options(&config, worker.processes), &trained, worker.registry, &limits)?;
        let scene = Arc::new(data::hold_out(&scene, config.train.validation)?);
        Ok(Self { training, finished, config, limits, device, model, scene })
    }
    /// Stores, reads back, scores, and writes the result.
    pub fn run(&self, worker: &Worker, folder: &SweepFolder, plan: &Plan, cell: &PlannedCell) -> Result<CellResult> {
        let archive = folder.archive(&cell.id);
        let choice = &cell.choice;
        let memory = PeakMemory::begin();
        let began = Instant::now();
        // Codecs that fine-tune see training and validation views only.
        let tuner = Tuner::new(TuneJob {
            model: &self.model,
            scene: self.scene.clone(),
            field_weights: &choice.field_weights,
            registry: worker.registry,
            device: &self.device,
            limits: &self.limits,
            events: worker.events,
            stop: worker.stop,
        });
        let options = ArchiveOptions {
            codec: &choice.codec,
            settings: &choice.settings,
            field_weights: &choice.field_weights,
            views: Some((ViewSource::Scene(&self.scene), &self.device)),
            tuner: Some(&tuner),
        };
        self.model.save_archive(&archive, &options, worker.registry, &self.limits, worker.events)?;
        let encode_seconds = began.elapsed().as_secs_f64();
        let began = Instant::now();
        let decoded = Model::open(&archive, worker.registry, &self.device, &self.limits, worker.events)?;
        let decode_seconds = began.elapsed().as_secs_f64();

        let split = plan.split.into();
        let scored = Scored { split, max_views: plan.max_views, perceptual: true };
        let views = scored.views(&self.scene);
        let kept = spread_views(&self.scene, &views, plan.images);
        let (mut images, mut frame_ms_each) = (Vec::with_capacity(views.len()), Vec::with_capacity(views.len()));
        let began = Instant::now();
        let (mut image_size, mut sizes_differ, mut pixels) = ([0, 0], false, 0u64);
        let report = evaluate(&decoded, &self.scene, scored, worker.registry, &self.device, worker.events, &mut |view, truth, render, score| {
            if worker.stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted(format!("scoring of cell {}; the next run scores it again", cell.id)));
            }
            let index = images.len();
            let keep = |owner: &str, number: usize, image| {
                let name = format!("images/{owner}/{number:05}.png");
                write_png(folder.root().join(&name), image).map(|()| name)
            };
            let keeps = kept.contains(&view);
            let size = [truth.width, truth.height];
            if index == 0 {
                image_size = size;
            }
            sizes_differ |= size != image_size;
            pixels += size.into_iter().map(u64::from).product::<u64>();
            frame_ms_each.push(((score.field_ms + score.raster_ms) * 1e3).round() / 1e3);
            images.push(ImageResult {
                camera: score.camera.clone(),
                frame: score.frame,
                time_norm: self.scene.views[view].time_norm,
                // All numbers for now; those without a protocol are left out below.
                scores: numbers(score)?,
                blocks: score.blocks.map(|b| (b.moving, b.lost, b.worst_psnr_db)),
                truth: if keeps { Some(keep(&format!("{}/truth", self.training.id), view, truth)?) } else { None },
                render: if keeps { Some(keep(&cell.id, index, render)?) } else { None },
            });
            Ok(())
        })?;
        let evaluation_seconds = began.elapsed().as_secs_f64();
        let (metrics, absent) = scores(&report)?;
        for image in &mut images {
            image.scores.retain(|name, _| metrics.contains_key(name));
        }
        let finished = &self.finished;
        let (version, commit) = code::version();
        let configuration = to_value(&self.config)?;
        let result = CellResult {
            kind: KIND.into(),
            schema: SCHEMA,
            id: cell.id.clone(),
            training: self.training.id.clone(),
            sweep: plan.name.clone(),
            axes: Axes {
                scene: self.training.scene.clone(),
                method: self.training.method.clone(),
                setting: self.training.setting.clone(),
                codec: cell.codec.clone(),
                seed: self.training.seed,
            },
            outcome: finished.outcome,
            message: finished.message.clone(),
            provenance: ResultProvenance {
                version: version.into(),
                commit: commit.into(),
                configuration_hash: name_of(&configuration)?,
                configuration,
                codec: choice.clone(),
                data: self.training.data.clone(),
                device: device_facts(&self.config.device),
            },
            split,
            image_size,
            sizes_differ,
            scored_pixels: sizes_differ.then_some(pixels),
            frames: self.scene.frame_count,
            iterations: finished.iterations,
            gaussians: report.gaussians,
            dynamic_gaussians: report.dynamic_gaussians,
            metrics,
            absent,
            blocks: report.psnr_worst_block_db.zip(report.lost_blocks).map(|(worst_psnr_db, lost)| Blocks { worst_psnr_db, lost }),
            images,
            storage: storage(&archive, &self.model, &self.limits)?,
            verdict: finished.verdict.as_ref().map(to_value).transpose()?,
            curve: finished.curve.clone(),
            validation_curve: finished.validation_curve.clone(),
            cost: Cost {
                training_seconds: finished.seconds,
                training_devices: finished.devices.clone(),
                stage_seconds: finished.stage_seconds.clone(),
                resumed: finished.resumed,
                curve_seconds: finished.curve_seconds.clone(),
                validation_seconds: finished.validation_seconds.clone(),
                encode_seconds,
                decode_seconds,
                evaluation_seconds,
                frame_ms: FrameMs {
                    mean: report.frame_ms.mean,
                    field_first: report.frame_ms.field_first,
                    raster_first: report.frame_ms.raster_first,
                    field: report.frame_ms.field,
                    raster: report.frame_ms.raster,
                },
                frame_ms_each,
                training_peak_memory_mb: finished.peak_memory_mb,
                cell_peak_memory_mb: memory.mb(),
                finished_unix: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs()),
            },
        };
        result.write(&folder.result(&cell.id))?;
        Ok(result)
    }
}

fn to_value(value: &impl Serialize) -> Result<Value> {
    serde_json::to_value(value).map_err(|e| Error::backend("result", e.to_string(), "Report this: every result should have a JSON form"))
}

/// The numbers among the fields of `value`, to five decimals.
fn numbers(value: &impl Serialize) -> Result<BTreeMap<String, f64>> {
    let Value::Object(fields) = to_value(value)? else { return Ok(BTreeMap::new()) };
    let rounded = |number: f64| (number * 1e5).round() / 1e5;
    Ok(fields.into_iter().filter_map(|(name, field)| field.as_f64().map(|number| (name, rounded(number)))).collect())
}

/// The means of a report with their protocols, and why some are missing. Metrics are taken from the report by name, so a new one needs no change here.
fn scores(report: &EvalReport) -> Result<(BTreeMap<String, Score>, BTreeMap<String, String>)> {
    let fields = to_value(report)?;
    let (mut metrics, mut absent) = (BTreeMap::new(), BTreeMap::new());
    for (name, metric) in &report.metrics {
        let protocol = match to_value(metric)? {
            Value::Object(protocol) => protocol,
            _ => Default::default(),
        };
        match fields.get(name).and_then(Value::as_f64) {
            Some(value) => _ = metrics.insert(name.to_string(), Score { value, protocol }),
            None if *name == "ms_ssim" => _ = absent.insert(name.to_string(), "an image is too small for five scales".to_string()),
            None if name.ends_with("_dynamic") || name.ends_with("_dynamic_db") => {
                absent.insert(name.to_string(), "no scored camera sees something move over several frames".to_string());
            }
            None => _ = absent.insert(name.to_string(), "it was not computed".to_string()),
        }
    }
    if let Some(reason) = &report.lpips_absent {
        absent.insert("lpips".into(), reason.clone());
    }
    Ok((metrics, absent))
}

/// Bytes of an archive and of the model it stands for.
fn storage(path: &Path, model: &Model, limits: &Limits) -> Result<Storage> {
    let streams = Archive::open(path, limits)?.stream_sizes();
    let of_kind = |kind| streams.iter().filter(|s| s.kind == kind).map(|s| s.stored_bytes).sum();
    let float32 = model.float32_size();
    let kind_name = |kind| match kind {
        StreamKind::Canonical => "canonical",
        StreamKind::Field => "field",
        StreamKind::Meta => "meta",
        StreamKind::Playback => "playback",
        StreamKind::Poster => "poster",
        StreamKind::Other(_) => "other",
    };
    Ok(Storage {
        total_bytes: std::fs::metadata(path).map_err(|e| Error::io(path, e))?.len(),
        deform_bytes: of_kind(StreamKind::Field),
        point_cloud_bytes: of_kind(StreamKind::Canonical),
        deform_grid_f32_bytes: float32.deform_grid,
        deform_net_f32_bytes: float32.deform_net,
        point_cloud_f32_bytes: float32.point_cloud,
        streams: streams
            .into_iter()
            .map(|s| StreamBytes { kind: kind_name(s.kind).into(), name: s.name, stored_bytes: s.stored_bytes, decoded_bytes: s.decoded_bytes })
            .collect(),
    })
}
