//! The output of a reader.

use super::lens::Distortion;
use super::pose::Matrix4;
use crate::{Camera, Error, FrameSource, Result, Split};
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// Largest distance of a camera from the origin, in the dataset's units: squares of distances must fit f32.
const FARTHEST: f64 = 1e12;

/// A calibrated camera with lens distortion, at the image size of its calibration.
#[derive(Clone, Debug)]
pub struct RawCamera {
    /// Name as the dataset has it.
    pub name: String,
    /// Image size of the calibration: width and height in pixels.
    pub size: [u32; 2],
    /// Focal lengths in pixels.
    pub focal: [f64; 2],
    /// Principal point in pixels; the centre of the first pixel is at 0.5.
    pub principal: [f64; 2],
    /// Lens distortion.
    pub distortion: Distortion,
    /// Rigid transform of world points to camera points, OpenCV axes (x right, y down, z forward), row-major.
    pub world_to_camera: Matrix4,
}

impl RawCamera {
    /// The same camera without lens distortion.
    pub fn pinhole(&self) -> Camera {
        Camera {
            name: self.name.clone(),
            width: self.size[0],
            height: self.size[1],
            fx: self.focal[0],
            fy: self.focal[1],
            cx: self.principal[0],
            cy: self.principal[1],
            world_to_camera: self.world_to_camera,
        }
    }
}

/// A file of recorded depth, which [`files::read_depth`](super::files::read_depth) reads.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthFile {
    /// A PNG of 16-bit grey values; 0 where the depth is unknown.
    pub path: PathBuf,
    /// Units of the dataset per step of the grey values.
    pub unit: f64,
}

/// The source of a view's image.
#[derive(Clone)]
pub enum ImageSource {
    /// A PNG or JPEG file, and a foreground mask of the same size and recorded depth if there are some.
    File {
        /// The image.
        path: PathBuf,
        /// White is foreground. The file may be missing.
        mask: Option<PathBuf>,
        /// Its depth, of the proportions of the image.
        depth: Option<DepthFile>,
    },
    /// A frame of a video, decoded by `ffmpeg` and turned as the file's display matrix says.
    Video {
        /// The video.
        path: PathBuf,
        /// Frame of the video in order of presentation, 0-based.
        frame: usize,
    },
    /// Any other source: computed images, another container, a network.
    Frames {
        /// Loads images of the size of their [`RawCamera`], not undistorted.
        source: Arc<dyn FrameSource>,
        /// Index of the image in `source`.
        index: usize,
    },
}

impl ImageSource {
    /// A PNG or JPEG file without mask and depth.
    pub fn file(path: impl Into<PathBuf>) -> Self {
        Self::File { path: path.into(), mask: None, depth: None }
    }
}

impl fmt::Debug for ImageSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, mask, depth } => f.debug_struct("File").field("path", path).field("mask", mask).field("depth", depth).finish(),
            Self::Video { path, frame } => f.debug_struct("Video").field("path", path).field("frame", frame).finish(),
            Self::Frames { index, .. } => f.debug_struct("Frames").field("index", index).finish_non_exhaustive(),
        }
    }
}

/// One image of one camera.
#[derive(Clone, Debug)]
pub struct RawView {
    /// Index into the cameras.
    pub camera: usize,
    /// Frame index in the dataset, 0-based.
    pub frame: usize,
    /// The dataset's own time, 0..1; views without one get frame index / (number of frames - 1): 0 at the first frame, 1 at the last.
    pub time: Option<f64>,
    /// The dataset's own split.
    pub split: Split,
    /// Its image.
    pub image: ImageSource,
}

/// Points of a dataset, as computed by structure from motion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawPoints {
    /// Positions in the dataset's units.
    pub positions: Vec<[f64; 3]>,
    /// Colours in 0..1, one per position.
    pub colors: Vec<[f32; 3]>,
}

/// The region of random initial Gaussians, for scenes without points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum InitBox {
    /// A box in the dataset's units.
    Corners {
        /// Lower corner.
        low: [f64; 3],
        /// Upper corner.
        high: [f64; 3],
    },
    /// A cube around the point that the cameras look at.
    Cube {
        /// Half the side over the median distance of the cameras from that point.
        half_share: f64,
    },
}

/// A parsed dataset.
#[derive(Clone, Debug, Default)]
pub struct RawScene {
    /// Display name.
    pub name: String,
    /// All cameras; a moving camera is one entry per pose.
    pub cameras: Vec<RawCamera>,
    /// All views, in any order.
    pub views: Vec<RawView>,
    /// Initial points, if the dataset has any.
    pub points: Option<RawPoints>,
    /// The location of the scene, if the format states it. Otherwise it is estimated from the cameras.
    pub init_box: Option<InitBox>,
    /// Background of the dataset's RGBA images, RGB in 0..1.
    pub background: Option<[f32; 3]>,
    /// Whether the reader has already applied `scene.width`, `scene.height` and `scene.downscale`, as readers that compute images can.
    pub resized: bool,
    /// Warnings about data that was ignored.
    pub warnings: Vec<String>,
}

