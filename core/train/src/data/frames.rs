//! The images of a scene and their depth: load, undo distortion, resize.

use super::resample::resize;
use super::undistort::Undistort;
use super::video::VideoFrames;
use cc4dgs_core::reader::files::{read_depth, read_png_or_jpeg};
use cc4dgs_core::{DepthImage, Error, FrameSource, Image8, ImageSource, Limits, Result};

/// What happens to every image of one camera.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    /// Size the images must have.
    pub native: [u32; 2],
    /// Lens to undo.
    pub undistort: Option<Undistort>,
    /// Size of the result.
    pub output: (u32, u32),
}

/// One image to load.
pub(super) struct Job {
    /// Where it comes from; `None` where the dataset has none (a view without a mask).
    pub image: Option<ImageSource>,
    /// Index of its camera's plan.
    pub plan: usize,
}

/// A [`FrameSource`] over the images of a dataset.
pub(super) struct SceneFrames {
    pub jobs: Vec<Job>,
    pub plans: Vec<Plan>,
    pub videos: VideoFrames,
    pub limits: Limits,
    /// Units of the scene per unit of the dataset, for depth.
    pub scale: f64,
}

impl SceneFrames {
    fn job(&self, view: usize) -> Result<&Job> {
        let missing = || Error::parameter(format!("view {view}"), format!("the scene has {} views", self.jobs.len()), "Ask for a view that exists");
        self.jobs.get(view).ok_or_else(missing)
    }
}

/// `image`, called `name` in errors, without the lens and at its final size. Refuses one that has not the size `expected`.
fn fitted(image: &Image8, name: &str, expected: [u32; 2], plan: &Plan) -> Result<Image8> {
    if [image.width, image.height] != expected {
        return Err(Error::data(
            name,
            format!("{}x{} pixels where {}x{} are expected", image.width, image.height, expected[0], expected[1]),
            "All images of a camera must have one size; remove or replace this one",
        ));
    }
    image.validate(name)?;
    let undistorted = plan.undistort.as_ref().map(|undistort| undistort.apply(image));
    Ok(resize(undistorted.as_ref().unwrap_or(image), plan.output.0, plan.output.1))
}

/// `depth`, called `name` in errors, without the lens, at the final size of the images and `scale` times as deep. Refuses one of other proportions than theirs.
fn fitted_depth(depth: &DepthImage, name: &str, plan: &Plan, scale: f64) -> Result<DepthImage> {
    depth.validate_for(name, plan.native)?;
    let [w, h] = plan.native.map(f64::from);
    let kept = plan.undistort.as_ref().map_or(plan.native, |undistort| undistort.size).map(f64::from);
    let (x, y) = (kept[0] / f64::from(plan.output.0), kept[1] / f64::from(plan.output.1));
    let mut fitted = depth.resampled(plan.output.0, plan.output.1, |u, v| {
        let (u, v) = (u * x, v * y);
        let (u, v) = plan.undistort.as_ref().map_or((u, v), |undistort| undistort.source(u, v));
        (u / w, v / h)
    });
    fitted.values.iter_mut().for_each(|z| *z = (f64::from(*z) * scale) as f32);
    fitted.validate(name)?;
    Ok(fitted)
}

impl FrameSource for SceneFrames {
    fn load(&self, view: usize) -> Result<Image8> {
        let object = || format!("view {view}");
        let job = self.job(view)?;
        let plan = &self.plans[job.plan];
        let (name, image, expected) = match &job.image {
            Some(ImageSource::File { path, .. }) => (path.display().to_string(), read_png_or_jpeg(path, &self.limits)?, plan.native),
            Some(ImageSource::Video { path, frame }) => {
                let file = self.videos.extract(path, *frame)?;
                (file.display().to_string(), read_png_or_jpeg(&file, &self.limits)?, self.videos.size(plan))
            }
            Some(ImageSource::Frames { source, index }) => (object(), source.load(*index)?, plan.native),
            None => return Err(Error::unsupported(object(), "the dataset has no image of this kind for it", "Use another view")),
        };
        fitted(&image, &name, expected, plan)
    }
    fn motion_mask(&self, view: usize) -> Result<Option<Image8>> {
        let job = self.job(view)?;
        let Some(ImageSource::Frames { source, index }) = &job.image else { return Ok(None) };
        let plan = &self.plans[job.plan];
        source.motion_mask(*index)?.map(|mask| fitted(&mask, &format!("motion mask of view {view}"), plan.native, plan)).transpose()
    }
    fn depth(&self, view: usize) -> Result<Option<DepthImage>> {
        let job = self.job(view)?;
        let (name, depth) = match &job.image {
            Some(ImageSource::File { depth: Some(file), .. }) => (file.path.display().to_string(), Some(read_depth(&file.path, file.unit, &self.limits)?)),
            Some(ImageSource::Frames { source, index }) => (format!("depth of view {view}"), source.depth(*index)?),
            _ => return Ok(None),
        };
        depth.map(|depth| fitted_depth(&depth, &name, &self.plans[job.plan], self.scale)).transpose()
    }
}
