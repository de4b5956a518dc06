//! What a reader hands over, and the steps all scenes share on the way to a [`Scene`].

use super::camera_box::camera_box;
use super::distortion::{Distortion, Undistort};
use super::files::picture_size;
use super::options::{CameraRef, SceneOptions};
use super::picture::{FileFrames, Job, Plan};
use super::pose::Matrix4;
use super::video::VideoFrames;
use cc4dgs_core::{Camera, Error, FrameSource, Limits, PointCloud, Result, Scene, Split, View};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// How far from the origin a camera may be, in world units: squares of distances must stay within f32.
const FARTHEST: f64 = 1e12;

/// A calibrated camera with its lens, at the size its calibration is for.
#[derive(Clone, Debug)]
pub(crate) struct RawCamera {
    /// Name as the dataset has it.
    pub name: String,
    /// Size in pixels the calibration is for.
    pub size: [u32; 2],
    /// Focal lengths in pixels.
    pub focal: [f64; 2],
    /// Principal point in pixels.
    pub principal: [f64; 2],
    /// The lens.
    pub distortion: Distortion,
    /// OpenCV axes, rigid.
    pub world_to_camera: Matrix4,
}

/// Where a picture comes from.
#[derive(Clone, Debug)]
pub(crate) enum Picture {
    /// A file, and a foreground mask of the same size if there is one.
    File {
        /// The picture.
        path: PathBuf,
        /// White where the foreground is.
        mask: Option<PathBuf>,
    },
    /// A frame of a video.
    Video {
        /// The video.
        path: PathBuf,
        /// Frame of the video, 0-based.
        frame: usize,
    },
    /// Computed, not stored.
    Traced,
}

/// One picture of one camera.
#[derive(Clone, Debug)]
pub(crate) struct RawView {
    /// Index into the cameras.
    pub camera: usize,
    /// Frame index in the dataset, 0-based.
    pub frame: usize,
    /// The dataset's own time, 0..1; frames get index / count where it has none.
    pub time: Option<f64>,
    /// The dataset's own split.
    pub split: Split,
    /// Its source.
    pub picture: Picture,
}

/// A parsed dataset.
#[derive(Default)]
pub(crate) struct RawScene {
    pub name: String,
    pub cameras: Vec<RawCamera>,
    pub views: Vec<RawView>,
    pub points: Option<PointCloud>,
    pub init_box: Option<([f32; 3], [f32; 3])>,
    pub background: Option<[f32; 3]>,
    pub warnings: Vec<String>,
}

impl RawScene {
    /// Applies the options that choose views: frames, held-out cameras, missing pictures, the cap on training views. Sorts by frame, then camera.
    pub(crate) fn select(&mut self, options: &SceneOptions) -> Result<Vec<View>> {
        self.choose_frames(options)?;
        self.drop_missing();
        if let Some(held_out) = &options.test_cameras {
            self.hold_out(held_out)?;
        }
        self.views.sort_by_key(|v| (v.frame, v.camera));
        self.cap_training_views(options.max_views);
        self.drop_unused_cameras();
        let count = self.views.iter().map(|v| v.frame + 1).max().unwrap_or(1);
        Ok(self
            .views
            .iter()
            .map(|v| View {
                camera: v.camera,
                frame: v.frame,
                time_norm: v.time.unwrap_or(v.frame as f64 / count as f64).clamp(0.0, 1.0) as f32,
                split: v.split,
            })
            .collect())
    }

    /// Sets frame and time of each view from the dataset's times, one per view: the frame is the rank among the distinct times; times over 1 are
    /// divided by the largest.
    pub(crate) fn rank_times(&mut self, times: &[Option<f64>], object: &str) -> Result<()> {
        if let Some(t) = times.iter().flatten().find(|t| !t.is_finite() || **t < 0.0) {
            return Err(Error::data(object, format!("time {t} is not a number from 0 up"), "Correct the JSON"));
        }
        let largest = times.iter().flatten().fold(1.0f64, |a, &t| a.max(t));
        let mut distinct: Vec<f64> = times.iter().map(|t| t.unwrap_or(0.0)).collect();
        distinct.sort_by(f64::total_cmp);
        distinct.dedup();
        for (view, time) in self.views.iter_mut().zip(times) {
            let t = time.unwrap_or(0.0);
            view.frame = distinct.partition_point(|&d| d < t);
            view.time = Some(t / largest);
        }
        Ok(())
    }

