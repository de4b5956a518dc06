//! Runs one training of a sweep with its cells, as often as needed and never twice at a time.

use super::cell::Trained;
use super::folder::{Failure, SweepFolder};
use super::lock::TrainingLock;
use super::plan::{Plan, PlannedCell};
use super::result::{CellResult, Outcome};
use super::training::{Worker, finish_training};
use cc4dgs_core::{Error, Event, Result};
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Between two looks at a lock that another process holds.
const PATIENCE: Duration = Duration::from_millis(500);

/// What to do about a training that another process works on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Busy {
    /// Wait until it is done.
    Wait,
    /// Leave it.
    Leave,
}

/// What came of a training and its cells.
#[derive(Clone, Debug, PartialEq)]
pub enum TrainingState {
    /// All wanted cells have results.
    Finished(Vec<CellResult>),
    /// Another process works on it.
    Busy,
}

/// Runs the training at `index` and those of its cells that lack a result; `only` names one cell.
///
/// # Errors
/// [`Error::Parameter`] for an index that the plan does not have, and whatever training, codec and scores report. Errors are remembered in the sweep's folder.
pub fn run_training(worker: &Worker, folder: &SweepFolder, plan: &Plan, index: usize, only: Option<&str>, busy: Busy) -> Result<TrainingState> {
    plan.check_program()?;
    let Some(training) = plan.trainings.get(index) else {
        let problem = format!("there is no training {index}, the plan has {}", plan.trainings.len());
        return Err(Error::parameter("--index", problem, "Count from 0"));
    };
    let wanted: Vec<&PlannedCell> = plan.cells_of(&training.id).filter(|cell| only.is_none_or(|id| cell.id == id)).collect();
    let finished = || wanted.iter().map(|cell| folder.finished(cell)).collect::<Option<Vec<_>>>();
    if let Some(results) = finished() {
        return Ok(TrainingState::Finished(results));
    }
    folder.create()?;
    let lock_file = folder.lock(&training.id);
    let lock = loop {
        match TrainingLock::take(&lock_file)? {
            Some(lock) => break lock,
            None if busy == Busy::Leave => return Ok(TrainingState::Busy),
            None if worker.stop.load(Ordering::Relaxed) => return Err(Error::Interrupted(format!("waiting for {}", training.label()))),
            None => std::thread::sleep(PATIENCE),
        }
    };
    // Somebody else may have finished it in the meantime.
    if let Some(results) = finished() {
        return Ok(TrainingState::Finished(results));
    }
    let run = || {
        let trained = Trained::open(worker, folder, training, finish_training(worker, folder, training)?)?;
        let (mut results, mut failed) = (Vec::with_capacity(wanted.len()), None);
        for cell in &wanted {
            match folder.finished(cell).map_or_else(|| trained.run(worker, folder, plan, cell), Ok) {
                Ok(result) => results.push(result),
                Err(interrupted @ Error::Interrupted(_)) => return Err(interrupted),
                // Codecs do not depend on each other: the error of one keeps none of the others from being tried.
                Err(error) => {
                    worker.events.emit(&Event::Warning { object: format!("cell {} (codec {})", cell.id, cell.codec), message: error.to_string() });
                    failed = failed.or(Some(error));
                }
            }
        }
        failed.map_or(Ok(results), Err)
    };
    let outcome = run();
    match &outcome {
        Ok(_) | Err(Error::Interrupted(_)) => folder.set_failure(&training.id, None)?,
        Err(error) => folder.set_failure(&training.id, Some(&Failure { exit_code: error.exit_code(), message: error.to_string() }))?,
    }
    drop(lock);
    let results = outcome?;
    for result in &results {
        worker.events.emit(&Event::Note { object: format!("cell {}", result.id), message: summary(result) });
    }
    Ok(TrainingState::Finished(results))
}

/// One result in a line.
pub fn summary(result: &CellResult) -> String {
    let a = &result.axes;
    let psnr = result.metrics.get("psnr_db").map_or_else(String::new, |score| format!(", {:.2} dB", score.value));
    let hopeless = if result.outcome == Outcome::Hopeless { ", hopeless" } else { "" };
    format!("{} {} {} {} seed {}{psnr}, {:.3} MB{hopeless}", a.scene, a.method, a.setting, a.codec, a.seed, result.size_mb())
}
