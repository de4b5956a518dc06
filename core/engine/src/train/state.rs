//! Everything a run needs to continue to the same bytes.

use super::FieldOptimizer;
use crate::columns::GaussianSet;
use crate::densify::ScreenStats;
use crate::schedule::Stage;
use burn::tensor::{Device, Int, Tensor, TensorData};
use cc4dgs_core::gaussians::to_vec;
use cc4dgs_core::{DeformerContext, HostGaussians, Result, Seed};
use serde::{Deserialize, Serialize};

/// Which Gaussians the field may move.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "what", rename_all = "kebab-case")]
pub enum Moving {
    /// All of them (a single moving camera cannot be scored).
    Everything,
    /// None (a static scene).
    Nothing,
    /// Those whose dynamic score is over `zeta` (paper Section V).
    Scored {
        /// The threshold.
        zeta: f32,
    },
}

impl Moving {
    /// Indices of the Gaussians that may move, `None` for all.
    pub fn rows(self, dynamic_scores: &[f32]) -> Option<Vec<usize>> {
        match self {
            Moving::Everything => None,
            Moving::Nothing => Some(Vec::new()),
            Moving::Scored { zeta } => Some((0..dynamic_scores.len()).filter(|&i| dynamic_scores[i] > zeta).collect()),
        }
    }
}

/// The rows the field is asked about, on the device.
// One value per run: boxing the tensor would only cost an allocation.
#[allow(clippy::large_enum_variant)]
#[derive(Clone, Debug)]
pub enum Rows {
    /// Every Gaussian, in order.
    All,
    /// These rows [M].
    Some(Tensor<1, Int>, usize),
}

impl Rows {
    /// Uploads `rows`.
    pub fn new(rows: Option<Vec<usize>>, device: &Device) -> Self {
        match rows {
            None => Rows::All,
            Some(rows) => {
                let count = rows.len();
                let rows: Vec<i64> = rows.into_iter().map(|i| i as i64).collect();
                Rows::Some(Tensor::from_data(TensorData::new(rows, [count]), device), count)
            }
        }
    }
    /// How many of `n` Gaussians these are.
    pub fn count(&self, n: usize) -> usize {
        match self {
            Rows::All => n,
            Rows::Some(_, count) => *count,
        }
    }
    /// The rows of `values` [N,C].
    pub fn select(&self, values: Tensor<2>) -> Tensor<2> {
        match self {
            Rows::All => values,
            Rows::Some(rows, _) => values.select(0, rows.clone()),
        }
    }
    /// The index tensor, `None` for all.
    pub fn tensor(&self) -> Option<&Tensor<1, Int>> {
        match self {
            Rows::All => None,
            Rows::Some(rows, _) => Some(rows),
        }
    }
}

/// The state between two iterations.
pub struct TrainState {
    /// Stage under way.
    pub stage: Stage,
    /// Iterations of the stage that are done.
    pub iteration: usize,
    /// The Gaussians with their moments.
    pub set: GaussianSet,
    /// Densification statistics.
    pub stats: ScreenStats,
    /// What may move.
    pub moving: Moving,
    /// The field and its moments, from the main stage on.
    pub field: Option<FieldOptimizer>,
    /// Whether smoothness was switched on.
    pub smooth: bool,
    rows: Option<Rows>,
}

impl TrainState {
    /// A fresh run.
    pub fn new(host: &HostGaussians, moving: Moving, device: &Device) -> Self {
        let set = GaussianSet::new(host, device);
        let stats = ScreenStats::zeros(&set);
        Self { stage: Stage::Coarse, iteration: 0, set, stats, moving, field: None, smooth: false, rows: None }
    }
    /// A run from stored parts.
    pub fn restored(stage: Stage, iteration: usize, set: GaussianSet, stats: ScreenStats, moving: Moving, field: Option<FieldOptimizer>, smooth: bool) -> Self {
        Self { stage, iteration, set, stats, moving, field, smooth, rows: None }
    }
    /// New optimisers and statistics, as every stage starts with (baselines §2.3).
    pub fn begin_stage(&mut self) {
        self.set.step = 0;
        for column in &mut self.set.columns {
            column.first_moment = column.first_moment.zeros_like();
            column.second_moment = column.second_moment.zeros_like();
        }
        self.stats = ScreenStats::zeros(&self.set);
    }
    /// The rows the field moves; kept until the set changes.
    pub fn moving_rows(&mut self, device: &Device) -> Result<Rows> {
        if let Some(rows) = &self.rows {
            return Ok(rows.clone());
        }
        let rows = match self.moving {
            Moving::Scored { .. } => self.moving.rows(&to_vec(self.set.columns[6].value.clone(), "dynamic_scores")?),
            other => other.rows(&[]),
        };
        let rows = Rows::new(rows, device);
        self.rows = Some(rows.clone());
        Ok(rows)
    }
    /// To be called whenever Gaussians or scores changed.
    pub fn invalidate_rows(&mut self) {
        self.rows = None;
    }
    /// The box of what moves: per-axis 0.1 to 99.9 percentile of the centres, padded by 5 % (baselines §10, row 3).
    pub fn field_context(&mut self, frame_count: usize, seed: Seed) -> Result<DeformerContext> {
        let host = self.set.host_gaussians()?;
        let mut rows = self.moving.rows(&host.dynamic_scores).unwrap_or_default();
        if rows.is_empty() {
            rows = (0..host.len()).collect();
        }
        let (mut box_min, mut box_max) = ([0.0f32; 3], [0.0f32; 3]);
        for k in 0..3 {
            let mut values: Vec<f32> = rows.iter().map(|&i| host.means[3 * i + k]).collect();
            values.sort_unstable_by(f32::total_cmp);
            let pick = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
            let (low, high) = (pick(0.001), pick(0.999));
            // A flat axis still needs a width to be normalised by.
            let pad = (0.05 * (high - low)).max(1e-4 * (1.0 + low.abs().max(high.abs())));
            (box_min[k], box_max[k]) = (low - pad, high + pad);
        }
        Ok(DeformerContext { box_min, box_max, frame_count, sh_degree: self.set.sh_degree, seed })
    }
}
