//! A scene: cameras, times, and 8-bit frames that are decoded on demand.

use crate::{Camera, Error, Image8, Result, Similarity};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

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
    /// The image of `view`, undistorted and at the size of its camera.
    fn load(&self, view: usize) -> Result<Image8>;
    /// Which pixels of that image see something that moves, where this is known: white (first channel over 127), at the size of the image.
    fn motion_mask(&self, _view: usize) -> Result<Option<Image8>> {
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

/// A dynamic scene. Frames are decoded on demand and cached up to a number of bytes; clones share the cache.
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
        let name = name.into();
        for camera in &cameras {
            camera.validate()?;
        }
        if let Some(v) = views.iter().find(|v| v.camera >= cameras.len() || !v.time_norm.is_finite()) {
            return Err(Error::data(
                name,
                format!("a view refers to camera {} of {} at time {}", v.camera, cameras.len(), v.time_norm),
                "Check the dataset's index files",
            ));
        }
        if !views.iter().any(|v| v.split == Split::Train) {
            return Err(Error::data(name, "there is no training view", "Check the path, and that the images exist"));
        }
        let frame_count = views.iter().map(|v| v.frame + 1).max().unwrap_or(1);
        let frames = Arc::new(FrameCache { source, cap: cache_bytes, state: Mutex::default() });
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
            frames,
        })
    }
    /// The most bytes of decoded frames that are kept.
    pub fn cache_bytes(&self) -> u64 {
        self.frames.cap
    }
    /// Indices of the views of `split`, in order.
    pub fn split(&self, split: Split) -> Vec<usize> {
        (0..self.views.len()).filter(|&i| self.views[i].split == split).collect()
    }
    /// The camera of a view.
    pub fn camera(&self, view: usize) -> &Camera {
        &self.cameras[self.views[view].camera]
    }
    /// The image of a view, from the cache or decoded now.
    pub fn frame(&self, view: usize) -> Result<Arc<Image8>> {
        self.frames.get(view)
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
    /// 1.1 x the largest distance of a training camera from their mean, the scale of position learning rates (Inria's `cameras_extent`).
    pub fn extent(&self) -> f32 {
        let centers: Vec<[f64; 3]> = self.split(Split::Train).iter().map(|&v| self.camera(v).center_world()).collect();
        let n = centers.len().max(1) as f64;
        let mean: [f64; 3] = std::array::from_fn(|k| centers.iter().map(|c| c[k]).sum::<f64>() / n);
        let far = centers.iter().map(|c| (0..3).map(|k| (c[k] - mean[k]).powi(2)).sum::<f64>().sqrt()).fold(0.0, f64::max);
        // The distance of a single camera from the mean is 0; 1 avoids learning rates of 0.
        if far > 1e-6 { (1.1 * far) as f32 } else { 1.0 }
    }
}

struct FrameCache {
    source: Arc<dyn FrameSource>,
    cap: u64,
    state: Mutex<CacheState>,
}

#[derive(Default)]
struct CacheState {
    frames: HashMap<usize, (Arc<Image8>, u64)>,
    bytes: u64,
    clock: u64,
}

impl FrameCache {
    fn get(&self, view: usize) -> Result<Arc<Image8>> {
        if let Ok(mut state) = self.state.lock() {
            state.clock += 1;
            let now = state.clock;
            if let Some((image, used)) = state.frames.get_mut(&view) {
                *used = now;
                return Ok(image.clone());
            }
        }
        // Decoded outside the lock, so that prefetching threads work in parallel.
        let image = Arc::new(self.source.load(view)?);
        if let Ok(mut state) = self.state.lock() {
            let size = image.data.len() as u64;
            while state.bytes + size > self.cap {
                let Some(oldest) = state.frames.iter().min_by_key(|(_, (_, used))| *used).map(|(&v, _)| v) else { break };
                if let Some((old, _)) = state.frames.remove(&oldest) {
                    state.bytes -= old.data.len() as u64;
                }
            }
            if size <= self.cap && !state.frames.contains_key(&view) {
                state.bytes += size;
                let now = state.clock;
                state.frames.insert(view, (image.clone(), now));
            }
        }
        Ok(image)
    }
}
