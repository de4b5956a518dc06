//! What a codec is handed besides what it encodes.

use crate::{Camera, EventSink, HostGaussians, Image8, Limits, Result, Seed};

/// What a codec is handed besides the Gaussians or the weights. The optional parts are there when a model is compressed with its scene at hand; a codec that
/// can use them does better with them, and still works without. They are never there for decoding.
pub struct CodecContext<'a> {
    /// The codec's own node of the seed tree.
    pub seed: Seed,
    /// What a decoder may believe.
    pub limits: Limits,
    /// Where progress goes.
    pub events: &'a dyn EventSink,
    /// The views that the model was trained on.
    pub views: Option<&'a dyn TrainingViews>,
    /// Draws the model with Gaussians of the codec's choice.
    pub renderer: Option<&'a dyn RenderModel>,
    /// The deformation field of the model; absent for static models.
    pub deformer: Option<&'a dyn EvaluateDeformer>,
}

impl<'a> CodecContext<'a> {
    /// A context without scene, renderer and field, as decoders get it.
    pub fn new(seed: Seed, limits: Limits, events: &'a dyn EventSink) -> Self {
        Self { seed, limits, events, views: None, renderer: None, deformer: None }
    }
}

/// The training views of a scene: cameras and times at once, images on demand. Held-out views are not among them.
pub trait TrainingViews {
    /// The number of views.
    fn len(&self) -> usize;
    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Camera and time (0..1) of the view `index`, which must be under [`TrainingViews::len`].
    fn view(&self, index: usize) -> (&Camera, f32);
    /// The recorded image of the view `index`, at the size of its camera.
    fn image(&self, index: usize) -> Result<Image8>;
}

/// Draws a model: its deformation field, rasterizer, rules and background are fixed, its canonical Gaussians are given.
pub trait RenderModel {
    /// Draws `gaussians`, moved to `time_norm` (0..1), through `camera`. Extra attributes that the field reads must be there.
    fn render(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<RenderedPlanes>;
}

/// A deformation field as a function from Gaussians to moved Gaussians.
pub trait EvaluateDeformer {
    /// `gaussians` as the field moves them at `time_norm` (0..1); those below the dynamic threshold stay. The order is that of `gaussians`.
    fn deform(&self, gaussians: &HostGaussians, time_norm: f32) -> Result<HostGaussians>;
}

/// A rendered view in host memory.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedPlanes {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Planes [5,H,W]: red, green, blue (background included), alpha, depth (sum of weight times z, world units).
    pub planes: Vec<f32>,
}

impl RenderedPlanes {
    /// Red, green and blue as an 8-bit image.
    pub fn to_image(&self) -> Image8 {
        Image8::from_planes(&self.planes, self.width, self.height)
    }
}
