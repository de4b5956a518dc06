//! The context of a codec: everything but the Gaussians or weights.

use crate::{Camera, EventSink, HostGaussians, Image8, Limits, Result, Seed, Stream, TuneModel, WeightArray};

/// The context of a codec. The optional parts are set if a model is encoded together with its scene, some of them also if it is encoded with views round it. A
/// codec may use them for a better result, but must work without them. They are never set for decoding.
pub struct CodecContext<'a> {
    /// The codec's node of the seed tree.
    pub seed: Seed,
    /// Limits on what a decoder accepts.
    pub limits: Limits,
    /// Receives progress and warnings.
    pub events: &'a dyn EventSink,
    /// The views that the model is measured in: those that it was trained on, or where its scene is not there, views round it, which have no images.
    pub views: Option<&'a dyn TrainingViews>,
    /// The views that judge what is lost, where they are stated: see [`CodecContext::judging_views`].
    pub judges: Option<&'a dyn TrainingViews>,
    /// Renders the model with other Gaussians.
    pub renderer: Option<&'a dyn RenderModel>,
    /// The deformer of the model; `None` for static models.
    pub deformer: Option<&'a dyn EvaluateDeformer>,
    /// For a weight codec: how much images depend on each weight of each array in turn, the mean over views of the sum over pixels of the squared derivative.
    pub weight_importance: Option<&'a [Vec<f32>]>,
    /// Trains the model further with rounded values.
    pub tuner: Option<&'a dyn TuneModel>,
    /// A Gaussian may move if and only if its dynamic score is above this: minus infinity if all may, infinity if none does. `None` if that is not known.
    pub dynamic_threshold: Option<f32>,
    /// Measures the file that the encoded Gaussians will be in, for codecs whose user bounds its size.
    pub file_bytes: Option<&'a FileBytes<'a>>,
}

/// The bytes of the whole file that has these streams of Gaussians: header and weights of the deformer included. The weights are those of the model as they are
/// stored, or others, in steps so many times larger ([`TuneModel::encoded_weights`]).
pub type FileBytes<'a> = dyn Fn(&[Stream], Option<(&[WeightArray], f64)>) -> Result<u64> + 'a;

impl<'a> CodecContext<'a> {
    /// A context without scene, renderer and deformer, as for decoding.
    pub fn new(seed: Seed, limits: Limits, events: &'a dyn EventSink) -> Self {
        Self {
            seed,
            limits,
            events,
            views: None,
            judges: None,
            renderer: None,
            deformer: None,
            weight_importance: None,
            tuner: None,
            dynamic_threshold: None,
            file_bytes: None,
        }
    }
    /// The views on which a loss of PSNR is measured: validation views where the scene has some, else those that the model is measured in. `None` where there
    /// are no views. A loss is measured against recorded images, which not all views have ([`TrainingViews::has_images`]).
    pub fn judging_views(&self) -> Option<&'a dyn TrainingViews> {
        self.judges.into_iter().chain(self.views).find(|views| !views.is_empty())
    }
}

/// The views that a model is measured in: the training views of its scene, the validation views where those judge, or views round a model whose scene is not
/// there. In their order, every so many are of all cameras, or from all sides. Images are decoded on demand. Test views are not included.
pub trait TrainingViews {
    /// The number of views.
    fn len(&self) -> usize;
    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// What they are called in messages: `training`, `validation` or `orbit`.
    fn kind(&self) -> &'static str {
        "training"
    }
    /// Whether images were recorded there. The views of an orbit have none: [`TrainingViews::image`] is an error there.
    fn has_images(&self) -> bool {
        true
    }
    /// Camera and time (0..1) of the view `index`, which must be below [`TrainingViews::len`].
    fn view(&self, index: usize) -> (&Camera, f32);
    /// The recorded image of the view `index`, at the size of its camera; an error where none was recorded.
    fn image(&self, index: usize) -> Result<Image8>;
}

