//! Which Gaussians move.

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
