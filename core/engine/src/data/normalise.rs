//! The normalised frame: what the cameras look at is the origin, and they stand about four units away.
//!
//! Near planes, paddings, thresholds and the sizes fields begin with are numbers of this frame, so that a scene trains equally well whatever its unit and origin.
//! Four units is where the cameras of D-NeRF's scenes are, which those numbers were first chosen for.

use super::focus::focus;
use cc4dgs_core::{RawScene, Similarity, Split};
use glam::DVec3;

/// Distance of the median camera from the origin of the normalised frame.
pub(super) const CAMERA_DISTANCE: f64 = 4.0;
/// The most cameras and points that are asked how far away the points are.
const SAMPLE: [usize; 2] = [64, 2000];

/// The map from the dataset's coordinates to the normalised frame, judged from all cameras the dataset trains on, whatever the options choose of them.
pub(super) fn normalisation(raw: &RawScene) -> Similarity {
    let mut used = vec![false; raw.cameras.len()];
    let train = raw.views.iter().filter(|v| v.split == Split::Train);
    train.for_each(|v| used[v.camera] = true);
    if !used.contains(&true) {
        used.fill(true);
    }
    let chosen = raw.cameras.iter().zip(used).filter(|(_, used)| *used).map(|(camera, _)| camera.pinhole());
    let rays: Vec<(DVec3, DVec3)> = chosen
        .filter(|camera| camera.validate().is_ok())
        .map(|camera| (DVec3::from(camera.center_world()), DVec3::from(camera.forward_world()).normalize_or_zero()))
        .collect();
    let found = focus(&rays, depth_hint(raw, &rays));
    // Where nothing says how long a unit is, it stays as it is.
    let scale = found.distance.map_or(1.0, |d| CAMERA_DISTANCE / d);
    let map = Similarity::centred(found.point.to_array(), scale);
    if map.validate("normalisation").is_ok() { map } else { Similarity::IDENTITY }
}

/// How far ahead of the cameras the scene is, from its points or its box: the median over cameras of the median depth, which a few points at the horizon or
/// a few odd cameras do not move.
fn depth_hint(raw: &RawScene, rays: &[(DVec3, DVec3)]) -> Option<f64> {
    let places: Vec<DVec3> = match (&raw.points, raw.init_box) {
        (Some(points), _) if !points.positions.is_empty() => every(&points.positions, SAMPLE[1]).map(|p| DVec3::from(*p)).collect(),
        (_, Some(cc4dgs_core::InitBox::Corners { low, high })) => vec![0.5 * (DVec3::from(low) + DVec3::from(high))],
        _ => return None,
    };
    let depths = every(rays, SAMPLE[0]).filter_map(|(c, d)| median(places.iter().map(|p| (*p - *c).dot(*d)).filter(|z| *z > 0.0).collect()));
    median(depths.collect()).filter(|d| d.is_finite())
}

fn every<T>(items: &[T], most: usize) -> impl Iterator<Item = &T> {
    items.iter().step_by(items.len().div_ceil(most).max(1))
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
