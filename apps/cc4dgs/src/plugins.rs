//! Checking the plug-ins of a configuration before anything long begins.

use cc4dgs_core::{AppearanceContext, DeformerContext, PosesContext, Registry, Result, Seed, parse_device, split_kind};
use cc4dgs_train::config::RunConfig;

/// Builds every plug-in of `config` once and drops it. A wrong setting of the deformer is reported now and not before the main stage, and no
/// folder is created for it.
///
/// # Errors
/// Those of the plug-ins: unknown names, unknown settings, values out of range; and a device that does not answer.
pub fn check(config: &RunConfig, registry: &Registry) -> Result<()> {
    let device = parse_device(&config.device)?;
    registry.build_rasterizer(&config.rasterizer)?;
    let seed = Seed::root(config.seed).child("check");
    let context = DeformerContext { box_min: [-1.0; 3], box_max: [1.0; 3], frame_count: 2, sh_degree: config.train.sh_degree, seed };
    registry.build_deformer(&config.deformer, &context, &device)?;
    registry.build_density(&config.density)?;
    registry.build_appearance(&config.appearance, &AppearanceContext { cameras: 1, seed }, &device)?;
    registry.build_poses(&config.poses, &PosesContext { cameras: 1, extent: 1.0, seed }, &device)?;
    registry.build_optimizer(&config.optimizer)?;
    for section in config.loss.iter().chain([&config.score_loss]) {
        let (kind, mut settings) = split_kind("loss", section)?;
        settings.remove("weight");
        (registry.loss(&kind)?.build)(&settings)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mistakes_are_found_before_training() {
        let registry = Registry::collect().unwrap();
        let config = |set: &str| RunConfig::resolve(Some("demo"), None, &[set.to_string()]).unwrap();
        check(&config("train.batch=1"), &registry).unwrap();
        assert!(check(&config("deformer.capasity=small"), &registry).unwrap_err().to_string().contains("capasity"));
        assert!(check(&config("loss=[{kind='l2'}]"), &registry).unwrap_err().to_string().contains("l1"));
        assert!(check(&config("density.kind=clone"), &registry).unwrap_err().to_string().contains("clone-split"));
        assert!(check(&config("rasterizer.kind=tyle"), &registry).unwrap_err().to_string().contains("tile"));
        assert!(check(&config("device=fleks"), &registry).unwrap_err().to_string().contains("flex"));
    }
}
