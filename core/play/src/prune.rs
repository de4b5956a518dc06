//! Removal of the Gaussians that contribute least to images, over all views and times, under a budget of PSNR.

use crate::codec_services::{ModelServices, SceneViews};
use crate::model::Model;
use burn::tensor::Device;
use cc4dgs_core::{Camera, Error, Event, EventSink, HostGaussians, Registry, RenderModel, Result, Scene, Seed, Split, TrainingViews, psnr_on_views};
use serde::Serialize;

/// Training views from which contributions are taken.
const VIEWS: usize = 64;
/// Views on which PSNR is measured.
const JUDGES: usize = 32;
/// Bisection steps of the share that is removed.
const STEPS: usize = 8;

/// What was removed, and what it cost.
#[derive(Clone, Debug, Serialize)]
pub struct PruneReport {
    /// Gaussians before.
    pub before: usize,
    /// Gaussians after.
    pub after: usize,
    /// PSNR in dB before, on the judged views.
    pub psnr_before_db: f64,
    /// PSNR in dB after.
    pub psnr_after_db: f64,
    /// PSNR in dB of all Gaussians after one re-fit, nothing removed: what training alone gives. Missing without re-fit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_refit_alone_db: Option<f64>,
    /// Which views judged ([`Scene::judging_split`]).
    pub judged_by: Split,
    /// Number of those views.
    pub views: usize,
}

/// Contribution of each Gaussian: the mean over training views, at their times, of the sum over pixels of its squared blending weight (with what shines through
/// it).
pub fn contributions(model: &Model, scene: &Scene, registry: &Registry, device: &Device, events: &dyn EventSink) -> Result<Vec<f64>> {
    // Without Gaussians there is nothing to differentiate by.
    if model.gaussians.is_empty() {
        return Ok(Vec::new());
    }
    let services = ModelServices::new(model, registry, device)?;
    let views = SceneViews::new(scene);
    let chosen = views.len().min(VIEWS);
    let seed = Seed::root(model.provenance.seed).child("prune");
    let mut sum = vec![0.0; model.gaussians.len()];
    let shown: Vec<(&Camera, f32)> = (0..chosen).map(|k| views.view(k * views.len() / chosen)).collect();
    services.squared_derivatives_in_views(&model.gaussians, &shown, seed, &mut |k, found, _| {
        for (sum, row) in sum.iter_mut().zip(found.sh_dc.chunks_exact(3)) {
            *sum += row.iter().map(|&v| f64::from(v)).sum::<f64>() / chosen as f64;
        }
        events.emit(&Event::Progress { task: "contributions".into(), done: k as u64 + 1, total: chosen as u64 });
        Ok(())
    })?;
    Ok(sum)
}

/// The rows of Gaussians, those of the largest contribution first; equal ones in their order.
pub fn by_contribution(contribution: &[f64]) -> Vec<usize> {
    let mut rows: Vec<usize> = (0..contribution.len()).collect();
    rows.sort_by(|&a, &b| contribution[b].total_cmp(&contribution[a]).then(a.cmp(&b)));
    rows
}

/// `gaussians` at `rows`, in their old order.
pub fn at_rows(gaussians: &HostGaussians, rows: &[usize]) -> HostGaussians {
    let mut rows = rows.to_vec();
    rows.sort_unstable();
    gaussians.select(&rows)
}

/// Removes as many Gaussians from `model` as lower the PSNR by at most `max_drop_db`, those of the least contribution first.
///
/// # Errors
/// [`Error::Parameter`] for a scene without training views or a drop that is not positive, and what the scene and the rasterizer report.
pub fn prune(model: &mut Model, scene: &Scene, max_drop_db: f64, registry: &Registry, device: &Device, events: &dyn EventSink) -> Result<PruneReport> {
    if !(max_drop_db > 0.0 && max_drop_db.is_finite()) {
        return Err(Error::parameter("prune", format!("a drop of {max_drop_db} dB"), "Allow a positive number of dB, such as 0.1"));
    }
    let (judged_by, judges) = (scene.judging_split(), SceneViews::judging(scene));
    if SceneViews::new(scene).is_empty() || judges.is_empty() {
        return Err(Error::parameter("prune", format!("{} has no training views", scene.name), "Give the scene that the model was trained on"));
    }
    let contribution = contributions(model, scene, registry, device, events)?;
    let order = by_contribution(&contribution);
    let kept = |count: usize| at_rows(&model.gaussians, &order[..count]);
    let n = order.len();
    let services = ModelServices::new(model, registry, device)?;
    let psnr_before_db = psnr_on_views(&model.gaussians, &judges, &services, JUDGES)?;
    // The fewest that are known to suffice, and the most that are known not to.
    let (mut enough, mut too_few, mut psnr_after_db) = (n, 0usize, psnr_before_db);
    for step in 0..STEPS {
        let count = (enough + too_few) / 2;
        if count == enough || count == too_few {
            break;
        }
        let found = psnr_on_views(&kept(count), &judges, &services, JUDGES)?;
        if psnr_before_db - found <= max_drop_db {
            (enough, psnr_after_db) = (count, found);
        } else {
            too_few = count;
        }
        events.emit(&Event::Progress { task: "share to remove".into(), done: step as u64 + 1, total: STEPS as u64 });
    }
    let rest = kept(enough);
    drop(services);
    if enough < n {
        model.gaussians = rest;
        model.size = model.float32_size();
    }
    let views = judges.len().min(JUDGES);
    Ok(PruneReport { before: n, after: enough, psnr_before_db, psnr_after_db, psnr_refit_alone_db: None, judged_by, views })
}
