//! Frames from files: decode, undo distortion, resize.

use super::distortion::Undistort;
use super::files::read_png_or_jpeg;
use super::raw::Picture;
use super::resample::resize;
use super::video::VideoFrames;
use cc4dgs_core::{Error, FrameSource, Image8, Limits, Result};

/// What happens to every picture of one camera.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    /// Size the pictures must have.
    pub native: [u32; 2],
    /// Lens to undo.
    pub undistort: Option<Undistort>,
    /// Size of the result.
    pub output: (u32, u32),
}

/// One picture to load.
pub(crate) struct Job {
    /// Its source.
    pub picture: Picture,
    /// Index of its camera's plan.
    pub plan: usize,
}

/// A [`FrameSource`] over picture files and videos.
pub(crate) struct FileFrames {
    pub jobs: Vec<Job>,
    pub plans: Vec<Plan>,
    pub videos: VideoFrames,
    pub limits: Limits,
}

impl FrameSource for FileFrames {
    fn load(&self, view: usize) -> Result<Image8> {
        let object = || format!("view {view}");
        let Some(job) = self.jobs.get(view) else {
            return Err(Error::parameter(object(), format!("the scene has {} views", self.jobs.len()), "Ask for a view that exists"));
        };
        let plan = &self.plans[job.plan];
        let (path, expected) = match &job.picture {
            Picture::File { path, .. } => (path.clone(), plan.native),
            Picture::Video { path, frame } => (self.videos.extract(path, *frame)?, self.videos.size(plan)),
            Picture::Traced => return Err(Error::unsupported(object(), "the dataset has no picture of this kind for it", "Use another view")),
        };
        let image = read_png_or_jpeg(&path, &self.limits)?;
        if [image.width, image.height] != expected {
            return Err(Error::data(
                path.display().to_string(),
                format!("{}x{} pixels where {}x{} are expected", image.width, image.height, expected[0], expected[1]),
                "All pictures of a camera must have one size; remove or replace this one",
            ));
        }
        let image = match &plan.undistort {
            Some(undistort) => undistort.apply(&image),
            None => image,
        };
        Ok(resize(&image, plan.output.0, plan.output.1))
    }
}
