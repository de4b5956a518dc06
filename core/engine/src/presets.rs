//! Settings by name: a family of datasets, and on top of it, if another field than the family's is wanted, a method (`n3dv+hexplane`).

use cc4dgs_core::{Error, Result, config, unknown_name};

/// The families: name, summary, TOML.
const FAMILIES: [(&str, &str, &str); 7] = [
    ("demo", "the built-in ray-traced scene, minutes on two cores", include_str!("../presets/demo.toml")),
    ("n3dv", "Neural 3D Video, the paper's protocol", include_str!("../presets/n3dv.toml")),
    ("technicolor", "Technicolor light field, the paper's protocol", include_str!("../presets/technicolor.toml")),
    ("dnerf", "D-NeRF synthetic scenes at full protocol", include_str!("../presets/dnerf.toml")),
    ("dnerf-cpu", "D-NeRF at 400x400 on two cores", include_str!("../presets/dnerf-cpu.toml")),
    ("panoptic", "PanopticSports, all frames", include_str!("../presets/panoptic.toml")),
    ("panoptic-cpu", "PanopticSports, 30 frames on two cores", include_str!("../presets/panoptic-cpu.toml")),
];

/// The methods: name, summary, TOML with a table for `all` families, one for each that differs, and one for `cpu` sizes.
const METHODS: [(&str, &str, &str); 8] = [
    ("swift4d", "Swift4D's joint hash grid", include_str!("../presets/methods/swift4d.toml")),
    ("grid4d", "Grid4D's four hash grids", include_str!("../presets/methods/grid4d.toml")),
    ("hexplane", "4DGS's planes", include_str!("../presets/methods/hexplane.toml")),
    ("embedding", "E-D3DGS's learned vectors", include_str!("../presets/methods/embedding.toml")),
    ("deform-mlp", "Deformable 3DGS's network", include_str!("../presets/methods/deform-mlp.toml")),
    ("native-4d", "4D-GS's Gaussians of space and time", include_str!("../presets/methods/native-4d.toml")),
    ("cdf-basis", "this project's field, linear in functions of time", include_str!("../presets/methods/cdf-basis.toml")),
    ("none", "no deformation", include_str!("../presets/methods/none.toml")),
];

/// Families whose sizes are for two cores.
fn is_small(family: &str) -> bool {
    family == "demo" || family.ends_with("-cpu")
}

/// Names and summaries of the families.
pub fn families() -> Vec<(&'static str, &'static str)> {
    FAMILIES.iter().map(|&(name, summary, _)| (name, summary)).collect()
}

/// Names and summaries of the methods, to be written behind a family and a `+`.
pub fn methods() -> Vec<(&'static str, &'static str)> {
    METHODS.iter().map(|&(name, summary, _)| (name, summary)).collect()
}

/// The settings called `name`: a family, or a family and a method joined by `+`.
pub fn table(name: &str) -> Result<toml::Table> {
    let (family, method) = name.split_once('+').map_or((name, None), |(family, method)| (family, Some(method)));
    let (_, _, text) = FAMILIES.iter().find(|f| f.0 == family).ok_or_else(|| unknown_name("preset", family, FAMILIES.iter().map(|f| f.0)))?;
    let mut settings = config::parse_table(&format!("preset {family}"), text)?;
    if let Some(method) = method {
        let (_, _, text) = METHODS.iter().find(|m| m.0 == method).ok_or_else(|| unknown_name("preset method", method, METHODS.iter().map(|m| m.0)))?;
        let layers = config::parse_table(&format!("preset method {method}"), text)?;
        let dataset = family.strip_suffix("-cpu").unwrap_or(family);
        for layer in ["all", dataset, "cpu"] {
            if layer == "cpu" && !is_small(family) {
                continue;
            }
            match layers.get(layer) {
                Some(toml::Value::Table(over)) => config::merge(&mut settings, over),
                Some(_) => return Err(Error::backend(format!("preset method {method}"), format!("{layer} is no table"), "Report this as a defect")),
                None => {}
            }
        }
    }
    settings.insert("preset".into(), name.into());
    Ok(settings)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RunConfig;

    #[test]
    fn every_family_and_method_resolves() {
        for (family, _) in families() {
            for method in methods().into_iter().map(|(name, _)| format!("+{name}")).chain([String::new()]) {
                let name = format!("{family}{method}");
                let config = RunConfig::resolve(Some(&name), None, &[]).unwrap_or_else(|e| panic!("{name}: {e}"));
                assert_eq!(config.preset, name);
                if method == "+hexplane" {
                    assert_eq!(config.deformer["kind"].as_str(), Some("hexplane"));
                    assert!(!config.deformer.contains_key("capacity"), "{name} keeps the family's field settings");
                }
            }
        }
        assert!(RunConfig::resolve(Some("n3dv+hexplan"), None, &[]).unwrap_err().to_string().contains("hexplane"));
    }
}
