//! The first Gaussians: at the dataset's points, or at points found from the images.

use crate::config::{InitSource, RunConfig};
use crate::data::init::{find_points, limit_opacities, limit_sizes};
use crate::knn::mean_squared_distance_3nn;
use cc4dgs_core::gaussians::sh_rest_len;
use cc4dgs_core::{Error, Event, EventSink, HostGaussians, PointCloud, Result, Scene, Seed, plural};
use rand::seq::SliceRandom;

/// The degree-0 basis function of spherical harmonics.
pub const SH_C0: f32 = 0.282_094_8;

/// The dataset's points are enough where they are at least this share of the wanted ones; else others are looked for beside them.
const ENOUGH: f64 = 0.1;

/// Gaussians for `scene` as `config.init` wants them, at most `init.count` and `density.max_gaussians`. With `init.plain` random points are grey, and no size
/// and no opacity is limited. An [`Event::Note`] says where they come from.
///
/// # Errors
/// [`Error::Parameter`] and [`Error::Data`] where the scene has no points of that kind, and whatever decoding its images meets.
pub fn initialise(scene: &Scene, config: &RunConfig, seed: Seed, events: &dyn EventSink) -> Result<HostGaussians> {
    let most = config.density.get("max_gaussians").and_then(toml::Value::as_integer).filter(|most| *most > 0).map_or(usize::MAX, |most| most as usize);
    let count = config.init.count.min(most).min(config.limits.max_gaussians as usize);
    if most < config.init.count {
        let noun = plural(most, "Gaussian", "Gaussians");
        let message = format!("init.count is {}, over density.max_gaussians: the run begins with {most} {noun} at most", config.init.count);
        events.emit(&Event::Note { object: "initial Gaussians".into(), message });
    }
    let own = scene.points.as_ref().filter(|p| !p.positions.is_empty());
    let mut uncertain = 0..0;
    let few = own.is_some_and(|points| (points.positions.len() as f64) < ENOUGH * count as f64);
    let (mut points, mut message) = match (config.init.source, own) {
        (InitSource::Auto, Some(points)) if few => {
            let found = find_points(scene, InitSource::Auto, count - points.positions.len(), seed)?;
            let own = points.positions.len();
            let [noun, are, them] = [plural(own, "point", "points"), plural(own, "is", "are"), plural(own, "it", "them")];
            let message = format!("{own} {noun} of the dataset {are} few for {count} Gaussians; beside {them} {}", found.describe());
            let mut all = points.clone();
            all.positions.extend(found.cloud.positions);
            all.colors.extend(found.cloud.colors);
            uncertain = all.positions.len() - found.random..all.positions.len();
            (all, message)
        }
        (InitSource::Auto | InitSource::Points, Some(points)) => {
            let points = thin(points.clone(), count, seed.child("thin"));
            let message = format!("{} {} of the dataset", points.positions.len(), plural(points.positions.len(), "point", "points"));
            (points, message)
        }
        (InitSource::Points, None) => {
            return Err(Error::parameter("init.source", "the scene has no points", "Use init.source = \"auto\", \"photo\", \"hull\" or \"random\""));
        }
        (source, _) => {
            let found = find_points(scene, source, count, seed)?;
            uncertain = found.cloud.positions.len() - found.random..found.cloud.positions.len();
            let message = found.describe();
            (found.cloud, message)
        }
    };
    if points.positions.is_empty() {
        return Err(Error::data(&scene.name, format!("init.source = {:?} found no points", config.init.source), "Use init.source = \"random\""));
    }
    if config.init.plain {
        points.colors.iter_mut().skip(uncertain.start).take(uncertain.len()).for_each(|color| *color = [0.5; 3]);
    }
    let mut host = from_points(&points, config.train.sh_degree, config.init.opacity);
    if !config.init.plain {
        let capped = limit_sizes(scene, &mut host);
        if capped > 0 {
            message += &format!("; {capped} made smaller, because each would cover much of an image");
        }
        if let Some(opacity) = limit_opacities(scene, &mut host, uncertain) {
            message += &format!("; the opacity of random ones lowered to {opacity:.3}, so that they do not hide each other");
        }
    }
    events.emit(&Event::Note { object: "initial Gaussians".into(), message });
    Ok(host)
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
