//! The training images of one instant at several small sizes, with the geometry the sweep needs.

use super::super::camera_box::camera_box;
use super::super::resample::resize;
use cc4dgs_core::{Camera, Error, Image8, Result, Scene, Split};
use glam::{DMat3, DVec3, Mat3, Vec3};
use rayon::prelude::*;

/// Pixels per image at each level, coarse to fine.
const LEVEL_PIXELS: [f64; 3] = [6_000.0, 24_000.0, 96_000.0];
/// The most images that get a depth map.
const MAX_VIEWS: usize = 40;
/// Neighbours an image is matched with.
const NEIGHBOURS: usize = 4;
/// The angle between viewing directions that matches best: wide enough for depth, narrow enough to look alike.
const BEST_ANGLE_RAD: f64 = 0.2;

/// One image at one size.
pub(super) struct Level {
    pub width: usize,
    pub height: usize,
    /// Mean of the channels, 0..1.
    pub gray: Vec<f32>,
    /// RGB, 0..1.
    pub rgb: Vec<[f32; 3]>,
    /// Camera matrix K.
    pub k: DMat3,
}

/// One camera.
pub(super) struct WorkView {
    pub levels: Vec<Level>,
    pub rotation: DMat3,
    pub translation: DVec3,
    pub center: DVec3,
    /// Indices of the views it is matched with.
    pub neighbours: Vec<usize>,
    /// Nearest and farthest depth of the scene's box.
    pub depth_range: [f64; 2],
    /// Foreground, at the finest level.
    pub mask: Option<Vec<bool>>,
    /// Opaque pixels of images with alpha, at the finest level.
    pub opaque: Option<Vec<bool>>,
}

/// All of them.
pub(super) struct WorkSet {
    pub views: Vec<WorkView>,
    pub box_low: Vec3,
    pub box_high: Vec3,
}

impl Level {
    fn new(image: &Image8, camera: &Camera) -> Self {
        let camera = camera.resized(image.width, image.height);
        let c = image.channels as usize;
        let rgb: Vec<[f32; 3]> = image.data.chunks_exact(c).map(|p| [0, 1, 2].map(|k| f32::from(p[k]) / 255.0)).collect();
        let gray = rgb.iter().map(|p| (p[0] + p[1] + p[2]) / 3.0).collect();
        let k = DMat3::from_cols_array_2d(&[[camera.fx, 0.0, 0.0], [0.0, camera.fy, 0.0], [camera.cx, camera.cy, 1.0]]);
        Self { width: image.width as usize, height: image.height as usize, gray, rgb, k }
    }
    /// Index of the pixel that holds image coordinates (u, v).
    pub fn pixel(&self, u: f32, v: f32) -> Option<usize> {
        (u >= 0.0 && v >= 0.0 && u < self.width as f32 && v < self.height as f32).then(|| v as usize * self.width + u as usize)
    }
}

impl WorkView {
    /// The finest level.
    pub fn fine(&self) -> &Level {
        // There is always at least one level; see `load_view`.
        &self.levels[self.levels.len() - 1]
    }
    /// Image coordinates at `level` and depth of a world point in front of the camera.
    pub fn project(&self, level: &Level, p: Vec3) -> Option<(f32, f32, f32)> {
        let c = self.rotation * p.as_dvec3() + self.translation;
        if c.z < 1e-6 {
            return None;
        }
        let q = level.k * c;
        Some(((q.x / c.z) as f32, (q.y / c.z) as f32, c.z as f32))
    }
    /// The world point at `depth` behind image coordinates (u, v) of `level`.
    pub fn unproject(&self, level: &Level, u: f64, v: f64, depth: f64) -> Vec3 {
        let c = level.k.inverse() * DVec3::new(u, v, 1.0) * depth;
        (self.rotation.transpose() * (c - self.translation)).as_vec3()
    }
    /// Maps pixel coordinates (u, v, 1) of `own` times depth, plus the second part, to homogeneous pixel coordinates of `other`.
    pub fn warp_to(&self, own: &Level, other: &WorkView, theirs: &Level) -> (Mat3, Vec3) {
        let r = other.rotation * self.rotation.transpose();
        let t = other.translation - r * self.translation;
        ((theirs.k * r * own.k.inverse()).as_mat3(), (theirs.k * t).as_vec3())
    }
}

