//! The first Gaussians: from the dataset's points, from photo-consistent points, or at random.

use crate::config::{InitSource, RunConfig};
use crate::knn::mean_squared_distance_3nn;
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Error, Event, EventSink, HostGaussians, PointCloud, Result, Scene, Seed, Split};
use rand::Rng;
use rand::seq::SliceRandom;

/// The degree-0 basis function of spherical harmonics.
pub const SH_C0: f32 = 0.282_094_8;

/// Gaussians for `scene` as `config.init` wants them, at most `init.count`.
pub fn initialise(scene: &Scene, config: &RunConfig, seed: Seed, events: &dyn EventSink) -> Result<HostGaussians> {
    let count = config.init.count.min(config.limits.max_gaussians as usize);
    let shared_time = {
        let mut cameras_of_frame = std::collections::BTreeMap::new();
        for view in scene.split(Split::Train) {
            *cameras_of_frame.entry(scene.views[view].frame).or_insert(0usize) += 1;
        }
        cameras_of_frame.values().copied().max().unwrap_or(0) >= 4
    };
    let source = match (config.init.source, &scene.points) {
        (InitSource::Auto, Some(points)) if !points.positions.is_empty() => InitSource::Points,
        (InitSource::Auto, _) if shared_time => InitSource::Photo,
        (InitSource::Auto, _) => InitSource::Random,
        (other, _) => other,
    };
    let points = match source {
        InitSource::Points => {
            scene.points.clone().ok_or_else(|| Error::parameter("init.source", "the scene has no points", "Use init.source = \"photo\" or \"random\""))?
        }
        InitSource::Photo => crate::data::init::photo_points(scene, count, seed.child("photo"))?,
        _ => random_points(scene, count, seed.child("random"))?,
    };
    let points = thin(points, count, seed.child("thin"));
    if points.positions.is_empty() {
        return Err(Error::data(&scene.name, format!("init.source = {source:?} found no points"), "Use init.source = \"random\""));
    }
    events.emit(&Event::Progress {
        task: format!("initial Gaussians ({})", format!("{source:?}").to_lowercase()),
        done: points.positions.len() as u64,
        total: points.positions.len() as u64,
    });
    Ok(from_points(&points, config.train.sh_degree, config.init.opacity))
}

/// Gaussians at `points`: isotropic with the root of the mean squared distance to three neighbours, `opacity`, no rotation.
pub fn from_points(points: &PointCloud, sh_degree: usize, opacity: f32) -> HostGaussians {
    let n = points.positions.len();
    let logit = (opacity / (1.0 - opacity)).ln();
    let mut host = HostGaussians {
        sh_degree,
        opacity_logits: vec![logit; n],
        sh_rest: vec![0.0; n * 3 * sh_rest_len(sh_degree)],
        dynamic_scores: vec![0.0; n],
        ..Default::default()
    };
    for (i, d) in mean_squared_distance_3nn(&points.positions).into_iter().enumerate() {
        host.means.extend(points.positions[i]);
        host.log_scales.extend([d.max(1e-7).sqrt().ln(); 3]);
        host.quaternions.extend([1.0, 0.0, 0.0, 0.0]);
        host.sh_dc.extend(points.colors[i].map(|c| (c - 0.5) / SH_C0));
    }
    host
}

fn random_points(scene: &Scene, count: usize, seed: Seed) -> Result<PointCloud> {
    let Some((low, high)) = scene.init_box else {
        return Err(Error::data(&scene.name, "the reader found no box to place random points in", "Give the scene initial points"));
    };
    let mut rng = seed.rng();
    let positions = (0..count).map(|_| std::array::from_fn(|k| low[k] + (high[k] - low[k]) * rng.random::<f32>())).collect();
    let colors = (0..count).map(|_| std::array::from_fn(|_| rng.random::<f32>() / 255.0 * SH_C0 + 0.5)).collect();
    Ok(PointCloud { positions, colors })
}

fn thin(points: PointCloud, count: usize, seed: Seed) -> PointCloud {
    if points.positions.len() <= count {
        return points;
    }
    let mut order: Vec<usize> = (0..points.positions.len()).collect();
    order.shuffle(&mut seed.rng());
    order.truncate(count);
    order.sort_unstable();
    PointCloud { positions: order.iter().map(|&i| points.positions[i]).collect(), colors: order.iter().map(|&i| points.colors[i]).collect() }
}
