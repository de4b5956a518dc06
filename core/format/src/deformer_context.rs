//! What a deformation field is told of its scene.

use crate::Seed;
use serde::{Deserialize, Serialize};

/// What a field must know of its scene before its weights mean anything. Stored in checkpoints and archives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeformerContext {
    /// Lower corner of the box the field covers, world units.
    pub box_min: [f32; 3],
    /// Upper corner of the box the field covers, world units.
    pub box_max: [f32; 3],
    /// The number of frames of the sequence (sets temporal bandwidth).
    pub frame_count: usize,
    /// Spherical-harmonics degree of the Gaussians it will move.
    pub sh_degree: usize,
    /// The field's own node of the seed tree.
    pub seed: Seed,
}