impl WorkSet {
    /// Loads the first instant with at least `min_views` training cameras.
    pub fn load(scene: &Scene, min_views: usize) -> Result<Self> {
        let mut by_frame: Vec<Vec<usize>> = vec![Vec::new(); scene.frame_count];
        scene.split(Split::Train).into_iter().for_each(|v| by_frame[scene.views[v].frame].push(v));
        let most = by_frame.iter().map(Vec::len).max().unwrap_or(0);
        let Some(mut chosen) = by_frame.into_iter().find(|v| v.len() >= min_views) else {
            return Err(Error::unsupported(
                format!("points from the images of {}", scene.name),
                format!("at no instant there are {min_views} training cameras, the most is {most}"),
                "Start from random points",
            ));
        };
        if chosen.len() > MAX_VIEWS {
            let all = chosen.len();
            chosen = (0..MAX_VIEWS).map(|i| chosen[i * all / MAX_VIEWS]).collect();
        }
        let (low, high) = scene.init_box.unwrap_or_else(|| camera_box(scene));
        let (low, high) = (Vec3::from(low), Vec3::from(high));
        let mut views = chosen.par_iter().map(|&v| load_view(scene, v, low, high)).collect::<Result<Vec<_>>>()?;
        let focus = (0.5 * (low + high)).as_dvec3();
        let near: Vec<Vec<usize>> = (0..views.len()).map(|i| neighbours(&views, i, focus)).collect();
        views.iter_mut().zip(near).for_each(|(view, near)| view.neighbours = near);
        Ok(Self { views, box_low: low, box_high: high })
    }
    /// Edge of the cubes points are thinned to: about two pixels of the finest level at the middle of the scene.
    pub fn cell_size(&self) -> f32 {
        let focus = 0.5 * (self.box_low + self.box_high);
        let mut sizes: Vec<f32> = self.views.iter().map(|v| (v.center.as_vec3() - focus).length() / v.fine().k.x_axis.x as f32).collect();
        sizes.sort_by(f32::total_cmp);
        (2.0 * sizes[sizes.len() / 2]).max(1e-6 * (self.box_high - self.box_low).max_element().max(1e-6))
    }
}

fn load_view(scene: &Scene, view: usize, low: Vec3, high: Vec3) -> Result<WorkView> {
    let camera = scene.camera(view);
    let image = scene.frame(view)?;
    let pixels = f64::from(image.width) * f64::from(image.height);
    let (mut levels, mut fine) = (Vec::new(), None);
    for budget in LEVEL_PIXELS {
        let scale = (budget / pixels).sqrt().min(1.0);
        let size = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        let small = resize(&image, size(image.width), size(image.height));
        levels.push(Level::new(&small, camera));
        fine = Some(small);
        if scale >= 1.0 {
            break;
        }
    }
    let opaque = fine.as_ref().filter(|f| f.channels == 4).map(|f| f.data.chunks_exact(4).map(|p| p[3] > 127).collect());
    let mask = match (&scene.foreground_masks, &fine) {
        // A view without a mask is no obstacle.
        (Some(source), Some(f)) => source.load(view).ok().map(|m| {
            let m = resize(&m, f.width, f.height);
            m.data.chunks_exact(m.channels as usize).map(|p| p[0] > 127).collect()
        }),
        _ => None,
    };
    let (rotation, translation) = camera.rotation_translation();
    let mut depths = [f64::INFINITY, f64::NEG_INFINITY];
    for i in 0..8 {
        let pick = |bit: usize, k: usize| f64::from(if i >> bit & 1 == 1 { high[k] } else { low[k] });
        let z = (rotation * DVec3::new(pick(0, 0), pick(1, 1), pick(2, 2)) + translation).z;
        depths = [depths[0].min(z), depths[1].max(z)];
    }
    let far = depths[1].max(1e-3);
    // Nothing useful is nearer than a twelfth of the far end; it would cost most of the planes.
    let near = depths[0].max(far / 12.0).min(0.9 * far);
    Ok(WorkView { levels, rotation, translation, center: DVec3::from(camera.center_world()), neighbours: Vec::new(), depth_range: [near, far], mask, opaque })
}

/// The views whose direction to `focus` differs from that of view `i` by about [`BEST_ANGLE_RAD`].
fn neighbours(views: &[WorkView], i: usize, focus: DVec3) -> Vec<usize> {
    let own = (focus - views[i].center).normalize_or_zero();
    let mut others: Vec<(f64, usize)> = (0..views.len())
        .filter(|&j| j != i && (views[j].center - views[i].center).length() > 1e-9)
        .map(|j| {
            let angle = own.dot((focus - views[j].center).normalize_or_zero()).clamp(-1.0, 1.0).acos();
            ((angle - BEST_ANGLE_RAD).abs(), j)
        })
        .collect();
    others.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    others.into_iter().take(NEIGHBOURS).map(|o| o.1).collect()
}
