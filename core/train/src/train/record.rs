//! What a run remembers of its own numbers. It is kept in checkpoints, so that an interrupted run reports what an uninterrupted one does.

use serde::{Deserialize, Serialize};

/// Numbers of a run that outlive an interruption.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Record {
    /// Smoothed numbers of the stage under way; at their defaults between stages.
    pub(crate) log: LogRecord,
    /// Scores of the model on its way through the main stage.
    pub(crate) scores: Vec<Score>,
    /// What the watchdog did in the stage under way; at its default between stages.
    #[serde(skip_serializing_if = "Attempts::is_none")]
    pub(crate) attempts: Attempts,
    /// Seconds of the planned time that were left, where the length of the main stage was not settled yet.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) seconds_left: Option<f64>,
}

/// What the watchdog did in a stage. Absent from the checkpoints of older versions and of runs without trouble.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct Attempts {
    /// Every iteration up to this one is checked.
    pub checked_until: usize,
    /// Times that a learning rate was lowered.
    pub lowered: usize,
    /// Times that the run went back to find a cause.
    pub repeated: usize,
}

impl Attempts {
    fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// What the log of a stage smooths and counts. Floats are stored as their bits, because JSON has no infinity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct LogRecord {
    pub loss_bits: u32,
    pub psnr_db_bits: u32,
    /// Sum of the PSNR since the last event, and of how many views.
    pub psnr_sum_bits: u32,
    pub psnr_views: u32,
    /// What [`super::log::Log::finish`] tells: done and skipped. Absent where nothing was counted, and from older checkpoints.
    #[serde(skip_serializing_if = "LogRecord::is_nothing")]
    pub work: [(u64, u64); 3],
}

impl LogRecord {
    fn is_nothing(work: &[(u64, u64); 3]) -> bool {
        *work == [(0, 0); 3]
    }
}

/// A model's scores at one moment of the main stage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Score {
    /// Share of the main stage, percent.
    pub percent: usize,
    pub psnr_db: f64,
    pub moving_db: Option<f64>,
    /// Moving pixels in images of other times.
    pub frozen_db: Option<f64>,
    /// Mean slope over that of the truth.
    pub detail: f64,
    /// PSNR between the blurred images and the blurred truth; absent in older checkpoints.
    #[serde(default)]
    pub blurred_db: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attempts_come_back_and_are_absent_without_trouble() {
        let text = serde_json::to_string(&Record::default()).unwrap();
        assert!(!text.contains("attempts"), "{text}");
        assert_eq!(serde_json::from_str::<Record>(&text).unwrap(), Record::default());
        let record = Record { attempts: Attempts { checked_until: 130, lowered: 2, repeated: 1 }, ..Record::default() };
        assert_eq!(serde_json::from_str::<Record>(&serde_json::to_string(&record).unwrap()).unwrap(), record);
    }
}
