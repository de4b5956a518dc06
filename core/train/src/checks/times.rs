//! Whether the times of the images can be right: one image per camera and time, frames in order.

use super::{Finding, Severity, Subject, small_gray};
use crate::sample::spread;
use cc4dgs_core::{Result, Scene, Split};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Pixels of the small images that are compared.
const PIXELS: f64 = 3_000.0;
/// The most groups of images of one pose and time that are looked at.
const GROUPS: usize = 8;
/// Images differ where more than this share of the pixels ...
const DIFFERENT_SHARE: f64 = 0.005;
/// ... differs by this much, grey in 0..1, after gain and offset are undone.
const DIFFERENT: f32 = 0.05;
/// Fixed cameras whose frames are compared.
const CAMERAS: usize = 2;
/// Consecutive frames of a camera that are compared, at least and at most.
const FRAMES: (usize, usize) = (12, 24);
/// Frames are in order if images at some constant distance in time differ by less than this share of the usual difference ...
const IN_ORDER: f64 = 0.7;
/// ... and could be in order if each image has another that differs by less than this share.
const ORDERABLE: f64 = 0.55;

/// Times that cannot be right.
pub(super) fn check(scene: &Scene, background: [f32; 3]) -> Result<Vec<Finding>> {
    Ok([same_time(scene, background)?, out_of_order(scene, background)?].into_iter().flatten().collect())
}

/// Images of one pose at one time that show different things.
fn same_time(scene: &Scene, background: [f32; 3]) -> Result<Option<Finding>> {
    let train = scene.split(Split::Train);
    let mut groups: BTreeMap<(Vec<i64>, usize), Vec<usize>> = BTreeMap::new();
    for &view in &train {
        let pose = scene.camera(view).world_to_camera.iter().flatten().map(|v| (v * 1e7).round() as i64).collect();
        groups.entry((pose, scene.views[view].frame)).or_default().push(view);
    }
    let groups: Vec<Vec<usize>> = groups.into_values().filter(|views| views.len() > 1).collect();
    let sampled: Vec<&Vec<usize>> = spread(&(0..groups.len()).collect::<Vec<_>>(), GROUPS).into_iter().map(|g| &groups[g]).collect();
    let differing = sampled
        .into_par_iter()
        .map(|views| {
            let images = spread(views, 4).into_iter().map(|v| Ok(small_gray(&*scene.frame(v)?, PIXELS, background).2)).collect::<Result<Vec<_>>>()?;
            Ok(images[1..].iter().any(|other| differ(&images[0], other)).then_some(views))
        })
        .collect::<Result<Vec<_>>>()?;
    let Some(worst) = differing.into_iter().flatten().max_by_key(|views| views.len()) else { return Ok(None) };
    let problem = format!(
        "{} images of camera {} are at time {} and show different things, so their times are missing or wrong",
        worst.len(),
        scene.camera(worst[0]).name,
        scene.views[worst[0]].time_norm
    );
    let remedy = "Give each image of a camera a time of its own (the time key of transforms.json, one folder or index per instant)";
    let of_groups: usize = groups.iter().map(Vec::len).sum();
    let severity = if 2 * of_groups > train.len() { Severity::Refuse } else { Severity::Doubt };
    Ok(Some(Finding::new(severity, Subject::Times, problem, remedy)))
}

/// Whether two images of one size differ by more than brightness, contrast and noise.
fn differ(a: &[f32], b: &[f32]) -> bool {
    if a.len() != b.len() {
        return true;
    }
    let statistics = |v: &[f32]| {
        let n = v.len().max(1) as f32;
        let mean = v.iter().sum::<f32>() / n;
        (mean, (v.iter().map(|x| (x - mean) * (x - mean)).sum::<f32>() / n).sqrt())
    };
    let ((mean_a, deviation_a), (mean_b, deviation_b)) = (statistics(a), statistics(b));
    let gain = if deviation_b > 1e-3 { (deviation_a / deviation_b).clamp(0.5, 2.0) } else { 1.0 };
    let other = a.iter().zip(b).filter(|(x, y)| ((*x - mean_a) - gain * (*y - mean_b)).abs() > DIFFERENT).count();
    other as f64 > DIFFERENT_SHARE * a.len() as f64
}

