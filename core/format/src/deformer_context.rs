//! What a deformer knows of its scene.

use crate::{Error, Result, Seed};
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

impl DeformerContext {
    /// Refuses boxes that are not finite and degrees above 4, before a deformer allocates memory for them; `object` names the file in errors.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn validate(&self, object: &str) -> Result<()> {
        let problem = match self.box_min.iter().chain(&self.box_max).find(|v| !v.is_finite()) {
            Some(v) => format!("a corner of its deformer's box is {v}"),
            None if self.sh_degree > 4 => format!("the spherical-harmonics degree {} of its deformer is over 4", self.sh_degree),
            None => return Ok(()),
        };
        Err(Error::data(object, problem, "The file is damaged; fetch or write it again"))
    }
}