/// Renders a model with other canonical Gaussians; its deformer, rasterizer, rules and background are fixed.
pub trait RenderModel {
    /// Renders `gaussians`, deformed to `time_norm` (0..1), with `camera`. `gaussians` must have the extra attributes that the deformer reads.
    fn render(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32) -> Result<RenderedPlanes>;
    /// Renders `gaussians` in `views`, each a camera and a time (0..1), and calls `take` with the index and the image of each in turn. The images are those of
    /// [`RenderModel::render`]; what views share need not be computed for each.
    ///
    /// # Errors
    /// What the renderer reports, and the first error of `take`.
    fn render_views(&self, gaussians: &HostGaussians, views: &[(&Camera, f32)], take: &mut dyn FnMut(usize, RenderedPlanes) -> Result<()>) -> Result<()> {
        views.iter().enumerate().try_for_each(|(index, &(camera, time_norm))| take(index, self.render(gaussians, camera, time_norm)?))
    }
    /// [`RenderModel::render_views`] of `gaussians` that are not needed any more, so that a renderer need not copy them.
    ///
    /// # Errors
    /// As [`RenderModel::render_views`].
    fn render_views_once(&self, gaussians: HostGaussians, views: &[(&Camera, f32)], take: &mut dyn FnMut(usize, RenderedPlanes) -> Result<()>) -> Result<()> {
        self.render_views(&gaussians, views, take)
    }
    /// The colour behind everything, RGB in 0..1.
    fn background(&self) -> [f32; 3];
    /// An unbiased estimate, for every value of every column, of the sum over pixels and channels of the squared derivative of the image by that value as it is
    /// drawn, that is, after deformation. The estimate is the square of the derivative of a sum with signs drawn from `seed` (Hutchinson 1989); averages over
    /// views or Gaussians are accurate. `None` if the renderer has no derivatives.
    fn squared_derivatives(&self, gaussians: &HostGaussians, camera: &Camera, time_norm: f32, seed: Seed) -> Result<Option<HostGaussians>> {
        let _ = (gaussians, camera, time_norm, seed);
        Ok(None)
    }
    /// [`RenderModel::squared_derivatives`] of `gaussians` in each of `views`, which are cameras and times (0..1), with the seeds `seed.index(0)`,
    /// `seed.index(1)` and so on; what views share need not be computed for each. `take` is called with the index of each view in turn, the estimate, and the
    /// centres `[N,3]` as they are drawn, where the renderer tells them. Whether it has derivatives.
    ///
    /// # Errors
    /// What the renderer reports, and the first error of `take`.
    fn squared_derivatives_in_views(
        &self,
        gaussians: &HostGaussians,
        views: &[(&Camera, f32)],
        seed: Seed,
        take: &mut dyn FnMut(usize, HostGaussians, Option<Vec<f32>>) -> Result<()>,
    ) -> Result<bool> {
        for (index, &(camera, time_norm)) in views.iter().enumerate() {
            let Some(found) = self.squared_derivatives(gaussians, camera, time_norm, seed.index(index as u64))? else { return Ok(false) };
            take(index, found, None)?;
        }
        Ok(true)
    }
}

/// Mean PSNR in dB of `gaussians`, rendered, against the recorded images of at most `most` views, which are evenly spaced. Rendered values are clamped to 0..1
/// and not rounded. 0 without views.
///
/// # Errors
/// What the renderer and the images report.
pub fn psnr_on_views(gaussians: &HostGaussians, views: &dyn TrainingViews, renderer: &dyn RenderModel, most: usize) -> Result<f64> {
    let chosen = views.len().min(most);
    let index = |k: usize| k * views.len() / chosen;
    let cameras: Vec<(&Camera, f32)> = (0..chosen).map(|k| views.view(index(k))).collect();
    let mut sum = 0.0;
    renderer.render_views(gaussians, &cameras, &mut |k, drawn| {
        let truth = views.image(index(k))?.to_planes(renderer.background());
        sum += drawn.psnr(&truth);
        Ok(())
    })?;
    Ok(sum / chosen.max(1) as f64)
}

/// PSNR in dB of a mean squared error, 120 at most; of one that is not a number, minus infinity.
pub fn psnr_of(mean_squared_error: f64) -> f64 {
    if mean_squared_error.is_nan() { f64::NEG_INFINITY } else { -10.0 * libm::log10(mean_squared_error.max(1e-12)) }
}

/// A deformer as a function from canonical Gaussians to deformed ones.
pub trait EvaluateDeformer {
    /// `gaussians` deformed to `time_norm` (0..1), in the same order. Those whose score is not above the dynamic threshold stay unchanged.
    fn deform(&self, gaussians: &HostGaussians, time_norm: f32) -> Result<HostGaussians>;
}

/// A rendered view in host memory.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedPlanes {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Planes `[5,H,W]`: red, green, blue (background included), alpha, depth (sum of weight times z, world units).
    pub planes: Vec<f32>,
}

impl RenderedPlanes {
    /// PSNR in dB of the colours, clamped to 0..1, against the planes `truth` `[3,H,W]`.
    pub fn psnr(&self, truth: &[f32]) -> f64 {
        let error: f64 = truth.iter().zip(&self.planes).map(|(a, b)| f64::from(a - b.clamp(0.0, 1.0)).powi(2)).sum();
        psnr_of(error / truth.len().max(1) as f64)
    }
    /// The RGB planes as an 8-bit image; values are clamped to 0..1.
    pub fn to_image(&self) -> Image8 {
        Image8::from_planes(&self.planes, self.width, self.height)
    }
}
