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
    use crate::gaussian_set::gaussian_rate;
    use cc4dgs_core::{PresetRole, Registry, Schedule, Stage};

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
        for (name, first) in [("n3dv+embedding", 5000), ("technicolor+embedding", 500), ("dnerf+embedding", 501)] {
            let config = RunConfig::resolve(Some(name), None, &[]).unwrap();
            assert_eq!(config.train.shares, [0.0, 0.0, 1.0]);
            let from = config.density["from"].as_integer().unwrap();
            assert_eq!(Schedule::main(config.train.iterations).at(from as usize), first, "{name}");
        }
    }

    #[test]
    fn opacities_are_reset_and_gaussians_grow_at_published_iterations() {
        let rows = [("hexplane", 15_000), ("native-4d", 15_000), ("deform-mlp", 12_000), ("grid4d", 12_000)];
        for (method, last) in rows {
            let config = RunConfig::resolve(Some(&format!("dnerf+{method}")), None, &[]).unwrap();
            let [coarse, _, main] = config.train.shares;
            let schedule = Schedule::main((config.train.iterations as f64 * main / (coarse + main)).round() as usize);
            // Where none is stated, rounds end at 10,000, and there are no resets.
            let at = |key: &str| schedule.at(config.density.get(key).map_or(if key == "until" { 10_000 } else { 0 }, |v| v.as_integer().unwrap() as usize));
            assert!(at("reset_main_every").abs_diff(3000) <= 1, "{method}: {}", at("reset_main_every"));
            let number = |key: &str| config.density.get(key).map_or(0, |v| v.as_integer().unwrap() as usize);
            if method != "native-4d" {
                let first_of_coarse = Schedule { stage: Stage::Coarse, ..Schedule::main(3000) }.at(number("coarse_from"));
                assert_eq!((first_of_coarse, number("reset_every"), number("reset_main_first")), (500, 0, 1), "{method}: faint at the start of the main stage");
            }
            // Rounded to reference iterations, and never so that one more reset is due.
            assert!((last - 2..=last).contains(&at("until")), "{method}: {}", at("until"));
        }
        let config = RunConfig::resolve(Some("n3dv+hexplane"), None, &[]).unwrap();
        assert_eq!(Schedule::main(14_000).at(config.density["until"].as_integer().unwrap() as usize), 10_000);
        // 15,000 of 20,000 iterations, of which the coarse stage has 3,000.
        let config = RunConfig::resolve(Some("n3dv+grid4d"), None, &[]).unwrap();
        assert_eq!((config.train.iterations, config.train.shares), (20_000, [3.0, 0.0, 17.0]));
        let schedule = Schedule { total: 20_000, ..Schedule::main(17_000) };
        let reference = |key: &str| config.density[key].as_integer().unwrap() as usize;
        // Resets after 6,000 and 12,000 of all.
        assert_eq!(["until", "reset_main_first", "reset_main_every"].map(|key| schedule.at(reference(key))), [12_000, 3000, 6000]);
        assert_eq!((schedule.interval(reference("every"), 25), reference("reset_every")), (400, 0));
        assert!((config.deformer["smooth_from"].as_float().unwrap() * 17_000.0 - 12_000.0).abs() < 10.0, "when Gaussians no longer grow");
    }

    #[test]
    fn rounds_and_degrees_of_colours_have_published_intervals() {
        let of_dnerf = ["hexplane", "native-4d", "deform-mlp", "grid4d"].map(|method| ("dnerf", method, 100));
        let of_n3dv = ["hexplane", "native-4d", "embedding", "swift4d"].map(|method| ("n3dv", method, 100));
        for (family, method, every) in of_dnerf.into_iter().chain(of_n3dv).chain([("n3dv", "grid4d", 400)]) {
            let config = RunConfig::resolve(Some(&format!("{family}+{method}")), None, &[]).unwrap();
            // Intervals shrink in runs of less than 28,000 iterations.
            let schedule = Schedule { total: config.train.iterations, ..Schedule::main(1) };
            let stated = config.density.get("every").map_or(100, |value| value.as_integer().unwrap() as usize);
            assert_eq!((schedule.interval(stated, 25), schedule.interval(config.train.sh_interval, 100)), (every, 1000), "{family}+{method}");
        }
    }

    #[test]
    fn rates_begin_and_end_where_published_ones_are_after_as_many_iterations() {
        let after = |first: f64, last: f64, share: f64| first * (last / first).powf(share);
        let near = |found: f64, wanted: f64| assert!((found / wanted - 1.0).abs() < 5e-3, "{found} is not {wanted}");
        let rate = |config: &RunConfig, key: &str| config.deformer[key].as_float().unwrap();
        // Rates fall over 20,000 iterations: 3,000 of the coarse stage, and anew 14,000 of the main stage, on D-NeRF 20,000.
        let hexplane = RunConfig::resolve(Some("n3dv+hexplane"), None, &[]).unwrap();
        near(rate(&hexplane, "lr_end"), after(1.6e-4, 1.6e-5, 0.7));
        near(hexplane.train.lr.means_end, after(1.6e-4, 1.6e-6, 0.7));
        for config in [&hexplane, &RunConfig::resolve(Some("dnerf+hexplane"), None, &[]).unwrap()] {
            near(after(config.train.lr.means, config.train.lr.means_end, config.train.lr.coarse_decay), after(1.6e-4, 1.6e-6, 0.15));
        }
        // Rates of the deformer fall over 45,000 iterations, those of centres over 35,000: the main stage has 3,001 to 20,000.
        let grid4d = RunConfig::resolve(Some("n3dv+grid4d"), None, &[]).unwrap();
        for (start, end, first, last) in [("lr_start", "lr_end", 1.6e-4, 1.6e-6), ("lr_grid_start", "lr_grid_end", 8e-3, 8e-5)] {
            near(rate(&grid4d, start), after(first, last, 3.0 / 45.0));
            near(rate(&grid4d, end), after(first, last, 20.0 / 45.0));
        }
        // On D-NeRF the deformers begin to learn after 3,000 iterations, too.
        let [of_grid4d, of_mlp] = ["grid4d", "deform-mlp"].map(|method| RunConfig::resolve(Some(&format!("dnerf+{method}")), None, &[]).unwrap());
        near(rate(&of_grid4d, "lr_start"), after(8e-4, 1.6e-6, 3.0 / 45.0));
        near(rate(&of_grid4d, "lr_grid_start"), after(8e-3, 8e-5, 3.0 / 45.0));
        near(rate(&of_grid4d, "lr_end"), after(8e-4, 1.6e-6, 50.0 / 45.0));
        near(rate(&of_grid4d, "lr_grid_end"), after(8e-3, 8e-5, 50.0 / 45.0));
        near(rate(&of_mlp, "lr_start"), after(8e-4, 1.6e-6, 3.0 / 40.0));
        near(grid4d.train.lr.means_end, after(1.6e-4, 1.6e-6, 20.0 / 35.0));
        near(after(grid4d.train.lr.means, grid4d.train.lr.means_end, grid4d.train.lr.coarse_decay), after(1.6e-4, 1.6e-6, 3.0 / 35.0));
    }

    #[test]
    fn published_methods_train_as_their_code_does() {
        for family in ["dnerf", "n3dv", "technicolor"] {
            for method in ["hexplane", "grid4d", "deform-mlp", "native-4d", "embedding", "swift4d"] {
                let config = RunConfig::resolve(Some(&format!("{family}+{method}")), None, &[]).unwrap();
                assert!(!config.train.guard && !config.train.sparse_adam && config.init.plain, "{family}+{method}");
                let adam = (config.optimizer["new_rows"].as_float(), config.optimizer["restart_steps"].as_bool());
                assert_eq!(adam, (Some(0.0), Some(false)), "{family}+{method}");
            }
        }
        // 13,000 of the 20,000 iterations over which rates fall.
        let swift4d = RunConfig::resolve(Some("n3dv+swift4d"), None, &[]).unwrap();
        let main = Schedule { total: 21_000, ..Schedule::main(13_000) };
        let at = |key: &str| main.at(swift4d.density[key].as_integer().unwrap() as usize);
        assert_eq!(["from", "until", "weight_main_every"].map(at), [500, 10_000, 3000]);
        let rate =
            |stage: Stage, iteration: usize, length: usize| gaussian_rate(&swift4d.train.lr, "means", &Schedule { stage, iteration, ..Schedule::main(length) });
        for (found, done) in [(rate(Stage::Main, 13_000, 13_000), 0.65), (rate(Stage::Coarse, 5000, 5000), 0.25)] {
            assert!((found / (1.6e-4 * 0.01f64.powf(done)) - 1.0).abs() < 5e-3, "{found} after {done}");
        }
    }

    #[test]
    fn rates_of_centres_go_on_where_the_published_schedule_is_one() {
        for (method, coarse, falls) in [("deform-mlp", 3000, 30_000.0), ("grid4d", 3000, 35_000.0), ("native-4d", 0, 30_000.0)] {
            let config = RunConfig::resolve(Some(&format!("dnerf+{method}")), None, &[]).unwrap();
            let length = config.train.iterations - coarse;
            let published = |iteration: usize| 1.6e-4 * 0.01f64.powf((iteration as f64 / falls).min(1.0));
            let rate = |stage: Stage, length: usize, iteration: usize| {
                gaussian_rate(&config.train.lr, "means", &Schedule { stage, iteration, ..Schedule::main(length) })
            };
            let of_main = [1, 10_000, length].map(|iteration| (rate(Stage::Main, length, iteration), published(coarse + iteration)));
            let of_coarse = (coarse > 0).then(|| (rate(Stage::Coarse, coarse, coarse), published(coarse)));
            for (found, wanted) in of_main.into_iter().chain(of_coarse) {
                assert!((found / wanted - 1.0).abs() < 5e-3, "{method}: {found} is not {wanted}");
            }
        }
    }

    #[test]
    fn times_of_native_4d_are_those_of_the_published_code() {
        // `time_duration`, and how many of its units the sequence has: on Technicolor times are shares.
        for (family, time_duration, units) in [("n3dv", 10.0f64, 10.0), ("dnerf", 1.0, 1.0), ("technicolor", 50.0, 1.0)] {
            let config = RunConfig::resolve(Some(&format!("{family}+native-4d")), None, &[]).unwrap();
            // Where none is stated, the defaults of the deformer hold.
            let of = |key: &str, default: f64| config.deformer.get(key).map_or(default, |value| value.as_float().unwrap());
            let (duration, rate) = (of("duration", 0.1414) * units, of("time_lr", 1.6e-5) * units);
            assert!((duration / (time_duration / 5.0).sqrt() - 1.0).abs() < 1e-3 && (rate / 1.6e-4 - 1.0).abs() < 1e-9, "{family}: {duration}, {rate}");
            assert!((of("velocity_lr", 1e-3) / units / 2e-3 - 1.0).abs() < 1e-9 && config.deformer["velocity_extent"].as_bool() == Some(false), "{family}");
            assert!((of("period", 1.0) * units / time_duration - 1.0).abs() < 1e-9, "{family}: cosines have the period of `time_duration`");
            assert_eq!(config.render.background, Some([0.0; 3]), "{family}");
            assert_eq!(config.density["max_scale_share"].as_float(), Some(0.1), "{family}");
            assert_eq!(config.density["max_scale_from"].as_integer(), Some(2001), "{family}: after 3,000 of 30,000");
            assert!((of("harmonics_every", 0.0) * 30_000.0 - 1000.0).abs() < 10.0, "{family}: a degree of colours after every 1,000");
        }
    }
}
