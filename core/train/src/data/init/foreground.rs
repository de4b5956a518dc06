//! Foreground masks: the dataset's, else transparency, else whatever differs from a plain background.

use super::views::{Foreground, Level, WorkView};
use rayon::prelude::*;

/// Share of transparent pixels over all images from which alpha says where the scene is.
const MIN_TRANSPARENT: f64 = 0.02;
/// Largest difference of a channel, 0..1, from the plain background's colour for a pixel to be background.
const PLAIN: f32 = 0.06;
/// The same for most of the border of the images: dim rooms differ little from black.
const PLAIN_BORDER: f32 = 0.02;
/// Share of the border pixels of all images that show the plain background. Things may stand in the border of some.
const MIN_PLAIN: f64 = 0.9;
/// Share of all pixels that the plain background covers. Lenses that are undone leave a thin border of one colour.
const MIN_AREA: f64 = 0.15;

/// Finds out what says where the foreground is, and fills the masks of `views`.
pub(super) fn find(views: &mut [WorkView]) -> Foreground {
    if views.iter().any(|v| v.mask.is_some()) {
        return Foreground::Part;
    }
    let alpha: Vec<&bool> = views.iter().filter_map(|v| v.opaque.as_ref()).flatten().collect();
    let transparent = alpha.iter().filter(|o| !***o).count();
    if !alpha.is_empty() && transparent as f64 > MIN_TRANSPARENT * alpha.len() as f64 {
        views.iter_mut().for_each(|v| v.mask = v.opaque.clone());
        return Foreground::Whole;
    }
    let Some(color) = plain_color(views) else { return Foreground::Unknown };
    let masks: Vec<Vec<bool>> = views.par_iter().map(|v| before(v.fine(), color)).collect();
    let (background, pixels) = (masks.iter().flatten().filter(|m| !**m).count(), masks.iter().map(Vec::len).sum::<usize>());
    if (background as f64) < MIN_AREA * pixels as f64 {
        return Foreground::Unknown;
    }
    views.iter_mut().zip(masks).for_each(|(v, mask)| v.mask = Some(mask));
    Foreground::Whole
}

/// The colour of the background, if nearly all border pixels of all images have one.
fn plain_color(views: &[WorkView]) -> Option<[f32; 3]> {
    let pixels: Vec<[f32; 3]> = views.iter().flat_map(|v| border(v.fine()).map(|p| v.fine().rgb[p])).collect();
    let color: [f32; 3] = std::array::from_fn(|k| {
        let mut values: Vec<f32> = pixels.iter().map(|p| p[k]).collect();
        values.sort_by(f32::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    });
    let plain = pixels.iter().filter(|p| near(p, color, PLAIN_BORDER)).count();
    (!pixels.is_empty() && plain as f64 >= MIN_PLAIN * pixels.len() as f64).then_some(color)
}

fn near(pixel: &[f32; 3], color: [f32; 3], most: f32) -> bool {
    (0..3).all(|k| (pixel[k] - color[k]).abs() <= most)
}

/// Indices of the outermost pixels.
fn border(level: &Level) -> impl Iterator<Item = usize> + use<> {
    let (w, h) = (level.width, level.height);
    (0..w * h).filter(move |p| p % w == 0 || p % w == w - 1 || p / w == 0 || p / w == h - 1)
}

/// The pixels that the background does not reach from the border: parts of the scene that happen to have its colour stay.
fn before(level: &Level, color: [f32; 3]) -> Vec<bool> {
    let (w, h) = (level.width, level.height);
    let mut mask = vec![true; w * h];
    let mut open: Vec<usize> = border(level).filter(|&p| near(&level.rgb[p], color, PLAIN)).collect();
    open.iter().for_each(|&p| mask[p] = false);
    while let Some(p) = open.pop() {
        let (x, y) = (p % w, p / w);
        let around = [(x > 0).then(|| p - 1), (x + 1 < w).then(|| p + 1), (y > 0).then(|| p - w), (y + 1 < h).then(|| p + w)];
        for q in around.into_iter().flatten() {
            if mask[q] && near(&level.rgb[q], color, PLAIN) {
                mask[q] = false;
                open.push(q);
            }
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3};

    /// A white image of 12x12 pixels with a dark frame of a square, white inside.
    fn view(alpha: Option<u8>) -> WorkView {
        let dark = |p: usize| [p % 12, p / 12].iter().all(|c| (3..9).contains(c)) && ![p % 12, p / 12].iter().all(|c| (4..8).contains(c));
        let rgb = (0..144).map(|p| if dark(p) { [0.2; 3] } else { [1.0; 3] }).collect();
        let level = Level { width: 12, height: 12, gray: vec![0.0; 144], rgb, k: DMat3::IDENTITY };
        WorkView {
            levels: vec![level],
            rotation: DMat3::IDENTITY,
            translation: DVec3::ZERO,
            center: DVec3::ZERO,
            partners: Vec::new(),
            witnesses: Vec::new(),
            depth_range: [1.0, 2.0],
            mask: None,
            opaque: alpha.map(|a| (0..144).map(|p| p >= 30 || a > 127).collect()),
        }
    }

    #[test]
    fn a_plain_background_is_found_from_the_border_in() {
        let mut views = vec![view(None), view(None)];
        assert_eq!(find(&mut views), Foreground::Whole);
        let mask = views[1].mask.as_ref().unwrap();
        assert_eq!(mask.iter().filter(|m| **m).count(), 36, "the white inside of the square belongs to it");
        // Another colour at the border of half of the images is a background that fills them.
        views[0].levels[0].rgb.fill([0.6; 3]);
        views.iter_mut().for_each(|v| v.mask = None);
        assert_eq!(find(&mut views), Foreground::Unknown);
    }

    #[test]
    fn alpha_counts_where_something_is_transparent() {
        let mut views = vec![view(Some(0))];
        assert_eq!(find(&mut views), Foreground::Whole);
        assert_eq!(views[0].mask, views[0].opaque);
        // Opaque images say nothing; the plain border does.
        let mut views = vec![view(Some(255))];
        assert_eq!(find(&mut views), Foreground::Whole);
        assert_ne!(views[0].mask, views[0].opaque);
    }
}
