//! Runs a training of a sweep, or goes on with one that was interrupted.

use super::facts::{PeakMemory, listing, training_device};
use super::folder::SweepFolder;
use super::location::locate;
use super::plan::PlannedTraining;
use super::result::{Curve, Outcome, TrainingDevice, ValidationCurve};
use crate::auto;
use crate::checkpoint::read_config;
use crate::checks::Verdict;
use crate::config::RunConfig;
use crate::event_log::{EVENTS, History, JsonLines, read_history};
use crate::layers::Layers;
use crate::train::{CONFIG, TrainJob, train};
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Event, EventSink, Limits, Registry, Result, config, toml};
use cc4dgs_play::checkpoint::CHECKPOINT;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// What a finished training leaves beside its checkpoint.
pub const FINISHED: &str = "training.json";
/// Where the processes that work on a training say what they compute on.
const DEVICES: &str = "devices.json";
/// Checkpoints on the way, where the grid does not say: one in so many of the iterations, and between so many iterations.
const CHECKPOINTS: usize = 8;
const CHECKPOINT_EVERY: [usize; 2] = [50, 2000];

/// A finished training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct FinishedTraining {
    pub outcome: Outcome,
    pub message: Option<String>,
    pub iterations: usize,
    pub verdict: Option<Verdict>,
    pub curve: Curve,
    pub curve_seconds: Vec<f64>,
    #[serde(default)]
    pub validation_curve: ValidationCurve,
    #[serde(default)]
    pub validation_seconds: Vec<f64>,
    pub seconds: f64,
    pub stage_seconds: BTreeMap<String, f64>,
    pub resumed: usize,
    pub peak_memory_mb: Option<f64>,
    #[serde(default)]
    pub devices: Vec<TrainingDevice>,
}

/// What runs need.
pub struct Worker<'a> {
    /// Where plug-ins are found.
    pub registry: &'a Registry,
    /// Where events go.
    pub events: &'a dyn EventSink,
    /// Set to stop at a safe point.
    pub stop: &'a AtomicBool,
    /// Limits of this machine over those of the grid, each `KEY=VALUE`. They decide what is refused, change no result and are in none.
    pub limits: &'a [String],
    /// Processes that share the memory of this machine, this one included: each keeps images decoded in a third of an equal part at most.
    pub processes: usize,
}

impl Worker<'_> {
    /// `limits` with those of this machine laid over them.
    pub(super) fn limits_over(&self, limits: &Limits) -> Result<Limits> {
        let mut table = toml::Table::try_from(limits).map_err(|e| Error::backend("limits", e.to_string(), "Report this as a defect"))?;
        config::set_all(&mut table, self.limits)?;
        config::parse_section("--limit", &table)
    }
}

/// Sends events to the log of a training and to a listener.
struct Both<'a>(&'a JsonLines, &'a dyn EventSink);

impl EventSink for Both<'_> {
    fn emit(&self, event: &Event) {
        self.0.emit(event);
        self.1.emit(event);
    }
}

/// Where the dataset of `training` lies.
///
/// # Errors
/// [`Error::Data`] where it is not there, or changed since the plan was made.
pub(super) fn planned_dataset(training: &PlannedTraining) -> Result<PathBuf> {
    let path = locate(&training.data.path)?;
    if training.data.files > 0 && !path.exists() {
        let place = std::path::absolute(&path).unwrap_or_else(|_| path.clone());
        let problem = format!("there is no {}", place.display());
        let remedy = "Relative paths start from the folder that the command runs in: run it where the plan was made, or restore the dataset";
        return Err(Error::data(format!("scene {}", training.data.path), problem, remedy));
    }
    if listing(&path)? != training.listing {
        let problem = "names or sizes of its files are not those of the plan";
        return Err(Error::data(format!("scene {}", training.data.path), problem, "Restore the dataset, or make the plan again"));
    }
    Ok(path)
}

