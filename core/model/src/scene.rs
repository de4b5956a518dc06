//! A scene: cameras, times, and 8-bit frames that are decoded on demand.

use crate::frame_cache::{FrameCache, KeptFrames};
use crate::{Camera, DepthImage, Error, Image8, Result, Similarity};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// The part of the split that a view belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Used in training.
    Train,
    /// Kept out of training to choose settings by.
    Validation,
    /// Held out for the final score.
    Test,
}

impl Split {
    /// What its views are called: `training`, `validation` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train => "training",
            Self::Validation => "validation",
            Self::Test => "test",
        }
    }
}

/// One image of the scene: a camera at a time.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Index into [`Scene::cameras`].
    pub camera: usize,
    /// Frame index, 0-based.
    pub frame: usize,
    /// Time in 0..1.
    pub time_norm: f32,
    /// Train or test.
    pub split: Split,
}

/// Initial points with colours, as computed by structure from motion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Positions in the scene's units.
    pub positions: Vec<[f32; 3]>,
    /// Colours in 0..1.
    pub colors: Vec<[f32; 3]>,
}

/// Loads the image of a view. Implementations read files or trace rays; they do not cache.
pub trait FrameSource: Send + Sync {
    /// The image of `view`, at the size of its camera. The source of a [`Scene`] returns images without lens distortion; that of a reader
    /// ([`ImageSource::Frames`](crate::ImageSource::Frames)) returns them as they were taken, and they are undistorted later. Views are asked for in any order,
    /// more than once, and from several threads at a time.
    ///
    /// # Errors
    /// [`Error::Data`] for an image that cannot be read, [`Error::Parameter`] for a view that does not exist.
    fn load(&self, view: usize) -> Result<Image8>;
    /// Which pixels of that image see something that moves, where this is known: white (first channel over 127), at the size of the image.
    fn motion_mask(&self, _view: usize) -> Result<Option<Image8>> {
        Ok(None)
    }
    /// The recorded depth of that image, where there is one. The source of a [`Scene`] returns it at the size of the camera, in units of the scene. That of a
    /// reader returns it as it was taken, through the lens, in units of the dataset and with the proportions of the image. It is asked for where a loss term
    /// compares it, and to find out whether there is one.
    ///
    /// # Errors
    /// [`Error::Data`] for a depth that cannot be read.
    fn depth(&self, _view: usize) -> Result<Option<DepthImage>> {
        Ok(None)
    }
}

/// The source of a scene that has cameras and times, and no images.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoImages;

impl FrameSource for NoImages {
    fn load(&self, view: usize) -> Result<Image8> {
        Err(Error::unsupported(format!("the image of view {view}"), "this scene has no images", "Use a scene with images"))
    }
}

/// A dynamic scene. Frames and recorded depth are decoded on demand and cached up to a number of bytes; clones share the cache, derived scenes its bound.
#[derive(Clone)]
pub struct Scene {
    /// Display name.
    pub name: String,
    /// All cameras; a moving camera is one entry per pose.
    pub cameras: Vec<Camera>,
    /// All views, train and test.
    pub views: Vec<View>,
    /// Frames in the sequence (1 for a static scene).
    pub frame_count: usize,
    /// From the dataset's coordinates to those of this scene. Cameras, points, box, and all models trained on it are in the coordinates of the scene.
    pub normalisation: Similarity,
    /// Initial points, if the dataset has any.
    pub points: Option<PointCloud>,
    /// Box for random initial points if there are no others: lower and upper corner in the scene's units.
    pub init_box: Option<([f32; 3], [f32; 3])>,
    /// Warnings of the reader about data that was ignored.
    pub warnings: Vec<String>,
    /// Background of the dataset's images (RGBA scenes), RGB in 0..1, if stated.
    pub background: Option<[f32; 3]>,
    /// Foreground masks by view, where the dataset has them: white (first channel over 127) is foreground. Not cached.
    pub foreground_masks: Option<Arc<dyn FrameSource>>,
    frames: Arc<FrameCache>,
}

