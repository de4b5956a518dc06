//! The folder of a sweep: where everything lies, and how far it is.

use super::emit::INTERRUPTED;
use super::lock::TrainingLock;
use super::plan::{Plan, PlannedCell};
use super::read::RESULTS;
use super::result::CellResult;
use super::training::FINISHED;
use cc4dgs_core::archive::write_atomically;
use cc4dgs_core::{Error, Result};
use cc4dgs_play::checkpoint::CHECKPOINT;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The last error of a training, kept until it succeeds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Failure {
    /// Exit code of the process.
    pub exit_code: u8,
    /// What it said.
    pub message: String,
}

/// Paths of a sweep.
#[derive(Clone, Debug)]
pub struct SweepFolder {
    root: PathBuf,
}

impl SweepFolder {
    /// The sweep in `root`.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self { root: root.into() }
    }
    /// The folder itself.
    pub fn root(&self) -> &Path {
        &self.root
    }
    /// Folder of a training's run.
    pub fn training(&self, id: &str) -> PathBuf {
        self.root.join("trainings").join(id)
    }
    /// The lock of a training.
    pub fn lock(&self, training: &str) -> PathBuf {
        self.root.join("trainings").join(format!("{training}.lock"))
    }
    /// Where a training's process writes its messages.
    pub fn log(&self, training: &str) -> PathBuf {
        self.root.join("logs").join(format!("{training}.log"))
    }
    /// The archive of a cell.
    pub fn archive(&self, cell: &str) -> PathBuf {
        self.root.join("archives").join(format!("{cell}.cc4d"))
    }
    /// The result of a cell.
    pub fn result(&self, cell: &str) -> PathBuf {
        self.root.join(RESULTS).join(format!("{cell}.json"))
    }
    fn failure_file(&self, training: &str) -> PathBuf {
        self.root.join("trainings").join(format!("{training}.failure.json"))
    }
    /// Creates the folders that results and logs lie in.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn create(&self) -> Result<()> {
        for name in ["trainings", "archives", "logs", RESULTS] {
            let folder = self.root.join(name);
            std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, e))?;
        }
        Ok(())
    }
    /// The finished result of `cell`. A file that is no result of this cell counts as none: the cell is run again.
    pub fn finished(&self, cell: &PlannedCell) -> Option<CellResult> {
        let path = self.result(&cell.id);
        let text = std::fs::read_to_string(&path).ok()?;
        CellResult::from_json(&path.display().to_string(), &text).ok().filter(|r| r.id == cell.id && r.training == cell.training)
    }
    /// Remembers why a training did not succeed, or (`None`) forgets it.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn set_failure(&self, training: &str, failure: Option<&Failure>) -> Result<()> {
        let path = self.failure_file(training);
        match failure {
            Some(failure) => {
                let json = serde_json::to_string(failure).map_err(|e| Error::backend("failure", e.to_string(), "Report this"))?;
                write_atomically(path, json.as_bytes())
            }
            None => match std::fs::remove_file(&path) {
                Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path, e)),
                _ => Ok(()),
            },
        }
    }
    /// Why the last attempt at a training did not succeed.
    pub fn failure(&self, training: &str) -> Option<Failure> {
        serde_json::from_str(&std::fs::read_to_string(self.failure_file(training)).ok()?).ok()
    }
    /// In words, why the cells of a training are not there.
    pub fn state(&self, training: &str) -> String {
        if let Some(holder) = TrainingLock::holder(&self.lock(training)) {
            return format!("under way ({holder})");
        }
        let run = self.training(training);
        let trained = run.join(FINISHED).is_file();
        // The pool remembers processes that were asked to stop, too.
        if let Some(failure) = self.failure(training).filter(|failure| failure.exit_code != INTERRUPTED) {
            let what = if trained { "trained, then failed" } else { "failed" };
            return format!("{what} with exit code {}: {}", failure.exit_code, failure.message);
        }
        match (trained, run.join(CHECKPOINT).is_file()) {
            (true, _) => "trained, not all codecs scored".into(),
            (false, true) => "interrupted; the next run goes on from its checkpoint".into(),
            _ if run.is_dir() => "interrupted before its first checkpoint".into(),
            _ => "not begun".into(),
        }
    }
    /// The trainings of `plan` that lack a result, by index.
    pub fn open_trainings(&self, plan: &Plan) -> Vec<usize> {
        let is_open = |index: &usize| plan.cells_of(&plan.trainings[*index].id).any(|cell| self.finished(cell).is_none());
        (0..plan.trainings.len()).filter(is_open).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::plan::tests::example as plan;
    use super::super::read::tests::cell;
    use super::*;

    #[test]
    fn a_result_counts_if_it_is_the_cells_own() {
        let root = tempfile::tempdir().unwrap();
        let folder = SweepFolder::new(root.path());
        folder.create().unwrap();
        let plan = plan();
        let [first, second] = [&plan.cells[0], &plan.cells[1]];
        assert_eq!(folder.open_trainings(&plan), [0]);
        let of = |wanted: &PlannedCell| cell(&wanted.id, |r| r.training = wanted.training.clone());
        of(first).write(&folder.result(&first.id)).unwrap();
        assert!(folder.finished(first).is_some() && folder.finished(second).is_none());
        // Half a file, and the result of another cell.
        std::fs::write(folder.result(&second.id), "{\"kind\":\"cc4dgs-re").unwrap();
        assert!(folder.finished(second).is_none());
        of(first).write(&folder.result(&second.id)).unwrap();
        assert_eq!(folder.open_trainings(&plan), [0]);
        of(second).write(&folder.result(&second.id)).unwrap();
        assert!(folder.open_trainings(&plan).is_empty());
    }

    #[test]
    fn a_missing_training_says_why() {
        let root = tempfile::tempdir().unwrap();
        let folder = SweepFolder::new(root.path());
        folder.create().unwrap();
        let id = plan().trainings[0].id.clone();
        assert_eq!(folder.state(&id), "not begun");
        std::fs::create_dir_all(folder.training(&id)).unwrap();
        assert!(folder.state(&id).contains("before its first checkpoint"));
        std::fs::write(folder.training(&id).join(CHECKPOINT), "x").unwrap();
        assert!(folder.state(&id).contains("goes on"));
        folder.set_failure(&id, Some(&Failure { exit_code: 4, message: "out of memory".into() })).unwrap();
        assert!(folder.state(&id).contains("exit code 4: out of memory"));
        folder.set_failure(&id, Some(&Failure { exit_code: INTERRUPTED, message: "the process was asked to stop".into() })).unwrap();
        assert!(folder.state(&id).contains("goes on"), "{}", folder.state(&id));
        folder.set_failure(&id, None).unwrap();
        folder.set_failure(&id, None).unwrap();
        let lock = TrainingLock::take(&folder.lock(&id)).unwrap();
        assert!(folder.state(&id).starts_with("under way (process"));
        drop(lock);
    }
}
