//! What can be known of a scene without training: its cameras, its images, and what differs between them.

use super::overlap::Overlap;
use crate::data::resize;
use crate::sample::{spread_from_first, spread_views};
use cc4dgs_core::{Image8, Result, Scene, Split};
use glam::DVec3;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Images that are looked at.
const LOOKS: usize = 24;
/// Cameras and frames per camera that are looked at for motion.
const MOTION_LOOKS: [usize; 2] = [6, 12];
/// Width in pixels of the images that are looked at.
const WIDTH: u32 = 160;
/// Standard deviation over a 3x3 window, of values in 0..1, from which a pixel shows detail.
const DETAIL: f32 = 0.02;
/// Deviation over time, of values in 0..1, from which a pixel sees something move, at least; and as a multiple of the noise.
const MOTION: f32 = 0.04;
const MOTION_OVER_NOISE: f32 = 6.0;
/// Mean absolute difference from one colour, of values in 0..1, up to which a border is plain.
const PLAIN: f32 = 0.02;
/// Share of border pixels of that colour from which the background is plain.
const PLAIN_SHARE: f32 = 0.9;
/// Share of the pixels that is opaque, below which an image says nothing of exposure.
const LEAST_OPAQUE: f32 = 0.005;
/// Cosine of the angle between the axes of cameras above which they see much the same: 0.6 rad.
const ALIKE_AXES: f64 = 0.825;

/// How the training cameras stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrangement {
    /// Photos of a scene that stands still.
    Photos,
    /// One image per time, from cameras that follow one path.
    OneMovingCamera,
    /// One image per time, from poses that have nothing to do with each other (rendered benchmarks).
    OneCameraAnywhere,
    /// Several cameras at a time, around the scene.
    Dome,
    /// Several cameras at a time, on one side of the scene.
    Rig,
}

impl Arrangement {
    /// Its name in words.
    pub fn describe(self) -> &'static str {
        match self {
            Self::Photos => "photos of a static scene",
            Self::OneMovingCamera => "one moving camera",
            Self::OneCameraAnywhere => "one camera at a time, from unrelated poses",
            Self::Dome => "cameras around the scene",
            Self::Rig => "cameras on one side of the scene",
        }
    }
    /// Whether several cameras share a time.
    pub fn has_several_cameras(self) -> bool {
        matches!(self, Self::Dome | Self::Rig)
    }
}

/// What is known of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Facts {
    /// How the cameras stand.
    pub arrangement: Arrangement,
    /// Training images.
    pub views: usize,
    /// Training cameras; a moving camera counts once per pose.
    pub cameras: usize,
    /// Frames of the sequence.
    pub frames: usize,
    /// Width and height in pixels of the median training image.
    pub size: [u32; 2],
    /// Points that the dataset brings along.
    pub points: usize,
    /// Share of transparent pixels.
    pub transparent: f32,
    /// Colour behind everything, where images have a plain background, RGB in 0..1.
    pub plain: Option<[f32; 3]>,
    /// Mean colour of the images, RGB in 0..1, unless the dataset states a background.
    pub mean: Option<[f32; 3]>,
    /// Share of pixels with local contrast.
    pub detail: f32,
    /// Share of pixels that see something move, where a camera has several frames.
    pub moving: Option<f32>,
    /// Share of the frames in which a pixel that sees something move differs from its median over time, where a camera has several frames: small where things
    /// pass, up to a half where they move on the spot.
    pub occupied: Option<f32>,
    /// Standard deviation of the noise, of values in 0..1, where a camera has several frames.
    pub noise: Option<f32>,
    /// Median ratio of the mean brightness of opaque pixels between neighbouring cameras of one time, as |ln|.
    pub exposure: Option<f32>,
    /// How much of what one camera sees others see, where there is more than one pose.
    pub overlap: Option<Overlap>,
}

