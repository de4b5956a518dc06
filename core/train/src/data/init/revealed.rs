//! Surfaces that something hides at the first time: another look at a later frame of a rig that stands still.

use super::choose::{Arrangement, Choice};
use super::views::WorkSet;
use cc4dgs_core::{Scene, Split};

/// Mean difference of the channels, 0..1, from which a pixel has changed.
const CHANGED: f32 = 0.08;
/// The same up to which it stands still.
const STILL: f32 = 0.04;
/// Share of the pixels that must have been revealed to be worth the time.
const WORTH: f64 = 0.005;

/// The keys of `first` at the last frame, where only those pixels count that show something else than at the first frame and the same as half-way: background
/// that has been revealed. `None` where cameras move, frames lack cameras, or hardly anything is revealed.
pub(super) fn later_frame(scene: &Scene, first: &WorkSet) -> Option<WorkSet> {
    if first.arrangement != Arrangement::OneTime || scene.frame_count < 3 {
        return None;
    }
    let choice = Choice::new(scene);
    let cameras: Vec<usize> = choice.views.iter().map(|&v| scene.views[v].camera).collect();
    let at = |frame: usize| -> Option<Vec<usize>> {
        let view = |&camera: &usize| scene.views.iter().position(|v| v.frame == frame && v.camera == camera && v.split == Split::Train);
        cameras.iter().map(view).collect()
    };
    let (half, last) = (at(scene.frame_count / 2)?, at(scene.frame_count - 1)?);
    let load = |views: Vec<usize>| WorkSet::load(scene, Choice { views, ..Choice::new(scene) }).ok();
    let (half, mut last) = (load(half)?, load(last)?);
    last.narrow(first.box_low, first.box_high);
    let (mut revealed, mut pixels) = (0usize, 0usize);
    for ((before, between), after) in first.views.iter().zip(&half.views).zip(&mut last.views) {
        let rgb = |view: &super::views::WorkView, p: usize| view.fine().rgb[p];
        let same = |p: usize, other: &super::views::WorkView, most: f32| {
            let (a, b) = (rgb(other, p), rgb(after, p));
            (0..3).map(|k| (a[k] - b[k]).abs()).sum::<f32>() / 3.0 < most
        };
        let open = (0..after.fine().rgb.len()).map(|p| !same(p, before, CHANGED) && same(p, between, STILL) && after.solid(first.foreground, p));
        let open: Vec<bool> = open.collect();
        revealed += open.iter().filter(|o| **o).count();
        pixels += open.len();
        after.opaque = Some(open);
    }
    (revealed as f64 > WORTH * pixels as f64).then_some(last)
}