    fn choose_frames(&mut self, options: &SceneOptions) -> Result<()> {
        let Some([start, count, stride]) = options.frames else { return Ok(()) };
        let available = self.views.iter().map(|v| v.frame + 1).max().unwrap_or(0);
        self.views.retain_mut(|v| {
            let Some(offset) = v.frame.checked_sub(start) else { return false };
            let place = offset / stride;
            v.frame = place;
            offset % stride == 0 && (count == 0 || place < count)
        });
        if self.views.is_empty() {
            return Err(Error::parameter(
                "scene.frames",
                format!("[{start}, {count}, {stride}] selects nothing of {available} frames"),
                "Choose frames that exist",
            ));
        }
        let found = self.views.iter().map(|v| v.frame + 1).max().unwrap_or(0);
        if count > found {
            self.warnings.push(format!("scene.frames asks for {count} frames from {start} on, {found} exist"));
        }
        Ok(())
    }

    fn drop_missing(&mut self) {
        let mut missing = Vec::new();
        self.views.retain(|v| match &v.picture {
            Picture::File { path, .. } if !path.is_file() => {
                missing.push(path.display().to_string());
                false
            }
            _ => true,
        });
        if !missing.is_empty() {
            missing.sort();
            let shown = missing.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
            let more = if missing.len() > 3 { ", …" } else { "" };
            self.warnings.push(format!("{} pictures the dataset names are missing and were skipped: {shown}{more}", missing.len()));
        }
    }

    fn hold_out(&mut self, held_out: &[CameraRef]) -> Result<()> {
        let mut test = vec![false; self.cameras.len()];
        for reference in held_out {
            let found: Vec<usize> = match reference {
                CameraRef::Index(i) => (*i < test.len()).then_some(*i).into_iter().collect(),
                CameraRef::Name(name) => (0..test.len()).filter(|&i| self.cameras[i].name == *name).collect(),
            };
            if found.is_empty() {
                let known = self.cameras.iter().take(40).map(|c| c.name.as_str()).collect::<Vec<_>>().join(", ");
                return Err(Error::parameter(
                    "scene.test_cameras",
                    format!("there is no camera {reference:?}"),
                    format!("The scene has {}: {known}", self.cameras.len()),
                ));
            }
            found.into_iter().for_each(|i| test[i] = true);
        }
        for view in &mut self.views {
            view.split = if test[view.camera] { Split::Test } else { Split::Train };
        }
        Ok(())
    }

    fn cap_training_views(&mut self, cap: usize) {
        let train = self.views.iter().filter(|v| v.split == Split::Train).count();
        if cap == 0 || train <= cap {
            return;
        }
        let mut place = 0;
        self.views.retain(|v| {
            if v.split == Split::Test {
                return true;
            }
            place += 1;
            // Keeps the views at which the running share of `cap` passes a whole number: evenly spread.
            (place * cap) / train != ((place - 1) * cap) / train
        });
    }

    fn drop_unused_cameras(&mut self) {
        let mut used = vec![false; self.cameras.len()];
        self.views.iter().for_each(|v| used[v.camera] = true);
        let mut new_index = vec![0; used.len()];
        let mut next = 0;
        for (slot, &is_used) in new_index.iter_mut().zip(&used) {
            *slot = next;
            next += usize::from(is_used);
        }
        let mut keep = used.iter();
        self.cameras.retain(|_| *keep.next().unwrap_or(&false));
        self.views.iter_mut().for_each(|v| v.camera = new_index[v.camera]);
    }