impl Facts {
    /// Looks at `scene`. Decodes a few dozen images.
    ///
    /// # Errors
    /// What decoding the images meets.
    pub fn of(scene: &Scene) -> Result<Self> {
        let views = scene.split(Split::Train);
        let cameras: BTreeSet<usize> = views.iter().map(|&v| scene.views[v].camera).collect();
        let mut sizes: Vec<[u32; 2]> = cameras.iter().map(|&c| [scene.cameras[c].width, scene.cameras[c].height]).collect();
        sizes.sort_unstable();
        let looked = spread_views(scene, &views, LOOKS);
        let images = looked.par_iter().map(|&view| small(scene, view)).collect::<Result<Vec<_>>>()?;
        let with_alpha = images.iter().filter(|image| image.channels == 4).map(transparent_share);
        let transparent = with_alpha.sum::<f32>() / images.len().max(1) as f32;
        let motion = Motion::of(scene, &views)?;
        Ok(Self {
            arrangement: arrangement(scene, &views),
            views: views.len(),
            cameras: cameras.len(),
            frames: scene.frame_count,
            size: sizes.get(sizes.len() / 2).copied().unwrap_or([1, 1]),
            points: scene.points.as_ref().map_or(0, |p| p.positions.len()),
            transparent,
            plain: plain_background(&images),
            mean: scene.background.is_none().then(|| mean_colour(&images)),
            detail: mean(images.iter().map(detail)).unwrap_or(0.0),
            moving: motion.as_ref().map(|m| m.moving),
            occupied: motion.as_ref().and_then(|m| m.occupied),
            noise: motion.as_ref().map(|m| m.noise),
            exposure: exposure(scene, &views)?,
            overlap: Overlap::of(scene, &views),
        })
    }
    /// Pixels of the median training image.
    pub fn pixels(&self) -> f64 {
        f64::from(self.size[0]) * f64::from(self.size[1])
    }
}

/// How the training cameras of `scene` stand.
fn arrangement(scene: &Scene, views: &[usize]) -> Arrangement {
    if scene.frame_count <= 1 {
        return Arrangement::Photos;
    }
    let mut of_frame: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    views.iter().for_each(|&v| of_frame.entry(scene.views[v].frame).or_default().push(v));
    let axis = |view: usize| DVec3::from(scene.camera(view).forward_world()).normalize_or_zero();
    let mut counts: Vec<usize> = of_frame.values().map(Vec::len).collect();
    counts.sort_unstable();
    if counts[counts.len() / 2] >= 2 {
        let axes = views.iter().map(|&v| axis(v)).sum::<DVec3>() / views.len() as f64;
        // Around the scene, axes cancel.
        return if axes.length() < 0.6 { Arrangement::Dome } else { Arrangement::Rig };
    }
    // A path turns little from frame to frame; the angle is compared with that between frames far apart.
    let path: Vec<usize> = of_frame.values().filter_map(|v| v.first().copied()).collect();
    let angle = |a: usize, b: usize| axis(path[a]).dot(axis(path[b])).clamp(-1.0, 1.0).acos();
    let mut near: Vec<f64> = (1..path.len()).map(|i| angle(i - 1, i)).collect();
    let mut far: Vec<f64> = (0..path.len()).map(|i| angle(i, (i * 7 + path.len() / 2) % path.len())).collect();
    near.sort_by(f64::total_cmp);
    far.sort_by(f64::total_cmp);
    let (near, far) = (near.get(near.len() / 2).copied().unwrap_or(0.0), far.get(far.len() / 2).copied().unwrap_or(0.0));
    if near > 0.35 * far && near > 0.1 { Arrangement::OneCameraAnywhere } else { Arrangement::OneMovingCamera }
}

fn small(scene: &Scene, view: usize) -> Result<Image8> {
    let image = scene.frame(view)?;
    if image.width <= WIDTH {
        return Ok(image.as_ref().clone());
    }
    let height = (u64::from(image.height) * u64::from(WIDTH)).div_ceil(u64::from(image.width)).max(1);
    Ok(resize(&image, WIDTH, height as u32))
}

