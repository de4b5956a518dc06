//! The images of key frames as they are kept once they were matched: eight bits per channel, and smaller where there are very many.

use super::super::views::{Level, WorkSet, WorkView};
use crate::data::resize;
use cc4dgs_core::Image8;
use glam::{DMat3, DVec3, Vec3};
use rayon::prelude::*;

/// The most bytes of the images of all key frames and of their medians, which are compared with each other and so are kept at once.
const MOST_BYTES: usize = 512 << 20;

/// The most pixels of each of `images` that are kept at once.
pub(super) fn most_pixels(images: usize) -> usize {
    (MOST_BYTES / (3 * images.max(1))).max(1)
}

/// The images of one key frame.
pub(super) struct KeySet {
    pub views: Vec<KeyView>,
    /// Edge of the cubes that points are thinned to, and the width of the first image in pixels, both at the size that was matched.
    pub cell: f32,
    pub width: f32,
}

impl KeySet {
    /// The images of `set` with at most `pixels` pixels each.
    pub fn new(set: WorkSet, pixels: usize) -> Self {
        let (cell, width) = (set.cell_size(), set.views.first().map_or(0.0, |view| view.fine().width as f32));
        Self { views: set.views.into_par_iter().map(|view| KeyView::new(view, pixels)).collect(), cell, width }
    }
}

/// An image of a key frame.
pub(super) struct KeyView {
    /// Its camera; the one level has a size and a matrix, and no pixels.
    camera: WorkView,
    /// RGB, row by row.
    pub rgb: Vec<[u8; 3]>,
}

impl KeyView {
    /// The finest level of `view`, made smaller if it has more than `pixels` pixels.
    fn new(mut view: WorkView, pixels: usize) -> Self {
        let fine = view.fine();
        let (width, height) = (fine.width, fine.height);
        let scale = (pixels as f64 / (width * height) as f64).sqrt().min(1.0);
        let side = |n: usize| ((n as f64 * scale) as u32).max(1);
        // The values come from images of eight bits, so that nothing is lost.
        let data = fine.rgb.iter().flatten().map(|v| (v * 255.0).round() as u8).collect();
        let image = resize(&Image8 { width: width as u32, height: height as u32, channels: 3, data }, side(width), side(height));
        let shrink = DVec3::new(f64::from(image.width) / width as f64, f64::from(image.height) / height as f64, 1.0);
        let k = DMat3::from_diagonal(shrink) * fine.k;
        view.levels = vec![Level { width: image.width as usize, height: image.height as usize, gray: Vec::new(), rgb: Vec::new(), k }];
        (view.mask, view.opaque) = (None, None);
        Self { camera: view, rgb: image.data.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect() }
    }
    /// Index of the pixel that shows a world point, if any, whatever is in front of it.
    pub fn pixel_of(&self, p: Vec3) -> Option<usize> {
        self.camera.pixel_of(p)
    }
}

/// A kept pixel in 0..1.
pub(super) fn color(rgb: [u8; 3]) -> [f32; 3] {
    rgb.map(|v| f32::from(v) / 255.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 40x20 pixels whose colours say column and row, seen from the origin along z.
    fn view() -> WorkView {
        let rgb = (0..800usize).map(|p| color([(5 * (p % 40)) as u8, (10 * (p / 40)) as u8, 77])).collect();
        let k = DMat3::from_cols_array_2d(&[[20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [20.0, 10.0, 1.0]]);
        WorkView {
            levels: vec![Level { width: 40, height: 20, gray: vec![0.5; 800], rgb, k }],
            rotation: DMat3::IDENTITY,
            translation: DVec3::ZERO,
            center: DVec3::ZERO,
            partners: Vec::new(),
            witnesses: Vec::new(),
            depth_range: [1.0, 2.0],
            mask: None,
            opaque: Some(vec![true; 800]),
        }
    }

    #[test]
    fn few_images_are_kept_as_they_are() {
        let (before, kept) = (view(), KeyView::new(view(), 800));
        assert!(kept.rgb.iter().map(|&p| color(p)).eq(before.fine().rgb.iter().copied()), "equal to the bit");
        let point = Vec3::new(0.31, -0.12, 1.0);
        assert_eq!((kept.pixel_of(point), kept.camera.fine().k), (before.pixel_of(point), before.fine().k));
    }

    #[test]
    fn many_images_take_no_more_than_the_bound() {
        for images in [1, 1_000, 100_000, usize::MAX / 8] {
            assert!(most_pixels(images) == 1 || 3 * images * most_pixels(images) <= MOST_BYTES, "{images}");
        }
        assert!(most_pixels(1_500) > 96_000, "50 key frames of 29 cameras are kept at the size at which they are matched");
        let kept = KeyView::new(view(), 200);
        assert_eq!(kept.rgb.len(), 200);
        // The same point is in the pixel of the same share of the image.
        let point = Vec3::new(0.31, -0.12, 1.0);
        let full = view().pixel_of(point).unwrap();
        assert_eq!(kept.pixel_of(point), Some((full / 40 / 2) * 20 + full % 40 / 2));
        assert!(KeyView::new(view(), 1).rgb.len() == 1);
    }
}