/// Fixed cameras whose neighbouring frames are no more alike than distant ones, although each frame has one it is like.
fn out_of_order(scene: &Scene, background: [f32; 3]) -> Result<Option<Finding>> {
    let mut of_camera: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for view in scene.split(Split::Train) {
        of_camera.entry(scene.views[view].camera).or_default().push(view);
    }
    of_camera.retain(|_, views| views.len() >= FRAMES.0);
    for camera in spread(&of_camera.keys().copied().collect::<Vec<_>>(), CAMERAS) {
        let views = &of_camera[&camera];
        let images =
            views[..views.len().min(FRAMES.1)].par_iter().map(|&v| Ok(small_gray(&*scene.frame(v)?, PIXELS, background).2)).collect::<Result<Vec<_>>>()?;
        if !shuffled(&images) {
            return Ok(None);
        }
    }
    Ok((!of_camera.is_empty()).then(|| {
        let problem = "neighbouring frames of fixed cameras are no more alike than distant ones: the frames are probably out of order";
        Finding::doubt(Subject::Times, problem, "Check the times, and file names that sort as 1, 10, 2")
    }))
}

/// Whether the images of a sequence could be put in a better order.
fn shuffled(images: &[Vec<f32>]) -> bool {
    let n = images.len();
    let distance = |i: usize, j: usize| -> f64 { images[i].iter().zip(&images[j]).map(|(a, b)| f64::from((a - b) * (a - b))).sum::<f64>().sqrt() };
    let table: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| distance(i, j)).collect()).collect();
    let mut all: Vec<f64> = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| table[i][j]).collect();
    all.sort_by(f64::total_cmp);
    let usual = all.get(all.len() / 2).copied().unwrap_or(0.0);
    if usual <= 0.0 {
        return false;
    }
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64 / usual;
    // Motion that repeats is in order too.
    let in_order = (1..=n / 3).map(|lag| mean((lag..n).map(|i| table[i][i - lag]).collect())).fold(f64::INFINITY, f64::min);
    let nearest = mean((0..n).map(|i| (0..n).filter(|&j| j != i).map(|j| table[i][j]).fold(f64::INFINITY, f64::min)).collect());
    in_order > IN_ORDER && nearest < ORDERABLE
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bright bar at a position of a dark image.
    fn bar(at: usize) -> Vec<f32> {
        (0..400).map(|i: usize| 1.0 / (1.0 + (i.abs_diff(at) as f32 / 20.0).powi(2))).collect()
    }

    #[test]
    fn order_is_told_from_disorder_repetition_and_noise() {
        let ordered: Vec<Vec<f32>> = (0..16).map(|i| bar(20 * i)).collect();
        let strided: Vec<Vec<f32>> = (0..16).map(|i| bar(20 * (i * 7 % 16))).collect();
        let scrambled: Vec<Vec<f32>> = [3, 11, 0, 8, 14, 5, 1, 12, 7, 15, 2, 9, 4, 13, 6, 10].iter().map(|&i| bar(20 * i)).collect();
        let repeated: Vec<Vec<f32>> = (0..16).map(|i| bar([0, 150, 300, 150][i % 4])).collect();
        let noise: Vec<Vec<f32>> =
            (0..16u64).map(|i| (0..400u64).map(|k| ((i * 400 + k).wrapping_mul(2_654_435_761) % 997) as f32 / 997.0).collect()).collect();
        let still = vec![bar(50); 16];
        assert!(shuffled(&scrambled) && shuffled(&strided));
        for (name, images) in [("ordered", ordered), ("repeated", repeated), ("noise", noise), ("still", still)] {
            assert!(!shuffled(&images), "{name}");
        }
    }

    #[test]
    fn brightness_is_no_difference_and_motion_is() {
        let brighter: Vec<f32> = bar(100).iter().map(|v| 0.1 + 0.8 * v).collect();
        assert!(!differ(&bar(100), &brighter));
        assert!(differ(&bar(100), &bar(130)));
    }
}
