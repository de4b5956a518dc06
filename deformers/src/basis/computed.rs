//! `cdf-basis`: features of space computed from hash signatures, as the CDF's (paper Section IV-B).

use super::Basis;
use burn::tensor::Device;
use cc4dgs_core::{Deformer, DeformerContext, DeformerPlugin, Plugin, Result, inventory, toml};
use cc4dgs_fields::basis::{SpaceKind, VERSION};

/// Settings with their defaults, as shown to users.
const SCHEMA: &str = concat!(
    r#"capacity = "default"    # small | mid | default, as for `cdf`
# levels, resolutions, hidden, features: as for `cdf`
hashes = 128             # hash functions per vertex
modulus = 1000000        # m of the hash functions
vertex_reuse = true      # decode a vertex once, however many Gaussians share it
# width = 128            # width of the coefficient network (small: 64; mid: 96)
layers = 2               # hidden layers of the coefficient network
clip_norm = 1.0          # gradient-norm clip per group; 0 is off
"#,
    shared_schema!()
);

fn build(settings: &toml::Table, context: &DeformerContext, device: &Device) -> Result<Box<dyn Deformer>> {
    Ok(Box::new(Basis::new(SpaceKind::Computed, settings, context, device)?))
}

inventory::submit! {
    DeformerPlugin {
        info: Plugin {
            name: SpaceKind::Computed.name(),
            version: VERSION,
            summary: "computational deformation field, linear in shared functions of time: a dot product per frame",
            paper: "CC-4DGS, Section IV-B (spatial half); DynMF, Gaussian-Flow (shared temporal functions)",
            schema: SCHEMA,
            capabilities: &["differentiable", "starts-as-identity", "vertex-reuse", "cached-spatial", "simplifies", "rotation=additive,exponential"],
        },
        build,
    }
}
