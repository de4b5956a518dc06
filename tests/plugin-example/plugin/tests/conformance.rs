//! The suites that cc4dgs runs on its own plug-ins.

use cc4dgs_core::burn::tensor::Device;
use cc4dgs_core::exporter::export;
use cc4dgs_core::format::conformance::MovingModel;
use cc4dgs_core::{Registry, conformance, parse_device, toml::Table};
use sway as _;

/// What `suite` finds wrong on all devices of this machine.
fn findings(suite: impl Fn(&Device) -> Vec<String>) -> String {
    let mut all = Vec::new();
    for device in ["flex", "ndarray", "wgpu"] {
        match parse_device(device) {
            Ok(device) => all.extend(suite(&device)),
            // A machine without a graphics driver still runs the others; CI says that it has one.
            Err(e) if std::env::var_os("CC4DGS_REQUIRE_WGPU").is_none() => eprintln!("{e}: skipped"),
            Err(e) => panic!("{e}"),
        }
    }
    all.join("\n")
}

#[test]
fn the_deformers_conform() {
    let registry = Registry::collect().unwrap();
    for name in ["control-points", "sway", "wobble"] {
        assert_eq!(findings(|device| conformance::deformer(registry.deformer(name).unwrap(), &Table::new(), device)), "");
    }
}

#[test]
fn the_density_control_conforms() {
    let registry = Registry::collect().unwrap();
    assert_eq!(findings(|device| conformance::density(registry.density("relocate").unwrap(), &Table::new(), device)), "");
}

#[test]
fn the_losses_conform() {
    let registry = Registry::collect().unwrap();
    for name in ["charbonnier", "faint", "keep-size"] {
        assert_eq!(findings(|device| conformance::loss(registry.loss(name).unwrap(), &Table::new(), &registry, device)), "");
    }
}

#[test]
fn the_exporter_conforms() {
    let registry = Registry::collect().unwrap();
    let csv = registry.exporter("csv").unwrap();
    for settings in ["", "min_opacity = 0.7"] {
        let findings = conformance::exporter(csv, &settings.parse::<Table>().unwrap());
        assert!(findings.is_empty(), "{settings}\n{}", findings.join("\n"));
    }
    for refused in ["min_opacity = -0.1", "min_opacity = 1.5", "min_opacity = nan", "min_opacity = 'half'"] {
        assert!((csv.build)(&refused.parse::<Table>().unwrap()).is_err(), "{refused}");
    }
}

/// What the exporter `csv` writes of `model`.
fn table(mut model: MovingModel, settings: &str) -> String {
    let registry = Registry::collect().unwrap();
    let csv = registry.exporter("csv").unwrap();
    let exporter = (csv.build)(&settings.parse::<Table>().unwrap()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("table.csv");
    export(exporter.as_ref(), csv.target, &mut model, &path, false).unwrap();
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn a_table_has_a_line_for_every_gaussian_that_is_wanted() {
    let header = "x,y,z,scale_x,scale_y,scale_z,qw,qx,qy,qz,opacity,red,green,blue\n";
    assert_eq!(table(MovingModel::new(0, 0), ""), header);
    let two = || {
        MovingModel::new(2, 0).with_gaussians(|g| {
            g.means = vec![1.0, 2.0, 3.0, -4.0, 0.5, 3e37];
            g.log_scales = vec![0.0; 6];
            g.quaternions = vec![1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 0.0];
            // The second cannot be seen.
            g.opacity_logits = vec![0.0, -200.0];
            g.sh_dc = vec![0.0; 6];
        })
    };
    let first = "1,2,3,1,1,1,1,0,0,0,0.5,0.5,0.5,0.5\n";
    let second = "-4,0.5,30000000000000000000000000000000000000,1,1,1,0,0,2,0,0,0.5,0.5,0.5\n";
    assert_eq!(table(two(), ""), format!("{header}{first}{second}"));
    assert_eq!(table(two(), "min_opacity = 0.1"), format!("{header}{first}"));
    assert_eq!(table(MovingModel::new(9, 4).with(|facts| facts.time_norm = Some(0.5)), "").lines().count(), 10);
}

/// A dataset of the reader `rig`: two cameras, one held out, two frames.
fn write_rig(folder: &std::path::Path) {
    let mut text = String::from("camera left 8 6 10  4 0 1  0 0 0\ncamera right 8 6 10  0 4 1  0 0 0\n");
    for (camera, split) in [(0, "train"), (1, "test")] {
        for frame in 0..2 {
            let file = format!("{camera}-{frame}.ppm");
            text += &format!("image {camera} {frame} {file} {split}\n");
            std::fs::write(folder.join(file), format!("P3 8 6 255 {}", "10 20 30 ".repeat(48))).unwrap();
        }
    }
    std::fs::write(folder.join("rig.txt"), text).unwrap();
}

#[test]
fn the_reader_conforms() {
    let folder = tempfile::tempdir().unwrap();
    write_rig(folder.path());
    let findings = conformance::reader(Registry::collect().unwrap().reader("rig").unwrap(), folder.path());
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn the_presets_conform() {
    let registry = Registry::collect().unwrap();
    let findings: Vec<String> = registry.presets().flat_map(|p| conformance::preset(p, &registry)).collect();
    assert!(findings.is_empty(), "{}", findings.join("\n"));
    let settings = registry.preset("tiny+swaying").unwrap();
    assert_eq!((settings["deformer"]["kind"].as_str(), settings["train"]["iterations"].as_integer()), (Some("sway"), Some(40)));
}
