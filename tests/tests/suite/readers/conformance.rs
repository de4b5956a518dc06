//! Conformance suites of `cc4dgs-core`: every registered reader on a tiny dataset, and every preset combined with every other.

use super::common::*;
use cc4dgs_core::{Registry, conformance};
use std::path::{Path, PathBuf};

/// Writes a tiny dataset for the reader called `name` into `root` and returns its path.
fn tiny(name: &str, root: &Path) -> PathBuf {
    match name {
        "blender" => {
            write_dnerf(root, 3, 1, 8);
        }
        "panoptic" => {
            write_panoptic(root, 3, 2);
            std::fs::create_dir_all(root.join("seg/0")).unwrap();
            image::GrayImage::new(16, 12).save(root.join("seg/0/000000.png")).unwrap();
        }
        "colmap" => write_colmap(root),
        "llff" => write_llff(root),
        "nerfstudio" => {
            write_nerfstudio(root, 4);
            write_depth(&root.join("depth.png"), 8, 6, |x, y| (x * y) as u16);
            let document = std::fs::read_to_string(root.join("transforms.json")).unwrap();
            std::fs::write(root.join("transforms.json"), document.replacen("\"file_path\"", "\"depth_file_path\":\"depth.png\",\"file_path\"", 1)).unwrap();
        }
        "technicolor" => {
            write_technicolor(root, 12, &[100, 101]);
        }
        "procedural" => return PathBuf::from("procedural:tiny"),
        other => panic!("write a tiny dataset for the reader {other}"),
    }
    root.to_path_buf()
}

#[test]
fn every_reader_conforms() {
    let registry = Registry::collect().unwrap();
    let readers = registry.readers();
    assert!(readers.len() >= 7 && readers.windows(2).all(|p| p[0].order <= p[1].order));
    let mut findings = Vec::new();
    for reader in &readers {
        let root = tempfile::tempdir().unwrap();
        let path = tiny(reader.info.name, root.path());
        findings.extend(conformance::reader(reader, &path));
        // Other readers that also recognise the folder have a higher order.
        let first = readers.iter().find(|r| (r.probe)(&path)).unwrap();
        assert_eq!(first.info.name, reader.info.name, "{}", path.display());
    }
    assert!(findings.is_empty(), "{}", findings.join("\n"));
}

#[test]
fn every_preset_conforms() {
    let registry = Registry::collect().unwrap();
    let findings: Vec<String> = registry.presets().flat_map(|p| conformance::preset(p, &registry)).collect();
    assert!(findings.is_empty() && registry.presets().count() >= 15, "{}", findings.join("\n"));
}

/// The suite finds the errors of a faulty reader.
#[test]
fn a_careless_reader_is_caught() {
    use cc4dgs_core::reader::{RawScene, ReaderPlugin, SceneOptions};
    use cc4dgs_core::{Limits, Plugin, Result};
    fn probe(_: &Path) -> bool {
        true
    }
    fn open(path: &Path, _: &SceneOptions, _: &Limits) -> Result<RawScene> {
        let text = std::fs::read_to_string(path.join("transforms_train.json")).unwrap();
        let time: f64 = text.split("\"time\":").nth(2).unwrap().split(',').next().unwrap().parse().unwrap();
        let mut scene = RawScene::default();
        scene.rank_times(&[Some(time)], "t")?;
        Ok(scene)
    }
    let info = Plugin { name: "careless", version: "1", summary: "", paper: "", schema: "", capabilities: &[] };
    let careless = ReaderPlugin { info, looks_for: "anything", order: 0, probe, open };
    let root = tempfile::tempdir().unwrap();
    write_dnerf(root.path(), 3, 1, 8);
    let findings = conformance::reader(&careless, root.path()).join("\n");
    for expected in ["an empty folder", "no training view", "none of its images", "it panics where transforms_train.json"] {
        assert!(findings.contains(expected), "{expected} is missing in\n{findings}");
    }
}
