//! The chosen training images at several small sizes, with the geometry that matching needs.

use super::super::camera_box::camera_box;
use super::super::focus::Focus;
use super::super::resample::resize;
use super::choose::{Arrangement, Choice, focus_depth};
use cc4dgs_core::{Camera, Error, Image8, Result, Scene};
use glam::{DMat3, DVec3, Mat3, Vec3};
use rayon::prelude::*;

/// Pixels per image at each level, coarse to fine.
const LEVEL_PIXELS: [f64; 3] = [6_000.0, 24_000.0, 96_000.0];
/// Nearest and farthest depth that is looked at where the scene fills the images, as multiples of the distance of what the cameras look at: rooms and gardens
/// reach several times farther.
const FULL_RANGE: [f64; 2] = [0.15, 8.0];

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

/// One image.
pub(super) struct WorkView {
    pub levels: Vec<Level>,
    pub rotation: DMat3,
    pub translation: DVec3,
    pub center: DVec3,
    /// Positions in [`WorkSet::views`] of the views it is matched with, and of the keys whose depth maps are asked. Empty for views that are no keys.
    pub partners: Vec<usize>,
    pub witnesses: Vec<usize>,
    /// Nearest and farthest depth that is looked at.
    pub depth_range: [f64; 2],
    /// Foreground, at the finest level; see [`super::foreground`].
    pub mask: Option<Vec<bool>>,
    /// Opaque pixels of images with alpha, at the finest level.
    pub opaque: Option<Vec<bool>>,
}

/// What the foreground masks of a set are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Foreground {
    /// There are none: the scene fills the images.
    Unknown,
    /// The dataset marks what moves or matters; the rest is there as well.
    Part,
    /// There is nothing but the foreground, before transparency or a plain colour.
    Whole,
}

/// All of them.
pub(super) struct WorkSet {
    /// Keys first.
    pub views: Vec<WorkView>,
    pub keys: usize,
    pub arrangement: Arrangement,
    pub rig: Focus,
    pub foreground: Foreground,
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
    /// Index of the pixel of the finest level that shows a world point, if any, whatever is in front of it.
    pub fn pixel_of(&self, p: Vec3) -> Option<usize> {
        let level = self.fine();
        self.project(level, p).and_then(|(u, v, _)| level.pixel(u, v))
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
    /// Whether something of the scene can be at a pixel of the finest level.
    pub fn solid(&self, foreground: Foreground, pixel: usize) -> bool {
        let drawn = self.opaque.as_ref().is_none_or(|o| o[pixel]);
        drawn && (foreground != Foreground::Whole || self.mask.as_ref().is_none_or(|m| m[pixel]))
    }
}

impl WorkSet {
    /// Loads the chosen views.
    ///
    /// # Errors
    /// Whatever decoding the images meets.
    pub fn load(scene: &Scene, choice: Choice) -> Result<Self> {
        let (low, high) = scene.init_box.unwrap_or_else(|| camera_box(scene));
        let mut views = choice.views.par_iter().map(|&v| load_view(scene, v)).collect::<Result<Vec<_>>>()?;
        for ((view, partners), witnesses) in views.iter_mut().zip(choice.partners).zip(choice.witnesses) {
            (view.partners, view.witnesses) = (partners, witnesses);
        }
        let foreground = super::foreground::find(&mut views);
        let (box_low, box_high) = (Vec3::from(low), Vec3::from(high));
        let mut set = Self { views, keys: choice.keys, arrangement: choice.arrangement, rig: choice.rig, foreground, box_low, box_high };
        set.set_depth_ranges();
        Ok(set)
    }
    /// Narrows the box to what the foreground can fill.
    pub fn narrow(&mut self, low: Vec3, high: Vec3) {
        (self.box_low, self.box_high) = (self.box_low.max(low), self.box_high.min(high));
        self.set_depth_ranges();
    }
    /// The views that get depth maps.
    pub fn key_views(&self) -> &[WorkView] {
        &self.views[..self.keys]
    }
    fn set_depth_ranges(&mut self) {
        for i in 0..self.views.len() {
            self.views[i].depth_range = self.depth_range(&self.views[i]);
        }
    }
    fn depth_range(&self, view: &WorkView) -> [f64; 2] {
        let mut depths = [f64::INFINITY, f64::NEG_INFINITY];
        for i in 0..8 {
            let pick = |bit: usize, k: usize| f64::from(if i >> bit & 1 == 1 { self.box_high[k] } else { self.box_low[k] });
            let z = (view.rotation * DVec3::new(pick(0, 0), pick(1, 1), pick(2, 2)) + view.translation).z;
            depths = [depths[0].min(z), depths[1].max(z)];
        }
        if self.foreground == Foreground::Whole {
            let far = depths[1].max(1e-3);
            // Nothing useful is nearer than a twelfth of the far end; it would cost most of the planes.
            return [depths[0].max(far / 12.0).min(0.9 * far), far];
        }
        let focus = focus_depth(view.center, view.rotation.transpose() * DVec3::Z, &self.rig);
        let far = depths[1].max(FULL_RANGE[1] * focus);
        let near = FULL_RANGE[0] * focus;
        [if depths[0] > 0.0 { depths[0].clamp(0.3 * near, near) } else { near }, far]
    }
    /// Edge of the cubes that points at the distance of what the cameras look at are thinned to: about two pixels of the finest level.
    pub fn cell_size(&self) -> f32 {
        let focus = 0.5 * (self.box_low + self.box_high);
        let mut sizes: Vec<f32> = self.views.iter().map(|v| (v.center.as_vec3() - focus).length() / v.fine().k.x_axis.x as f32).collect();
        sizes.sort_by(f32::total_cmp);
        (2.0 * sizes[sizes.len() / 2]).max(1e-6 * (self.box_high - self.box_low).max_element().max(1e-6))
    }
}

fn load_view(scene: &Scene, view: usize) -> Result<WorkView> {
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
        (Some(source), Some(f)) => match source.load(view) {
            Ok(m) => {
                let m = resize(&m, f.width, f.height);
                Some(m.data.chunks_exact(m.channels as usize).map(|p| p[0] > 127).collect())
            }
            // A view without a mask is no obstacle.
            Err(Error::Unsupported { .. }) => None,
            Err(e) => return Err(e),
        },
        _ => None,
    };
    let (rotation, translation) = camera.rotation_translation();
    let center = DVec3::from(camera.center_world());
    Ok(WorkView { levels, rotation, translation, center, partners: Vec::new(), witnesses: Vec::new(), depth_range: [0.0; 2], mask, opaque })
}
