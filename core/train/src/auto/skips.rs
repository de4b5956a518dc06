//! What the iterations of a plan leave out without a change to any image. The log of a training counts some of it after every stage.

use crate::config::{Dynamic, RunConfig};
use cc4dgs_core::{Registry, Result, split_kind};

/// Capability of deformers whose spatial half does not depend on time.
const SHARED_OVER_TIMES: &str = "cached-spatial";

/// One line of the plan, if anything is left out.
pub(super) fn describe(config: &RunConfig, registry: &Registry) -> Result<Option<String>> {
    let full = config.completed(registry)?;
    let is_on = |section: &toml::Table, key: &str| section.get(key).and_then(toml::Value::as_bool).unwrap_or(false);
    let (kind, _) = split_kind("deformer", &full.deformer)?;
    let moves = kind != "none" && full.train.dynamic != Dynamic::None;
    let shares = full.train.batch > 1 && registry.deformer(&kind)?.info.capabilities.contains(&SHARED_OVER_TIMES);
    let skips = [
        (moves && full.train.dynamic != Dynamic::All, "the deformer for Gaussians that are found to stand still (train.dynamic)"),
        (moves && shares, "the deformer's spatial half for all but one view of an iteration (train.batch)"),
        (moves && is_on(&full.deformer, "vertex_reuse"), "vertices that were decoded for another Gaussian (deformer.vertex_reuse)"),
        (is_on(&full.rasterizer, "opacity_shortcut"), "pixels where a Gaussian's alpha is below 1/255 (rasterizer.opacity_shortcut)"),
        (is_on(&full.rasterizer, "transmittance_shortcut"), "Gaussians behind pixels that have stopped (rasterizer.transmittance_shortcut)"),
    ];
    let in_force: Vec<&str> = skips.into_iter().filter_map(|(on, what)| on.then_some(what)).collect();
    Ok((!in_force.is_empty()).then(|| format!("not computed, which changes no image: {}", in_force.join("; "))))
}
