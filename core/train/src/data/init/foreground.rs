//! Foreground masks: the dataset's, else transparency, else whatever differs from a plain background.

use super::views::{Foreground, Level, WorkView};
use rayon::prelude::*;

/// Share of transparent pixels over all images from which alpha says where the scene is.
const MIN_TRANSPARENT: f64 = 0.02;
/// Largest difference of a channel, 0..1, from the plain background's colour.
const PLAIN: f32 = 0.06;
/// Share of the border pixels of all images that show the plain background. Things may stand in the border of some.
const MIN_PLAIN: f64 = 0.9;

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
    views.par_iter_mut().for_each(|v| v.mask = Some(before(v.fine(), color)));
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
    let plain = pixels.iter().filter(|p| near(p, color)).count();
    (!pixels.is_empty() && plain as f64 >= MIN_PLAIN * pixels.len() as f64).then_some(color)
}

fn near(pixel: &[f32; 3], color: [f32; 3]) -> bool {
    (0..3).all(|k| (pixel[k] - color[k]).abs() <= PLAIN)
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
    let mut open: Vec<usize> = border(level).filter(|&p| near(&level.rgb[p], color)).collect();
    open.iter().for_each(|&p| mask[p] = false);
    while let Some(p) = open.pop() {
        let (x, y) = (p % w, p / w);
        let around = [(x > 0).then(|| p - 1), (x + 1 < w).then(|| p + 1), (y > 0).then(|| p - w), (y + 1 < h).then(|| p + w)];
        for q in around.into_iter().flatten() {
            if mask[q] && near(&level.rgb[q], color) {
                mask[q] = false;
                open.push(q);
            }
        }
    }
    mask
}