impl Scene {
    /// A scene over `source`; frames are cached up to `cache_bytes`.
    ///
    /// # Errors
    /// [`Error::Data`] for a scene without training views, views of cameras that do not exist or with times outside 0..1, and invalid cameras.
    pub fn new(name: impl Into<String>, cameras: Vec<Camera>, views: Vec<View>, source: Arc<dyn FrameSource>, cache_bytes: u64) -> Result<Self> {
        Self::over(name.into(), cameras, views, FrameCache::new(source, Arc::new(KeptFrames::new(cache_bytes))))
    }
    /// The views of this scene with other `cameras` and images and depth of `source`, of another size, say. The frames of both scenes together are cached up to
    /// [`Scene::cache_bytes`].
    ///
    /// # Errors
    /// As [`Scene::new`].
    pub fn derived(&self, cameras: Vec<Camera>, source: Arc<dyn FrameSource>) -> Result<Self> {
        Self::over(self.name.clone(), cameras, self.views.clone(), FrameCache::new(source, self.frames.kept.clone()))
    }
    fn over(name: String, cameras: Vec<Camera>, views: Vec<View>, frames: FrameCache) -> Result<Self> {
        for camera in &cameras {
            camera.validate()?;
        }
        if let Some(v) = views.iter().find(|v| v.camera >= cameras.len() || !(0.0..=1.0).contains(&v.time_norm)) {
            return Err(Error::data(
                name,
                format!("a view refers to camera {} of {} at time {}; times are from 0 to 1", v.camera, cameras.len(), v.time_norm),
                "Check the dataset's index files",
            ));
        }
        if !views.iter().any(|v| v.split == Split::Train) {
            return Err(Error::data(name, "there is no training view", "Check the path, and that the images exist"));
        }
        let frame_count = views.iter().map(|v| v.frame + 1).max().unwrap_or(1);
        Ok(Self {
            name,
            cameras,
            views,
            frame_count,
            normalisation: Similarity::IDENTITY,
            points: None,
            init_box: None,
            warnings: Vec::new(),
            background: None,
            foreground_masks: None,
            frames: Arc::new(frames),
        })
    }
    /// The most bytes of decoded frames and depth that are kept, of this scene and those derived from it together.
    pub fn cache_bytes(&self) -> u64 {
        self.frames.kept.cap
    }
    /// Indices of the views of `split`, in order.
    pub fn split(&self, split: Split) -> Vec<usize> {
        (0..self.views.len()).filter(|&i| self.views[i].split == split).collect()
    }
    /// The split on which losses of a trained model are measured where Gaussians are removed, values rounded or weights stored in fewer bits: validation views
    /// if there are some, because no training has fitted them, else training views. Never test views: they score the result.
    pub fn judging_split(&self) -> Split {
        if self.views.iter().any(|view| view.split == Split::Validation) { Split::Validation } else { Split::Train }
    }
    /// The camera of a view.
    pub fn camera(&self, view: usize) -> &Camera {
        &self.cameras[self.views[view].camera]
    }
    /// The image of a view, from the cache or decoded now.
    pub fn frame(&self, view: usize) -> Result<Arc<Image8>> {
        self.frames.image(view)
    }
    /// The recorded depth of a view at the size of its camera, in units of the scene, from the cache or read now. `None` where the dataset has none.
    ///
    /// # Errors
    /// [`Error::Data`] for a depth that cannot be read or has another size.
    pub fn depth(&self, view: usize) -> Result<Option<Arc<DepthImage>>> {
        let Some(depth) = self.frames.depth(view)? else { return Ok(None) };
        let camera = self.camera(view);
        if (depth.width, depth.height) != (camera.width, camera.height) {
            let problem = format!("{}x{} pixels, its camera has {}x{}", depth.width, depth.height, camera.width, camera.height);
            return Err(Error::data(format!("depth of view {view}"), problem, "Correct the source of the scene: depth has the size of the camera"));
        }
        Ok(Some(depth))
    }
    /// Whether a training view has recorded depth. The first one that has is read.
    ///
    /// # Errors
    /// As [`Scene::depth`].
    pub fn has_depth(&self) -> Result<bool> {
        for view in self.split(Split::Train) {
            if self.depth(view)?.is_some() {
                return Ok(true);
            }
        }
        Ok(false)
    }
    /// Which pixels of a view see something that moves, row by row, where the dataset knows it (built-in captures do). `None` for a scene of one frame.
    /// Computed at every call. For scores, not for training.
    pub fn motion_mask(&self, view: usize) -> Result<Option<Vec<bool>>> {
        if self.frame_count < 2 {
            return Ok(None);
        }
        let white = |mask: Image8| mask.data.chunks_exact(mask.channels as usize).map(|pixel| pixel[0] > 127).collect();
        Ok(self.frames.source.motion_mask(view)?.map(white))
    }
    /// 1.1 x the largest distance of a training camera from their mean, the scale of position learning rates (Inria's `cameras_extent`). In units of the scene:
    /// those of the normalised frame, not of the dataset.
    pub fn extent(&self) -> f32 {
        let centers: Vec<[f64; 3]> = self.split(Split::Train).iter().map(|&v| self.camera(v).center_world()).collect();
        let n = centers.len().max(1) as f64;
        let mean: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / n);
        let far = centers.iter().map(|c| (0..3).map(|k| (c[k] - mean[k]).powi(2)).sum::<f64>().sqrt()).fold(0.0, f64::max);
        // The distance of a single camera from the mean is 0; 1 avoids learning rates of 0.
        if far > 1e-6 { (1.1 * far) as f32 } else { 1.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// Images of so many bytes, and how many were loaded.
    struct Counted {
        bytes: usize,
        loads: AtomicUsize,
    }

    impl FrameSource for Counted {
        fn load(&self, _: usize) -> Result<Image8> {
            self.loads.fetch_add(1, Ordering::Relaxed);
            Ok(Image8 { width: (self.bytes / 3) as u32, height: 1, channels: 3, data: vec![0; self.bytes] })
        }
    }

    /// Images of 300 bytes and depth of 400, of another size in view 2 and of none in view 0, and how often depth was read.
    #[derive(Default)]
    struct Deep(AtomicUsize);

    impl FrameSource for Deep {
        fn load(&self, _: usize) -> Result<Image8> {
            Ok(Image8 { width: 100, height: 1, channels: 3, data: vec![0; 300] })
        }
        fn depth(&self, view: usize) -> Result<Option<DepthImage>> {
            self.0.fetch_add(1, Ordering::Relaxed);
            let width = if view == 2 { 90 } else { 100 };
            Ok((view > 0).then(|| DepthImage { width, height: 1, values: vec![1.0; width as usize] }))
        }
    }

    #[test]
    fn depth_and_frames_share_one_bound() {
        let scene = |cache_bytes: u64, source: Arc<dyn FrameSource>| {
            let camera = Camera::look_at("a", (100, 1), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let views = (0..3).map(|frame| View { camera: 0, frame, time_norm: 0.0, split: Split::Train }).collect();
            Scene::new("s", vec![camera], views, source, cache_bytes).unwrap()
        };
        let reads = |cache_bytes: u64| {
            let source = Arc::new(Deep::default());
            let scene = scene(cache_bytes, source.clone());
            for _ in 0..2 {
                assert_eq!(scene.depth(1).unwrap().unwrap().values, [1.0; 100]);
                scene.frame(1).unwrap();
            }
            source.0.load(Ordering::Relaxed)
        };
        assert_eq!((reads(699), reads(700)), (2, 1), "400 bytes of depth and 300 of the image");
        let deep = scene(0, Arc::new(Deep::default()));
        assert!(deep.has_depth().unwrap() && deep.depth(0).unwrap().is_none());
        let message = deep.depth(2).unwrap_err().to_string();
        assert!(message.contains("90x1 pixels, its camera has 100x1"), "{message}");
        assert!(!scene(0, Arc::new(NoImages)).has_depth().unwrap());
    }

    #[test]
    fn views_at_times_outside_0_to_1_are_refused() {
        let of = |time_norm: f32| {
            let camera = Camera::look_at("a", (8, 8), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let view = View { camera: 0, frame: 0, time_norm, split: Split::Train };
            Scene::new("s", vec![camera], vec![view], Arc::new(NoImages), 0).map(drop).map_err(|e| e.to_string())
        };
        assert!(of(0.0).is_ok() && of(1.0).is_ok());
        for time_norm in [-0.1, 1.5, f32::NAN, f32::INFINITY] {
            let error = of(time_norm).unwrap_err();
            assert!(error.contains(&format!("at time {time_norm}; times are from 0 to 1")), "{error}");
        }
    }

    #[test]
    fn validation_views_judge_where_there_are_some() {
        let judging = |splits: &[Split]| {
            let camera = Camera::look_at("a", (8, 8), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0]);
            let views = splits.iter().enumerate().map(|(frame, &split)| View { camera: 0, frame, time_norm: 0.0, split }).collect();
            Scene::new("s", vec![camera], views, Arc::new(NoImages), 0).unwrap().judging_split()
        };
        assert_eq!(judging(&[Split::Train, Split::Test]), Split::Train);
        assert_eq!(judging(&[Split::Train, Split::Test, Split::Validation]), Split::Validation);
    }

    #[test]
    fn derived_scenes_share_one_bound() {
        let source = |bytes| Arc::new(Counted { bytes, loads: AtomicUsize::new(0) });
        let loads = |source: &Arc<Counted>| source.loads.load(Ordering::Relaxed);
        let (large, small, huge) = (source(300), source(90), source(3000));
        let camera = || vec![Camera::look_at("a", (100, 1), 1.0, [0.0, 0.0, -4.0], [0.0; 3], [0.0, 1.0, 0.0])];
        let views = (0..6).map(|frame| View { camera: 0, frame, time_norm: 0.0, split: Split::Train }).collect();
        let scene = Scene::new("s", camera(), views, large.clone(), 1000).unwrap();
        let kept = || {
            let state = scene.frames.kept.state.lock().unwrap();
            assert_eq!(state.bytes, state.frames.values().map(|(kept, _)| kept.bytes()).sum::<u64>());
            state.bytes
        };
        let derived = scene.derived(camera(), small.clone()).unwrap();
        assert_eq!((derived.views.len(), derived.cache_bytes()), (6, 1000));
        for view in 0..6 {
            scene.frame(view).unwrap();
            derived.frame(view).unwrap();
            assert!(kept() <= 1000, "{} bytes after view {view}", kept());
        }
        // Images of one view in two scenes have separate entries, and the last ones are cached.
        assert_eq!((scene.frame(5).unwrap().data.len(), derived.frame(5).unwrap().data.len()), (300, 90));
        assert_eq!((loads(&large), loads(&small)), (6, 6));
        // An image over the bound removes no other from the cache.
        let before = kept();
        let other = scene.derived(camera(), huge.clone()).unwrap();
        other.frame(0).unwrap();
        assert_eq!((kept(), loads(&huge)), (before, 1));
        // The frames of a scene that was dropped are removed from the cache.
        let copy = derived.clone();
        drop(derived);
        assert_eq!(kept(), before, "a clone still has them");
        drop(copy);
        assert!(kept() < before && kept().is_multiple_of(300), "{} of {before} bytes", kept());
    }
}