/// Trains, goes on with what an interrupted process left, or reads what a finished one left. The caller holds the lock.
pub(super) fn finish_training(worker: &Worker, folder: &SweepFolder, training: &PlannedTraining) -> Result<FinishedTraining> {
    let run = folder.training(&training.id);
    let record = run.join(FINISHED);
    if record.is_file() {
        return read_finished(&record);
    }
    let path = planned_dataset(training)?;
    let memory = PeakMemory::begin();
    std::fs::create_dir_all(&run).map_err(|e| Error::io(&run, e))?;
    let (own, resume) = (run.join(CONFIG), run.join(CHECKPOINT).is_file());
    let begun = has_begun(&run);
    let log = JsonLines::open(&run.join(EVENTS), begun)?;
    let events = Both(&log, worker.events);
    let limits: Vec<String> = worker.limits.iter().map(|limit| format!("limits.{limit}")).collect();
    let layers = if begun { Layers::collect(worker.registry, None, Some(&own), &[])? } else { training.layers(worker.registry)? };
    let (mut config, scene) = auto::open_shared(&path, &layers.with(&limits)?, worker.registry, &events, worker.stop, worker.processes)?;
    // Results do not depend on the machine: what is written, and how many points a run begins with, has the limits of the grid.
    config.machine_limits = Some(std::mem::replace(&mut config.limits, layers.config()?.limits));
    if !begun && !layers.state("train.checkpoint_every") {
        config.train.checkpoint_every = (config.train.iterations / CHECKPOINTS).clamp(CHECKPOINT_EVERY[0], CHECKPOINT_EVERY[1]);
    }
    let devices = note_device(&run.join(DEVICES), begun, training_device(&config.device))?;
    let job =
        TrainJob { config: &config, scene, out: Some(run.clone()), resume, registry: worker.registry, events: &events, stop: worker.stop, observer: None };
    let (outcome, message, verdict, iterations) = match train(&job) {
        Ok((_, report)) => (Outcome::Done, None, report.verdict, Some(report.iterations)),
        // The checkpoint is there, so the cells can be scored all the same.
        Err(error @ Error::Failed { .. }) => (Outcome::Hopeless, Some(error.to_string()), None, None),
        Err(other) => return Err(other),
    };
    let history = read_history(&run.join(EVENTS))?;
    let (curve, curve_seconds) = curve(&history);
    let (validation_curve, validation_seconds) = validation_curve(&history);
    let finished = FinishedTraining {
        outcome,
        message,
        // One that gave up: as far as its log goes.
        iterations: iterations.or(history.points.last().map(|point| point.iteration)).unwrap_or(0),
        verdict,
        curve,
        curve_seconds,
        validation_curve,
        validation_seconds,
        seconds: history.seconds,
        stage_seconds: history.stage_seconds,
        resumed: history.resumed,
        peak_memory_mb: memory.mb(),
        devices,
    };
    let json =
        serde_json::to_string(&finished).map_err(|e| Error::backend("training", e.to_string(), "Report this: every training should have a JSON form"))?;
    write_atomically(&record, json.as_bytes())?;
    // From the file, as after an interruption: numbers that went through JSON may differ in the last digit.
    read_finished(&record)
}

/// Whether the training in the folder `run` goes on: then its configuration decides, and a plan of the preset `auto` is not made again. Without a checkpoint it
/// begins anew, and so does its plan: nothing else says how much of its time is left.
fn has_begun(run: &Path) -> bool {
    run.join(CONFIG).is_file() && run.join(CHECKPOINT).is_file()
}

/// Adds `device` to the devices that `file` has of a training, unless it is there, and returns all of them. A training that has not `begun` has none yet.
fn note_device(file: &Path, begun: bool, device: TrainingDevice) -> Result<Vec<TrainingDevice>> {
    let text = if begun { std::fs::read_to_string(file).unwrap_or_default() } else { String::new() };
    let mut devices: Vec<TrainingDevice> = serde_json::from_str(&text).unwrap_or_default();
    if !devices.contains(&device) {
        devices.push(device);
        let json = serde_json::to_string(&devices).map_err(|e| Error::backend("device", e.to_string(), "Report this: every device should have a JSON form"))?;
        write_atomically(file, json.as_bytes())?;
    }
    Ok(devices)
}

