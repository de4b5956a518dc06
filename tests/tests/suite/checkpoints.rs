//! Checkpoints that were damaged: an error, or the same model; never another one.

use burn::tensor::{Device, Tensor};
use cc4dgs_core::{HostGaussians, Limits, Registry, Result, Seed};
use cc4dgs_play::Model;
use cc4dgs_play::checkpoint::{CHECKPOINT, CheckpointArrays, CheckpointFile, FORMAT, read_model};
use cc4dgs_train::checkpoint::load;
use cc4dgs_train::config::RunConfig;
use cc4dgs_train::train::{TrainJob, train};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// The checkpoint of a short run with a deformer that keeps attributes, in `folder`.
fn checkpoint(folder: &Path, registry: &Registry) -> Vec<u8> {
    let deformer = ["kind=embedding", "gaussian_features=6", "time_features=10", "time_rows=9", "coarse_rows=4", "width=16"];
    let mut sets: Vec<String> = deformer.map(|set| format!("deformer.{set}")).into();
    sets.extend(["scene.width=24", "scene.height=24", "train.iterations=24", "init.count=60"].map(String::from));
    let config = RunConfig::resolve(Some("demo"), None, &sets).unwrap();
    let scene = cc4dgs_train::data::open(Path::new("procedural"), &config.scene, registry, &config.limits).unwrap();
    let job = TrainJob {
        config: &config,
        scene: Arc::new(scene),
        out: Some(folder.to_path_buf()),
        resume: false,
        registry,
        events: &cc4dgs_core::Silent,
        stop: &AtomicBool::new(false),
        observer: None,
    };
    train(&job).unwrap();
    std::fs::read(folder.join(CHECKPOINT)).unwrap()
}

/// Everything of a model that a damaged byte could change.
fn contents(model: &Model) -> (HostGaussians, Vec<f32>, String) {
    let field = model.field.as_ref().map(|f| (f.section.clone(), f.context.clone()));
    let weights = model.field.iter().flat_map(|f| f.field.parameters()).flat_map(|p| p.value.clone().into_data().to_vec::<f32>().unwrap()).collect();
    let rest =
        format!("{field:?} {:?} {:?} {:?} {:?} {} {:?}", model.moving, model.render, model.background, model.rasterizer, model.frame_count, model.provenance);
    (model.gaussians.clone(), weights, rest)
}

#[test]
fn a_damaged_checkpoint_is_refused_or_the_same() {
    let registry = Registry::collect().unwrap();
    let (folder, device, limits) = (tempfile::tempdir().unwrap(), Device::flex(), Limits::default());
    let sound = checkpoint(folder.path(), &registry);
    let path = folder.path().join("damaged");
    let open = |bytes: &[u8]| -> Result<Model> {
        std::fs::write(&path, bytes).unwrap();
        // The trainer reads more of the file than playback does, and must not be less strict.
        load(&path, &registry, &device, &limits)?;
        read_model(&path, &registry, &device, &limits)
    };
    let whole = contents(&open(&sound).unwrap());
    let header = 8 + u64::from_le_bytes(sound[..8].try_into().unwrap()) as usize;
    let (mut refused, mut same) = (0, 0);
    for k in 0..200u64 {
        let draw = Seed::root(31).index(k).value();
        let mut damaged = sound.clone();
        // Half of the damages hit the header, where names and sizes are.
        let at = (draw >> 16) as usize % if k % 2 == 0 { header } else { sound.len() };
        damaged[at] = if k % 4 < 2 { damaged[at] ^ 1 << (draw % 8) } else { (draw >> 8) as u8 };
        match open(&damaged) {
            Err(e) => {
                assert!(e.to_string().contains(". "), "{e} names no remedy");
                refused += 1;
            }
            Ok(model) => {
                assert!(contents(&model) == whole, "byte {at}: another model was read");
                same += 1;
            }
        }
    }
    assert!(refused >= 190, "{refused} refused, {same} read as they were");
}

#[test]
fn checkpoints_of_other_formats_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(CHECKPOINT);
    let mut arrays = CheckpointArrays::default();
    arrays.add("a".into(), &Tensor::<1>::from_floats([1.0, 2.0], &Device::flex())).unwrap();
    for (format, taken) in [(FORMAT, true), (FORMAT + 1, false)] {
        arrays.write(&path, &serde_json::json!({ "format": format })).unwrap();
        match CheckpointFile::read(&path, &Limits::default()) {
            Ok(file) => {
                assert!(taken);
                assert_eq!(file.array("a", Some(2)).unwrap(), [1.0, 2.0]);
                assert!(file.array("a", Some(3)).is_err() && file.array("b", Some(2)).is_err() && file.array("a", None).is_err());
            }
            Err(e) => assert!(!taken && e.to_string().contains(&format!("format {format}")), "{e}"),
        }
    }
    let broken = Tensor::<1>::from_floats([f32::NAN], &Device::flex());
    assert!(arrays.add("b".into(), &broken).is_err());
}