/// Grey values in 0..1 of opaque pixels; transparent ones are 0.
fn grey(image: &Image8) -> Vec<f32> {
    let c = image.channels as usize;
    let opacity = |p: &[u8]| if c == 4 { f32::from(p[3]) / 255.0 } else { 1.0 };
    image.data.chunks_exact(c).map(|p| opacity(p) * (f32::from(p[0]) + f32::from(p[1]) + f32::from(p[2])) / 765.0).collect()
}

fn transparent_share(image: &Image8) -> f32 {
    let pixels = image.data.chunks_exact(4);
    let count = pixels.len().max(1);
    pixels.filter(|p| p[3] < 128).count() as f32 / count as f32
}

/// The colour of nearly all border pixels of nearly all images; for images with alpha there is none.
fn plain_background(images: &[Image8]) -> Option<[f32; 3]> {
    let border = |image: &Image8| -> Vec<[f32; 3]> {
        let (w, h) = (image.width as usize, image.height as usize);
        let at = |x: usize, y: usize| [0, 1, 2].map(|k| f32::from(image.data[(y * w + x) * 3 + k]) / 255.0);
        (0..w).flat_map(|x| [at(x, 0), at(x, h - 1)]).chain((0..h).flat_map(|y| [at(0, y), at(w - 1, y)])).collect()
    };
    if images.is_empty() || images.iter().any(|image| image.channels != 3) {
        return None;
    }
    let all: Vec<[f32; 3]> = images.iter().flat_map(border).collect();
    let median = |k: usize| {
        let mut values: Vec<f32> = all.iter().map(|c| c[k]).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let colour = [median(0), median(1), median(2)];
    let like = all.iter().filter(|c| (0..3).map(|k| (c[k] - colour[k]).abs()).sum::<f32>() < 3.0 * PLAIN).count();
    (like as f32 >= PLAIN_SHARE * all.len() as f32).then_some(colour)
}

/// Mean colour of all pixels; transparent ones count with the colour that is stored.
fn mean_colour(images: &[Image8]) -> [f32; 3] {
    let (mut sums, mut count) = ([0.0f64; 3], 0usize);
    for image in images {
        for pixel in image.data.chunks_exact(image.channels.max(3) as usize) {
            (0..3).for_each(|k| sums[k] += f64::from(pixel[k]));
            count += 1;
        }
    }
    // Three digits: the plan is read by people.
    sums.map(|sum| ((sum / 0.255 / count.max(1) as f64).round() / 1e3) as f32)
}

/// Share of pixels whose 3x3 surroundings have contrast.
fn detail(image: &Image8) -> f32 {
    let (w, h) = (image.width as usize, image.height as usize);
    if w < 3 || h < 3 {
        return 0.0;
    }
    let grey = grey(image);
    let contrast = |x: usize, y: usize| {
        let window = (0..9).map(|i| grey[(y + i / 3 - 1) * w + x + i % 3 - 1]);
        let (sum, squares) = window.fold((0.0, 0.0), |(s, q), v| (s + v, q + v * v));
        (squares / 9.0 - (sum / 9.0) * (sum / 9.0)).max(0.0).sqrt()
    };
    let inner = (1..h - 1).flat_map(|y| (1..w - 1).map(move |x| (x, y)));
    inner.filter(|&(x, y)| contrast(x, y) > DETAIL).count() as f32 / ((w - 2) * (h - 2)) as f32
}

/// What differs over time in the images of fixed cameras.
struct Motion {
    moving: f32,
    occupied: Option<f32>,
    noise: f32,
}

impl Motion {
    fn of(scene: &Scene, views: &[usize]) -> Result<Option<Self>> {
        let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        views.iter().for_each(|&v| of_camera.entry(scene.views[v].camera).or_default().push(v));
        let sequences: Vec<&Vec<usize>> = of_camera.values().filter(|v| v.len() >= 2).collect();
        let (mut noises, mut shares, mut occupied) = (Vec::new(), Vec::new(), Vec::new());
        for sequence in spread_from_first(&sequences, MOTION_LOOKS[0]) {
            let looked = spread_from_first(sequence, MOTION_LOOKS[1]);
            let frames = looked.into_iter().map(|view| small(scene, view).map(|image| grey(&image))).collect::<Result<Vec<_>>>()?;
            let n = frames.len() as f32;
            let deviations: Vec<f32> = (0..frames[0].len())
                .map(|p| {
                    let (sum, squares) = frames.iter().fold((0.0, 0.0), |(s, q), f| (s + f[p], q + f[p] * f[p]));
                    (squares / n - (sum / n) * (sum / n)).max(0.0).sqrt()
                })
                .collect();
            let mut sorted = deviations.clone();
            sorted.sort_by(f32::total_cmp);
            // Most pixels of a fixed camera see nothing move, so the lower quartile is noise; averaging on the way to small images has lowered it.
            let noise = sorted[sorted.len() / 4];
            let threshold = MOTION.max(MOTION_OVER_NOISE * noise);
            noises.push(noise);
            let moving: Vec<usize> = (0..deviations.len()).filter(|&p| deviations[p] > threshold).collect();
            shares.push(moving.len() as f32 / deviations.len() as f32);
            occupied.extend(moving.into_iter().map(|p| {
                let mut values: Vec<f32> = frames.iter().map(|f| f[p]).collect();
                values.sort_by(f32::total_cmp);
                let median = values[values.len() / 2];
                values.iter().filter(|v| (*v - median).abs() > threshold).count() as f32 / n
            }));
        }
        noises.sort_by(f32::total_cmp);
        let occupied = mean(occupied.into_iter());
        Ok(mean(shares.into_iter()).map(|moving| Self { moving, occupied, noise: noises[noises.len() / 2] }))
    }
}

/// Mean grey value in 0..1 of the opaque part of an image, pixels weighted by their opacity, so that it does not depend on how much of the image the foreground
/// covers; `None` where there is hardly any.
fn brightness(image: &Image8) -> Option<f32> {
    let grey = mean(grey(image).into_iter())?;
    if image.channels != 4 {
        return Some(grey);
    }
    let opacity = mean(image.data.chunks_exact(4).map(|p| f32::from(p[3]) / 255.0))?;
    (opacity >= LEAST_OPAQUE).then_some(grey / opacity)
}

/// Median |ln| of the ratio of [`brightness`] between each camera and its nearest neighbour at the same time; `None` where few neighbours see the same.
fn exposure(scene: &Scene, views: &[usize]) -> Result<Option<f32>> {
    let first = views.iter().map(|&v| scene.views[v].frame).min().unwrap_or(0);
    let of_first: Vec<usize> = views.iter().copied().filter(|&v| scene.views[v].frame == first).take(2 * LOOKS).collect();
    if of_first.len() < 3 {
        return Ok(None);
    }
    let levels = of_first.par_iter().map(|&v| small(scene, v).map(|image| brightness(&image))).collect::<Result<Vec<_>>>()?;
    let center = |i: usize| DVec3::from(scene.camera(of_first[i]).center_world());
    let axis = |i: usize| DVec3::from(scene.camera(of_first[i]).forward_world()).normalize_or_zero();
    let mut ratios: Vec<f32> = (0..of_first.len())
        .filter_map(|i| {
            let own = levels[i]?;
            let others = (0..of_first.len()).filter_map(|j| levels[j].filter(|_| j != i).map(|level| (j, level)));
            let (nearest, other) = others.min_by(|(a, _), (b, _)| center(*a).distance(center(i)).total_cmp(&center(*b).distance(center(i))))?;
            if axis(i).dot(axis(nearest)) < ALIKE_AXES {
                return None;
            }
            let ratio = (own.max(1e-3) / other.max(1e-3)).ln().abs();
            ratio.is_finite().then_some(ratio)
        })
        .collect();
    ratios.sort_by(f32::total_cmp);
    Ok((2 * ratios.len() >= of_first.len()).then(|| ratios.get(ratios.len() / 2).copied()).flatten())
}

fn mean(values: impl Iterator<Item = f32>) -> Option<f32> {
    let (sum, count) = values.fold((0.0f64, 0u64), |(sum, count), v| (sum + f64::from(v), count + 1));
    (count > 0).then(|| (sum / count as f64) as f32)
}

#[cfg(test)]
mod tests;