pub(super) fn read_finished(path: &Path) -> Result<FinishedTraining> {
    let text = std::fs::read_to_string(path).map_err(|e| Error::io(path, e))?;
    serde_json::from_str(&text).map_err(|e| Error::data(path.display().to_string(), e.to_string(), "Remove the folder of this training and run it again"))
}

/// The configuration that a training ran with.
pub(super) fn config_of(folder: &SweepFolder, training: &PlannedTraining) -> Result<RunConfig> {
    read_config(&folder.training(&training.id))
}

/// At most [`Curve::MOST_POINTS`] points of a history, the last one among them, and their seconds.
fn curve(history: &History) -> (Curve, Vec<f64>) {
    let n = history.points.len();
    let wanted = n.min(Curve::MOST_POINTS);
    let picked: Vec<_> = (1..=wanted).map(|i| history.points[i * n / wanted - 1]).collect();
    let curve = Curve {
        iteration: picked.iter().map(|p| p.iteration).collect(),
        psnr_db: picked.iter().map(|p| decimals(f64::from(p.psnr_db), 4)).collect(),
        gaussians: picked.iter().map(|p| p.gaussians).collect(),
    };
    (curve, picked.iter().map(|p| decimals(p.seconds, 3)).collect())
}

/// All scores of validation views, and their seconds.
fn validation_curve(history: &History) -> (ValidationCurve, Vec<f64>) {
    let points = &history.validation;
    let curve = ValidationCurve {
        iteration: points.iter().map(|p| p.iteration).collect(),
        psnr_db: points.iter().map(|p| decimals(f64::from(p.psnr_db), 4)).collect(),
    };
    (curve, points.iter().map(|p| decimals(p.seconds, 3)).collect())
}

fn decimals(value: f64, digits: i32) -> f64 {
    (value * 10f64.powi(digits)).round() / 10f64.powi(digits)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event_log::HistoryPoint;

    #[test]
    fn a_dataset_that_is_not_there_is_no_changed_one() {
        let folder = tempfile::tempdir().unwrap();
        let mut training = super::super::plan::tests::example().trainings.remove(0);
        training.data.files = 1;
        training.data.path = folder.path().join("moved").display().to_string();
        let message = planned_dataset(&training).unwrap_err().to_string();
        assert!(message.contains("there is no") && message.contains("run it where the plan was made"), "{message}");
        std::fs::create_dir(folder.path().join("moved")).unwrap();
        assert!(planned_dataset(&training).unwrap_err().to_string().contains("not those of the plan"));
    }

    #[test]
    fn a_training_without_a_checkpoint_begins_anew() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(CONFIG), "").unwrap();
        assert!(!has_begun(folder.path()), "the length of a plan would never be settled");
        std::fs::write(folder.path().join(CHECKPOINT), "").unwrap();
        assert!(has_begun(folder.path()));
    }

    #[test]
    fn a_training_states_every_device_that_worked_on_it() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(DEVICES);
        let here = training_device("flex");
        let mut there = TrainingDevice { host: "elsewhere".into(), ..here.clone() };
        there.device.threads += 1;
        assert_eq!(note_device(&file, false, here.clone()).unwrap(), std::slice::from_ref(&here));
        note_device(&file, true, there.clone()).unwrap();
        assert_eq!(note_device(&file, true, here.clone()).unwrap(), [here, there.clone()], "each once, in the order of their work");
        assert_eq!(note_device(&file, false, there.clone()).unwrap(), [there], "begun anew");
    }

    #[test]
    fn curves_are_short_and_end_where_the_training_does() {
        let point = |iteration| HistoryPoint { iteration, seconds: iteration as f64, psnr_db: 20.0, gaussians: 1 };
        let of = |count: usize| curve(&History { points: (1..=count).map(point).collect(), ..Default::default() });
        assert_eq!(of(0).0, Curve::default());
        assert_eq!(of(3).0.iteration, [1, 2, 3]);
        let (long, seconds) = of(1234);
        assert_eq!((long.iteration.len(), long.iteration.last(), seconds.last()), (Curve::MOST_POINTS, Some(&1234), Some(&1234.0)));
        assert!(long.iteration.windows(2).all(|pair| pair[0] < pair[1]));
    }
}
