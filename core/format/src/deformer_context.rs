//! What a deformer knows of its scene.

use crate::Seed;
use serde::{Deserialize, Serialize};

/// The properties of a scene that define the meaning of a deformer's weights. Stored in checkpoints and archives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DeformerContext {
    /// Lower corner of the deformer's bounding box, world units.
    pub box_min: [f32; 3],
    /// Upper corner of the deformer's bounding box, world units.
    pub box_max: [f32; 3],
    /// Number of frames of the sequence; it sets the temporal bandwidth.
    pub frame_count: usize,
    /// Spherical-harmonics degree of the Gaussians.
    pub sh_degree: usize,
    /// The deformer's node of the seed tree.
    pub seed: Seed,
}