/// How the warning of [`RawScene::rank_times`] about times that are all equal begins.
pub const SAME_TIME: &str = "all images state the same time";

/// Difference up to which times are one instant, as a share of the whole time.
const SAME_INSTANT: f64 = 1e-6;

impl RawScene {
    /// Sets frame and time of each view from the dataset's times, one per view: the frame is the rank among the distinct times; if times exceed 1,
    /// all are divided by the largest. `object` names the file in errors.
    ///
    /// # Errors
    /// [`Error::Data`] for times that are negative or not finite.
    pub fn rank_times(&mut self, times: &[Option<f64>], object: &str) -> Result<()> {
        if let Some(t) = times.iter().flatten().find(|t| !t.is_finite() || **t < 0.0) {
            return Err(Error::data(object, format!("time {t} is negative or not finite"), "Correct the times in the file"));
        }
        if let [Some(first), rest @ ..] = times
            && !rest.is_empty()
            && rest.iter().all(|t| t.is_some_and(|t| t == *first))
        {
            self.warnings.push(format!("{SAME_TIME}, {first}: the scene is taken for a static one"));
        }
        let largest = times.iter().flatten().fold(1.0f64, |a, &t| a.max(t));
        let mut distinct: Vec<f64> = times.iter().map(|t| t.unwrap_or(0.0)).collect();
        distinct.sort_by(f64::total_cmp);
        // Times that differ by rounding are one.
        let near = SAME_INSTANT * (distinct.last().copied().unwrap_or(0.0) - distinct.first().copied().unwrap_or(0.0));
        distinct.dedup_by(|later, kept| *later - *kept <= near);
        for (view, time) in self.views.iter_mut().zip(times) {
            let t = time.unwrap_or(0.0);
            view.frame = distinct.partition_point(|&d| d <= t).saturating_sub(1);
            view.time = Some(t / largest);
        }
        Ok(())
    }

    /// Refuses views of cameras that do not exist, times outside 0..1, cameras with views that are not rigid, not finite or too far away, and
    /// invalid points or backgrounds.
    ///
    /// # Errors
    /// [`Error::Data`].
    pub fn validate(&self) -> Result<()> {
        let bad = |problem: String| Err(Error::data(&self.name, problem, "Check the dataset's index files"));
        let mut used = vec![false; self.cameras.len()];
        for view in &self.views {
            match used.get_mut(view.camera) {
                Some(slot) => *slot = true,
                None => return bad(format!("a view refers to camera {} of {}", view.camera, self.cameras.len())),
            }
            if let Some(t) = view.time.filter(|t| !(0.0..=1.0).contains(t)) {
                return bad(format!("a view of frame {} is at time {t}, outside 0..1", view.frame));
            }
        }
        for camera in self.cameras.iter().zip(&used).filter(|(_, used)| **used).map(|(camera, _)| camera) {
            let pinhole = camera.pinhole();
            pinhole.validate()?;
            let center = pinhole.center_world();
            if center.iter().any(|v| v.abs() > FARTHEST) {
                return Err(Error::data(
                    format!("camera {}", camera.name),
                    format!("its centre {center:?} is over {FARTHEST:e} units away"),
                    "Check the dataset's calibration file",
                ));
            }
        }
        if let Some(points) = &self.points {
            if points.positions.len() != points.colors.len() {
                return bad(format!("{} points have {} colours", points.positions.len(), points.colors.len()));
            }
            if let Some(p) = points.positions.iter().find(|p| p.iter().any(|v| !(*v as f32).is_finite())) {
                return bad(format!("a point is at {p:?}"));
            }
        }
        if let Some(c) = self.background.filter(|c| !c.iter().all(|v| (0.0..=1.0).contains(v))) {
            return bad(format!("its background {c:?} is outside 0..1"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_that_differ_by_rounding_are_one_instant() {
        let view = || RawView { camera: 0, frame: 0, time: None, split: Split::Train, image: ImageSource::file("x.png") };
        let frames = |times: &[f64]| {
            let mut scene = RawScene { views: times.iter().map(|_| view()).collect(), ..Default::default() };
            scene.rank_times(&times.iter().map(|t| Some(*t)).collect::<Vec<_>>(), "t").unwrap();
            scene.views.iter().map(|v| v.frame).collect::<Vec<_>>()
        };
        assert_eq!(frames(&[0.1 + 0.2, 0.3, 0.0, 1.0, 0.3 - 1e-12]), [1, 1, 0, 2, 1]);
        assert_eq!(frames(&[1.7e9 + 0.04, 1.7e9, 1.7e9 + 0.08]), [1, 0, 2], "seconds since 1970");
        assert_eq!(frames(&[0.5, 0.5]), [0, 0]);
        assert_eq!(frames(&[0.0, 1.0 / 149.0, 2.0 / 149.0]), [0, 1, 2]);
    }
}
