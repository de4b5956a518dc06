//! Pose models: corrections of the poses of training cameras.

use crate::Plugin;
use crate::{Camera, Parameter, ParameterGroup, Result, Seed};
use burn::tensor::{Device, Tensor};

/// The properties of a scene that a pose model is built for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosesContext {
    /// Number of training cameras; a moving camera counts once per pose.
    pub cameras: usize,
    /// Extent of the training cameras in units of the scene ([`Scene::extent`](crate::Scene::extent)).
    pub extent: f64,
    /// The model's node of the seed tree.
    pub seed: Seed,
}

/// A camera whose pose was corrected.
#[derive(Clone, Debug)]
pub struct Posed {
    /// The camera with the corrected [`Camera::world_to_camera`], which is rigid again; the rest is as it was.
    pub camera: Camera,
    /// A tensor `[4,4]` whose values do not count. The rasterizer hands it d loss / d world_to_camera ([`Splats::camera_probe`](crate::Splats::camera_probe)),
    /// and it hands that on to the weights.
    pub probe: Tensor<2>,
}

/// Corrects the poses of training cameras. Used in training only: held-out cameras and playback have the poses of the dataset. So a model must not be able to
/// turn or move all cameras together, which would move what the run learns away from them.
pub trait Poses: Send {
    /// Training camera `index` (0-based), which the dataset gives as `camera`; `None` where its pose stays as it is.
    ///
    /// # Errors
    /// [`Error::Parameter`](crate::Error::Parameter) for an index that does not exist, and what the device reports.
    fn corrected(&self, camera: &Camera, index: usize) -> Result<Option<Posed>>;
    /// The weights, in a fixed order.
    fn parameters(&self) -> Vec<&Parameter> {
        Vec::new()
    }
    /// The weights for the optimizer and for loading, in the same order.
    fn parameters_mut(&mut self) -> Vec<&mut Parameter> {
        Vec::new()
    }
    /// The optimizer groups that [`Parameter::group`] points into.
    fn groups(&self) -> Vec<ParameterGroup> {
        Vec::new()
    }
    /// An additional loss term `[1]`.
    fn regularizer(&self) -> Result<Option<Tensor<1>>> {
        Ok(None)
    }
    /// What was corrected, in a sentence for the log; `None` where there is nothing to say.
    fn summary(&self) -> Result<Option<String>> {
        Ok(None)
    }
}

/// A pose model in the registry.
pub struct PosesPlugin {
    /// Name, version and other facts.
    pub info: Plugin,
    /// Builds the model from the `[poses]` section without `kind`; unknown keys are errors.
    pub build: fn(&toml::Table, &PosesContext, &Device) -> Result<Box<dyn Poses>>,
}
cc4dgs_format::plugin_kind!(PosesPlugin, "poses");
