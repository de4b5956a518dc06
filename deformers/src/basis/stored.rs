//! `hash-basis`: features of space stored in a multi-resolution hash grid (Müller et al. 2022).

use super::Basis;
use burn::tensor::Device;
use cc4dgs_core::{Deformer, DeformerContext, DeformerPlugin, Plugin, Result, inventory, toml};
use cc4dgs_fields::basis::{SpaceKind, VERSION};

/// Settings with their defaults, as shown to users.
const SCHEMA: &str = concat!(
    r#"levels = 6               # levels of the grid
base = 16                # vertices per axis of the first level; each level doubles them
features = 4             # features per level
log2_rows = 15           # rows of a level's table at most, as a binary logarithm; where a level has more vertices, they share rows by a hash
grid_rate = 10.0         # learning rates of the tables, in multiples of lr_start and lr_end
width = 64               # width of the coefficient network
layers = 1               # hidden layers of the coefficient network
clip_norm = 1.0          # gradient-norm clip of the networks; 0 is off; tables have none
"#,
    shared_schema!()
);

fn build(settings: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Basis::new(SpaceKind::Stored, settings, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: SpaceKind::Stored.name(),
            version: VERSION,
            summary: "features of a stored hash grid, linear in shared functions of time: quick to train, a dot product per frame",
            paper: "Instant-NGP (Müller et al. 2022); DynMF, Gaussian-Flow (shared temporal functions)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "cached-spatial", "simplifies", "rotation=additive,exponential"],
        },
        build,
    }
}
