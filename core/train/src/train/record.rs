//! What a run remembers of its own numbers. It is kept in checkpoints, so that an interrupted run reports what an uninterrupted one does.

use serde::{Deserialize, Deserializer, Serialize};

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
    #[serde(deserialize_with = "number_or_null")]
    pub psnr_db: f64,
    pub moving_db: Option<f64>,
    /// Moving pixels in images of other times.
    pub frozen_db: Option<f64>,
    /// Mean slope over that of the truth.
    #[serde(deserialize_with = "number_or_null")]
    pub detail: f64,
    /// PSNR between the blurred images and the blurred truth; absent in older checkpoints.
    #[serde(default)]
    pub blurred_db: Option<f64>,
}

/// A number; NaN for the `null` that JSON has in place of one that is not finite, such as the score of a model that the watchdog is about to take back.
fn number_or_null<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(from)?.unwrap_or(f64::NAN))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_that_are_not_finite_can_be_read_again() {
        let score = Score { percent: 50, psnr_db: f64::NEG_INFINITY, moving_db: Some(f64::NAN), frozen_db: None, detail: f64::NAN, blurred_db: Some(20.0) };
        let finite = Score { psnr_db: 30.5, detail: 0.75, moving_db: None, ..score };
        let text = serde_json::to_string(&Record { scores: vec![score, finite], ..Record::default() }).unwrap();
        let Record { scores, .. } = serde_json::from_str(&text).unwrap();
        assert!(scores[0].psnr_db.is_nan() && scores[0].detail.is_nan() && scores[0].blurred_db == Some(20.0), "{scores:?}");
        assert_eq!(scores[1], finite);
    }

    #[test]
    fn attempts_come_back_and_are_absent_without_trouble() {
        let text = serde_json::to_string(&Record::default()).unwrap();
        assert!(!text.contains("attempts"), "{text}");
        assert_eq!(serde_json::from_str::<Record>(&text).unwrap(), Record::default());
        let record = Record { attempts: Attempts { checked_until: 130, lowered: 2, repeated: 1 }, ..Record::default() };
        assert_eq!(serde_json::from_str::<Record>(&serde_json::to_string(&record).unwrap()).unwrap(), record);
    }
}
