//! The built-in presets: a family of datasets, and on top of it, if another deformer than the family's is wanted, a method (`n3dv+hexplane`).
//!
//! They are plug-ins like a third party's. [`cc4dgs_core::Registry::preset`] puts the layers together.

use cc4dgs_core::{Plugin, PresetPlugin, PresetRole, inventory};

const PROTOCOL: &str = "CC-4DGS, Section V; protocols of its baselines";

/// Registers families: name, dataset of the methods' tables, whether its sizes are for two cores, summary. The layer is the file of the name.
macro_rules! families {
    ($($name:literal, $dataset:literal, $small:literal, $summary:literal;)*) => { $(
        inventory::submit! {
            PresetPlugin {
                info: Plugin {
                    name: $name,
                    version: "1",
                    summary: $summary,
                    paper: PROTOCOL,
                    schema: include_str!(concat!("../presets/", $name, ".toml")),
                    capabilities: &["family"],
                },
                role: PresetRole::Family { dataset: $dataset, small: $small },
            }
        }
    )* };
}

/// Registers methods: name, summary, paper.
macro_rules! methods {
    ($($name:literal, $summary:literal, $paper:literal;)*) => { $(
        inventory::submit! {
            PresetPlugin {
                info: Plugin {
                    name: $name,
                    version: "1",
                    summary: $summary,
                    paper: $paper,
                    schema: include_str!(concat!("../presets/methods/", $name, ".toml")),
                    capabilities: &["method"],
                },
                role: PresetRole::Method,
            }
        }
    )* };
}

families! {
    "auto", "auto", true, "chooses every setting by looking at the scene, the machine and the time there is";
    "demo", "demo", true, "the built-in ray-traced scene, minutes on two cores";
    "n3dv", "n3dv", false, "Neural 3D Video, the protocol of CC-4DGS";
    "technicolor", "technicolor", false, "Technicolor light field, the protocol of CC-4DGS";
    "dnerf", "dnerf", false, "D-NeRF synthetic scenes at 800x800, the protocol of published tables";
    "panoptic", "panoptic", false, "PanopticSports, all frames";
}

methods! {
    "cdf", "the computational deformation field of CC-4DGS", "CC-4DGS";
    "swift4d", "Swift4D's joint hash grid over space and time", "Swift4D (Wu et al. 2025)";
    "grid4d", "Grid4D's four hash grids over space and time", "Grid4D (Xu et al. 2024)";
    "hexplane", "4DGS's six feature planes over space and time", "4DGS (Wu et al. 2024)";
    "embedding", "E-D3DGS's learned vectors per Gaussian and per time", "E-D3DGS (Bae et al. 2024)";
    "deform-mlp", "Deformable 3DGS's deep network", "Deformable 3DGS (Yang et al. 2024)";
    "free-time", "a velocity and a temporal opacity per Gaussian", "FreeTimeGS; FreeTimeGS++; SharpTimeGS";
    "native-4d", "4D-GS's Gaussians of space and time", "4D-GS (Yang et al. 2024)";
    "cdf-basis", "the computational deformation field, linear in shared functions of time: fast playback", "this project";
    "hash-basis", "stored hash grid, linear in shared functions of time: fast training and playback", "this project";
    "none", "no deformation: a static scene", "Kerbl et al. 2023 (3DGS)";
}

#[cfg(test)]
mod tests {
    use crate::config::RunConfig;
    use cc4dgs_core::{PresetRole, Registry, Schedule};

    #[test]
    fn every_family_and_method_resolves() {
        let registry = Registry::collect().unwrap();
        let names = |method: bool| registry.presets().filter(move |p| (p.role == PresetRole::Method) == method).map(|p| p.info.name).collect::<Vec<_>>();
        assert_eq!((names(false).len(), names(true).len()), (6, 11));
        for family in names(false) {
            for method in names(true).into_iter().map(|name| format!("+{name}")).chain([String::new()]) {
                let name = format!("{family}{method}");
                let config = RunConfig::resolve(Some(&name), None, &[]).unwrap_or_else(|e| panic!("{name}: {e}"));
                assert_eq!(config.preset, name);
                if method == "+hexplane" {
                    assert_eq!(config.deformer["kind"].as_str(), Some("hexplane"));
                    assert!(!config.deformer.contains_key("capacity"), "{name} keeps the family's settings of the deformer");
                }
            }
        }
        assert!(RunConfig::resolve(Some("n3dv+hexplan"), None, &[]).unwrap_err().to_string().contains("hexplane"));
        let method_alone = RunConfig::resolve(Some("hexplane"), None, &[]).unwrap_err().to_string();
        assert!(method_alone.contains("demo+hexplane"), "{method_alone}");
    }

    #[test]
    fn embedding_grows_from_its_published_iterations_on() {
        for (name, first) in [("n3dv+embedding", 5000), ("technicolor+embedding", 500)] {
            let config = RunConfig::resolve(Some(name), None, &[]).unwrap();
            assert_eq!(config.train.shares, [0.0, 0.0, 1.0]);
            let from = config.density["from"].as_integer().unwrap();
            assert_eq!(Schedule::main(config.train.iterations).at(from as usize), first, "{name}");
        }
    }

    #[test]
    fn opacities_are_reset_and_gaussians_grow_at_published_iterations() {
        let rows = [("hexplane", 10_000), ("native-4d", 15_000), ("deform-mlp", 12_000), ("grid4d", 12_000)];
        for (method, last) in rows {
            let config = RunConfig::resolve(Some(&format!("dnerf+{method}")), None, &[]).unwrap();
            let [coarse, _, main] = config.train.shares;
            let schedule = Schedule::main((config.train.iterations as f64 * main / (coarse + main)).round() as usize);
            // Where none is stated, rounds end at 10,000, and there are no resets.
            let at = |key: &str| schedule.at(config.density.get(key).map_or(if key == "until" { 10_000 } else { 0 }, |v| v.as_integer().unwrap() as usize));
            assert!(at("reset_main_every").abs_diff(3000) <= 1, "{method}: {}", at("reset_main_every"));
            // Shares of a main stage are whole numbers of its reference: up to 27 iterations off.
            assert!(at("until").abs_diff(last) <= 27, "{method}: {}", at("until"));
        }
        let config = RunConfig::resolve(Some("n3dv+hexplane"), None, &[]).unwrap();
        assert_eq!(Schedule::main(14_000).at(config.density["until"].as_integer().unwrap() as usize), 10_000);
    }
}
