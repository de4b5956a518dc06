//! How much images change with the Gaussians that are drawn.

use cc4dgs_format::{Camera, HostGaussians, RenderModel, Result, TrainingViews};

/// Some evenly spaced views, and the images of the original Gaussians in them.
pub struct Images<'a> {
    views: Vec<(&'a Camera, f32)>,
    renderer: &'a dyn RenderModel,
    /// Colours `[3,H,W]` of each view, clamped to 0..1.
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
            planes.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
            originals.push(planes);
            Ok(())
        })?;
        Ok(Self { views, renderer, originals })
    }
    /// The number of views.
    pub fn len(&self) -> usize {
        self.views.len()
    }
    /// The sum over views, pixels and channels of the squared errors of `changed`, whose colours are clamped to 0..1.
    pub fn error(&self, changed: &HostGaussians) -> Result<f64> {
        let mut error = 0.0;
        self.renderer.render_views(changed, &self.views, &mut |k, drawn| {
            error += self.originals[k].iter().zip(&drawn.planes).map(|(a, b)| f64::from(a - b.clamp(0.0, 1.0)).powi(2)).sum::<f64>();
            Ok(())
        })?;
        Ok(error)
    }
    /// The mean over views, pixels and channels of the squared errors of `changed`; infinite where one is not a number.
    pub fn mean_squared_error(&self, changed: &HostGaussians) -> Result<f64> {
        let samples: usize = self.originals.iter().map(Vec::len).sum();
        let error = self.error(changed)? / samples.max(1) as f64;
        Ok(if error.is_nan() { f64::INFINITY } else { error })
    }
}
