//! Everything a run says, as typed events. Progress bars, JSON-lines logs, viewers and tests are listeners; library code never prints.

use serde::{Deserialize, Serialize};

/// One thing that happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Event {
    /// A run began.
    RunStarted {
        /// What runs: `train`, `compress`, `eval`.
        command: String,
        /// Device name.
        device: String,
        /// Root seed.
        seed: u64,
    },
    /// Something was decided that the user did not ask for by name.
    Note {
        /// What it is about.
        object: String,
        /// What was decided.
        message: String,
    },
    /// Something the user should know and nothing has to stop for.
    Warning {
        /// The object it is about.
        object: String,
        /// What was seen and what was done about it.
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
    /// A training iteration ended (not every one is told).
    Iteration {
        /// The stage.
        stage: String,
        /// Iteration within the stage, from 1.
        iteration: usize,
        /// Iterations of the stage.
        of: usize,
        /// Loss, smoothed.
        loss: f32,
        /// Training PSNR in dB, smoothed, unrounded images.
        psnr_db: f32,
        /// Gaussians.
        gaussians: usize,
        /// Milliseconds per iteration since the last such event.
        ms: f32,
    },
    /// Densification or pruning changed the set.
    Densified {
        /// Iteration within the stage.
        iteration: usize,
        /// Copies added.
        cloned: usize,
        /// Gaussians split in two.
        split: usize,
        /// Gaussians moved to another place.
        moved: usize,
        /// Gaussians removed.
        pruned: usize,
        /// Gaussians now.
        gaussians: usize,
    },
    /// Work that was skipped or done, counted.
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
    /// Long work advanced.
    Progress {
        /// The task.
        task: String,
        /// Units done.
        done: u64,
        /// Units in all.
        total: u64,
    },
    /// A stage ended.
    StageFinished {
        /// The stage.
        stage: String,
        /// Wall seconds.
        seconds: f64,
        /// Gaussians at its end.
        gaussians: usize,
    },
    /// A file was completed.
    Saved {
        /// Which file.
        path: String,
        /// Its size.
        bytes: u64,
    },
}

/// Listens to events.
pub trait EventSink: Send + Sync {
    /// Takes one event. Must not block for long.
    fn emit(&self, event: &Event);
}

/// Ignores everything.
pub struct Silent;
impl EventSink for Silent {
    fn emit(&self, _: &Event) {}
}

/// Keeps everything, for tests.
#[derive(Default)]
pub struct Recorder(std::sync::Mutex<Vec<Event>>);
impl Recorder {
    /// What was heard so far.
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
