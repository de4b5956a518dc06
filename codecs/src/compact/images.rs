//! Differences between images of original and changed Gaussians, and between rendered and recorded images.

use cc4dgs_format::{Camera, HostGaussians, RenderModel, Result, TrainingViews};

/// Some evenly spaced views, and the images that were recorded there: a search compares many models with them.
pub struct Recorded<'a> {
    views: Vec<(&'a Camera, f32)>,
    renderer: &'a dyn RenderModel,
    /// Colours `[3,H,W]` of each view.
    truths: Vec<Vec<f32>>,
    /// The name of the views in messages.
    pub kind: &'static str,
}

impl<'a> Recorded<'a> {
    /// The images of `chosen` of the views; there must be as many.
    pub fn of(views: &'a dyn TrainingViews, renderer: &'a dyn RenderModel, chosen: usize) -> Result<Self> {
        let index = |k: usize| k * views.len() / chosen;
        let truths = (0..chosen).map(|k| Ok(views.image(index(k))?.to_planes(renderer.background()))).collect::<Result<Vec<_>>>()?;
        Ok(Self { views: (0..chosen).map(|k| views.view(index(k))).collect(), renderer, truths, kind: views.kind() })
    }
    /// The number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }
    /// The mean PSNR of `gaussians` in dB ([`cc4dgs_format::psnr_on_views`]).
    pub fn psnr(&self, gaussians: HostGaussians) -> Result<f64> {
        let mut sum = 0.0;
        self.renderer.render_views_once(gaussians, &self.views, &mut |k, drawn| {
            sum += drawn.psnr(&self.truths[k]);
            Ok(())
        })?;
        Ok(sum / self.views.len().max(1) as f64)
    }
}

/// Some evenly spaced views, and the images of the original Gaussians in them.
pub struct Images<'a> {
    views: Vec<(&'a Camera, f32)>,
    renderer: &'a dyn RenderModel,
    /// Colours `[3,H,W]` of each view.
    originals: Vec<Vec<f32>>,
}

impl<'a> Images<'a> {
    /// Draws `gaussians` in `chosen` of the views.
    pub fn of(gaussians: &HostGaussians, views: &'a dyn TrainingViews, renderer: &'a dyn RenderModel, chosen: usize) -> Result<Self> {
        let views: Vec<(&Camera, f32)> = (0..chosen).map(|k| views.view(k * views.len() / chosen)).collect();
        let mut originals = Vec::with_capacity(chosen);
        renderer.render_views(gaussians, &views, &mut |_, drawn| {
            let mut planes = drawn.planes;
            planes.truncate(3 * drawn.width as usize * drawn.height as usize);
            planes.shrink_to_fit();
            originals.push(planes);
            Ok(())
        })?;
        Ok(Self { views, renderer, originals })
    }
    /// The number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }
    /// The sum over views, pixels and channels of the squared errors of `changed`.
    pub fn error(&self, changed: HostGaussians) -> Result<f64> {
        self.error_of(changed, |v| v)
    }
    /// [`Images::error`] after the map `shown` of colours.
    fn error_of(&self, changed: HostGaussians, shown: impl Fn(f32) -> f32) -> Result<f64> {
        let mut error = 0.0;
        self.renderer.render_views_once(changed, &self.views, &mut |k, drawn| {
            error += self.originals[k].iter().zip(&drawn.planes).map(|(a, b)| f64::from(shown(*a) - shown(*b)).powi(2)).sum::<f64>();
            Ok(())
        })?;
        Ok(error)
    }
    /// Whether no view shows anything but `background`: no pixel differs by half of an 8-bit step.
    pub fn show_nothing(&self, background: [f32; 3]) -> bool {
        let is_plain = |planes: &Vec<f32>| {
            planes.chunks_exact((planes.len() / 3).max(1)).zip(background).all(|(plane, of)| plane.iter().all(|v| (v - of).abs() < 0.5 / 255.0))
        };
        self.originals.iter().all(is_plain)
    }
    /// The mean over views, pixels and channels of the squared errors of `changed`, with colours as screens show them, in 0..1; infinite where one is not a
    /// number.
    pub fn mean_squared_error(&self, changed: HostGaussians) -> Result<f64> {
        let samples: usize = self.originals.iter().map(Vec::len).sum();
        let error = self.error_of(changed, |v| v.clamp(0.0, 1.0))? / samples.max(1) as f64;
        Ok(if error.is_nan() { f64::INFINITY } else { error })
    }
}
