//! Everything a run reports, as typed events. Progress bars, JSON-lines logs, viewers and tests are listeners. Library code never prints.

use serde::{Deserialize, Serialize};

/// An event of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Event {
    /// A run began.
    RunStarted {
        /// The command: `train`, `compress`, `eval`.
        command: String,
        /// Device name.
        device: String,
        /// Root seed.
        seed: u64,
    },
    /// A decision that the user did not make explicitly.
    Note {
        /// What it is about.
        object: String,
        /// What was decided.
        message: String,
    },
    /// A problem that does not stop the run.
    Warning {
        /// The object it is about.
        object: String,
        /// The problem and what was done about it.
        message: String,
    },
    /// A stage of training began.
    StageStarted {
        /// `coarse`, `score` or `main`.
        stage: String,
        /// Iterations of the stage.
        iterations: usize,
        /// Gaussians at its start.
        gaussians: usize,
    },
    /// A training iteration ended. Not every iteration is reported.
    Iteration {
        /// The stage.
        stage: String,
        /// Iteration within the stage, from 1.
        iteration: usize,
        /// Iterations of the stage.
        of: usize,
        /// Loss, smoothed.
        loss: f32,
        /// PSNR of training views in dB, smoothed; images are not rounded to 8 bits.
        psnr_db: f32,
        /// Number of Gaussians.
        gaussians: usize,
        /// Milliseconds per iteration since the last such event.
        ms: f32,
    },
    /// Views that are kept out of training were scored.
    Validated {
        /// The stage.
        stage: String,
        /// Iteration within the stage.
        iteration: usize,
        /// Iterations of the stage.
        of: usize,
        /// Number of views.
        views: usize,
        /// Their mean PSNR in dB; images are not rounded to 8 bits.
        psnr_db: f32,
    },
    /// Density control changed the Gaussians.
    Densified {
        /// Iteration within the stage.
        iteration: usize,
        /// Copies added.
        cloned: usize,
        /// Gaussians split in two.
        split: usize,
        /// Gaussians relocated.
        moved: usize,
        /// Gaussians removed.
        pruned: usize,
        /// Number of Gaussians after it.
        gaussians: usize,
    },
    /// Counts of work done and skipped.
    Work {
        /// The stage or command.
        stage: String,
        /// What was counted.
        counter: String,
        /// Units done.
        done: u64,
        /// Units skipped.
        skipped: u64,
    },
    /// Progress of a long task.
    Progress {
        /// The task.
        task: String,
        /// Units done.
        done: u64,
        /// Units in total.
        total: u64,
    },
    /// A stage ended.
    StageFinished {
        /// The stage.
        stage: String,
        /// Wall-clock time in seconds. A line of a log has a key `seconds` of its own.
        #[serde(rename = "stage_seconds", alias = "seconds")]
        seconds: f64,
        /// Gaussians at its end.
        gaussians: usize,
    },
    /// A file was written.
    Saved {
        /// Path of the file.
        path: String,
        /// Its size in bytes.
        bytes: u64,
    },
}

/// Listens to events.
pub trait EventSink: Send + Sync {
    /// Receives one event. Must not block for long.
    fn emit(&self, event: &Event);
}

/// Ignores all events.
pub struct Silent;
impl EventSink for Silent {
    fn emit(&self, _: &Event) {}
}

/// Records all events, for tests.
#[derive(Default)]
pub struct Recorder(std::sync::Mutex<Vec<Event>>);
impl Recorder {
    /// The events so far.
    pub fn events(&self) -> Vec<Event> {
        self.0.lock().map(|e| e.clone()).unwrap_or_default()
    }
}
impl EventSink for Recorder {
    fn emit(&self, event: &Event) {
        if let Ok(mut events) = self.0.lock() {
            events.push(event.clone());
        }
    }
}

/// Sends each event to all of its listeners.
pub struct Fanout(pub Vec<Box<dyn EventSink>>);
impl EventSink for Fanout {
    fn emit(&self, event: &Event) {
        for sink in &self.0 {
            sink.emit(event);
        }
    }
}