    /// The finished scene over files and videos.
    pub(crate) fn assemble(mut self, options: &SceneOptions, limits: &Limits) -> Result<Scene> {
        if let Some(v) = self.views.iter().find(|v| v.camera >= self.cameras.len()) {
            return Err(Error::data(self.name, format!("a picture names camera {} of {}", v.camera, self.cameras.len()), "Check the dataset's index files"));
        }
        let views = self.select(options)?;
        if !views.iter().any(|v| v.split == Split::Train) {
            let hint = self.warnings.last().cloned().unwrap_or_default();
            return Err(Error::data(self.name, format!("there is no training picture. {hint}"), "Check the path, scene.frames and scene.test_cameras"));
        }
        let mut plans = Vec::with_capacity(self.cameras.len());
        let mut cameras = Vec::with_capacity(self.cameras.len());
        for (index, camera) in self.cameras.iter_mut().enumerate() {
            let first = self.views.iter().find(|v| v.camera == index).map(|v| &v.picture);
            let native = match first {
                Some(Picture::File { path, .. }) => fit_to_pictures(camera, picture_size(path, limits)?, &mut self.warnings)?,
                _ => camera.size,
            };
            let (plan, pinhole) = plan_camera(camera, native, options, limits)?;
            plans.push(plan);
            cameras.push(pinhole);
        }
        let videos = VideoFrames::new(&self.views, &plans, options)?;
        let jobs = self.views.iter().map(|v| Job { picture: v.picture.clone(), plan: v.camera }).collect();
        let masks: Vec<Job> = self
            .views
            .iter()
            .map(|v| match &v.picture {
                Picture::File { mask: Some(path), .. } if path.is_file() => Job { picture: Picture::File { path: path.clone(), mask: None }, plan: v.camera },
                _ => Job { picture: Picture::Traced, plan: v.camera },
            })
            .collect();
        let has_masks = masks.iter().any(|j| !matches!(j.picture, Picture::Traced));
        let source = FileFrames { jobs, plans: plans.clone(), videos, limits: *limits };
        let mut scene = Scene::new(self.name, cameras, views, Arc::new(source), options.cache_mb.saturating_mul(1_000_000))?;
        if has_masks {
            let source: Arc<dyn FrameSource> = Arc::new(FileFrames { jobs: masks, plans, videos: VideoFrames::default(), limits: *limits });
            scene.foreground_masks = Some(source);
        }
        scene.points = self.points.filter(|p| !p.positions.is_empty());
        let usable = |b: &([f32; 3], [f32; 3])| (0..3).all(|k| b.0[k] < b.1[k] && b.0[k].is_finite() && b.1[k].is_finite());
        scene.init_box = self.init_box.filter(usable).or_else(|| scene.points.is_none().then(|| camera_box(&scene)));
        scene.background = options.background.as_ref().map(|b| b.rgb()).transpose()?.or(self.background);
        scene.warnings = dedupe(self.warnings);
        Ok(scene)
    }
}

/// Brings the calibration to the size the pictures really have, if only the scale differs.
fn fit_to_pictures(camera: &mut RawCamera, found: (u32, u32), warnings: &mut Vec<String>) -> Result<[u32; 2]> {
    let [w, h] = camera.size.map(f64::from);
    let (sx, sy) = (f64::from(found.0) / w, f64::from(found.1) / h);
    if camera.size == [found.0, found.1] {
        return Ok(camera.size);
    }
    if !sx.is_finite() || !sy.is_finite() || (sx / sy - 1.0).abs() > 0.01 {
        return Err(Error::data(
            format!("camera {}", camera.name),
            format!("calibrated for {w}x{h} pixels, its picture has {}x{}", found.0, found.1),
            "Use the pictures the calibration was made for",
        ));
    }
    warnings.push(format!("the pictures are {}x{}, the calibration is for {w}x{h}; it was scaled", found.0, found.1));
    camera.focal = [camera.focal[0] * sx, camera.focal[1] * sy];
    camera.principal = [camera.principal[0] * sx, camera.principal[1] * sy];
    camera.size = [found.0, found.1];
    Ok(camera.size)
}

fn plan_camera(camera: &RawCamera, native: [u32; 2], options: &SceneOptions, limits: &Limits) -> Result<(Plan, Camera)> {
    let object = format!("camera {}", camera.name);
    let mut pinhole = Camera {
        name: camera.name.clone(),
        width: native[0],
        height: native[1],
        fx: camera.focal[0],
        fy: camera.focal[1],
        cx: camera.principal[0],
        cy: camera.principal[1],
        world_to_camera: camera.world_to_camera,
    };
    pinhole.validate()?;
    if pinhole.center_world().iter().any(|v| v.abs() > FARTHEST) {
        return Err(Error::data(
            object,
            format!("its centre {:?} is over {FARTHEST:e} units away", pinhole.center_world()),
            "Check the dataset's calibration file",
        ));
    }
    let undistort = if camera.distortion.is_identity() {
        None
    } else {
        let plan = Undistort::plan(&object, &camera.distortion, native, camera.focal, camera.principal)?;
        [pinhole.width, pinhole.height] = plan.size;
        [pinhole.cx, pinhole.cy] = plan.principal_point();
        Some(plan)
    };
    let output = options.target_size((pinhole.width, pinhole.height));
    limits.check_pixels(&object, u64::from(output.0), u64::from(output.1))?;
    Ok((Plan { native, undistort, output }, pinhole.resized(output.0, output.1)))
}

/// Each distinct warning once, with how often it came.
fn dedupe(warnings: Vec<String>) -> Vec<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for w in warnings {
        *counts.entry(w).or_default() += 1;
    }
    counts.into_iter().map(|(w, n)| if n > 1 { format!("{w} ({n} times)") } else { w }).collect()
}
