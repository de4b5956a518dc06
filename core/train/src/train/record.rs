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
}

/// What the log of a stage smooths. Floats are stored as their bits, because JSON has no infinity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct LogRecord {
    pub loss_bits: u32,
    pub psnr_db_bits: u32,
    /// Sum of the PSNR since the last event, and of how many views.
    pub psnr_sum_bits: u32,
    pub psnr_views: u32,
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
