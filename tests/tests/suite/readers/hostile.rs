//! Untrusted bytes: an error or a valid result, never a panic, and no memory allocated for a stated size alone.

use super::common::*;
use cc4dgs_core::{Limits, Result, Scene};
use cc4dgs_train::data::npy::read_npy;
use proptest::prelude::*;
use std::path::{Path, PathBuf};

/// Small limits, so that a reader that trusts a stated size fails the test and does not exhaust memory.
fn limits() -> Limits {
    Limits { max_bytes: 1 << 22, max_gaussians: 10_000, max_pixels: 1 << 20, max_depth: 64 }
}

fn open(path: &Path) -> Result<Scene> {
    super::common::open(path, &options(), &limits())
}

/// A scene that opens must also be valid.
fn check(result: Result<Scene>) {
    match result {
        Ok(scene) => {
            scene.cameras.iter().for_each(|c| c.validate().unwrap());
            assert!(scene.views.iter().all(|v| (0.0..=1.0).contains(&v.time_norm)));
            if let Some((low, high)) = scene.init_box {
                assert!(low.iter().chain(&high).all(|v| v.is_finite()));
            }
            assert!(scene.points.iter().flat_map(|p| &p.positions).flatten().all(|v| v.is_finite()));
            if let Ok(image) = scene.frame(0) {
                assert_eq!((image.width, image.height), (scene.camera(0).width, scene.camera(0).height));
            }
        }
        Err(e) => {
            let message = e.to_string();
            assert!(message.len() > 20, "{message}");
        }
    }
}

/// Changes of a file: (offset, new byte) pairs and a truncation.
fn damage() -> impl Strategy<Value = (Vec<(prop::sample::Index, u8)>, Option<prop::sample::Index>)> {
    (prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6), prop::option::weighted(0.3, any::<prop::sample::Index>()))
}

fn apply(bytes: &[u8], (changes, cut): &(Vec<(prop::sample::Index, u8)>, Option<prop::sample::Index>)) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for (offset, value) in changes {
        let i = offset.index(out.len());
        out[i] = *value;
    }
    if let Some(cut) = cut {
        out.truncate(cut.index(bytes.len()));
    }
    out
}

/// A dataset that is written once; each case damages one of its files and restores it.
struct Victim {
    root: tempfile::TempDir,
    file: PathBuf,
    bytes: Vec<u8>,
}

impl Victim {
    fn new(write: impl Fn(&Path), file: &str) -> Self {
        let root = tempfile::tempdir().unwrap();
        write(root.path());
        let file = root.path().join(file);
        let bytes = std::fs::read(&file).unwrap();
        open(root.path()).unwrap();
        Self { root, file, bytes }
    }
    fn try_bytes(&self, bytes: &[u8]) {
        std::fs::write(&self.file, bytes).unwrap();
        check(open(self.root.path()));
    }
}

fn dnerf(root: &Path) {
    write_dnerf(root, 3, 1, 8);
}

fn panoptic(root: &Path) {
    write_panoptic(root, 2, 2);
}

/// A nerfstudio scene with a binary PLY of three points.
fn nerfstudio_with_points(root: &Path) {
    write_nerfstudio(root, 4);
    let file = root.join("transforms.json");
    let mut document: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&file).unwrap()).unwrap();
    document["ply_file_path"] = "points.ply".into();
    std::fs::write(&file, document.to_string()).unwrap();
    write_cloud(&root.join("points.ply"), &[[0.0; 3], [1.0; 3], [2.0; 3]]);
}

/// A LLFF scene with a dense cloud of three points.
fn llff_with_cloud(root: &Path) {
    write_llff(root);
    write_cloud(&root.join("points3D_downsample2.ply"), &[[0.0; 3], [0.1; 3], [0.2; 3]]);
}

#[test]
fn every_cut_of_every_index_file_is_survived() {
    let victims = [
        Victim::new(write_colmap, "sparse/0/cameras.bin"),
        Victim::new(write_colmap, "sparse/0/images.bin"),
        Victim::new(write_colmap, "sparse/0/points3D.bin"),
        Victim::new(write_llff, "poses_bounds.npy"),
        Victim::new(llff_with_cloud, "points3D_downsample2.ply"),
        Victim::new(dnerf, "transforms_train.json"),
    ];
    for victim in &victims {
        let step = (victim.bytes.len() / 150).max(1);
        for keep in (0..victim.bytes.len()).step_by(step) {
            std::fs::write(&victim.file, &victim.bytes[..keep]).unwrap();
            assert!(open(victim.root.path()).is_err(), "{} truncated to {keep} of {}", victim.file.display(), victim.bytes.len());
        }
    }
}

#[test]
fn counts_and_sizes_that_lie_are_refused() {
    let victim = Victim::new(write_colmap, "sparse/0/points3D.bin");
    for count in [3, 1000, u64::from(u32::MAX), u64::MAX / 51, u64::MAX] {
        let mut bytes = victim.bytes.clone();
        bytes[..8].copy_from_slice(&count.to_le_bytes());
        std::fs::write(&victim.file, bytes).unwrap();
        let message = open(victim.root.path()).err().unwrap().to_string();
        assert!(message.contains("points3D.bin"), "{message}");
    }
    let victim = Victim::new(write_colmap, "sparse/0/cameras.bin");
    for (offset, value) in [(16, u64::MAX), (24, 1 << 40), (16, 0)] {
        let mut bytes = victim.bytes.clone();
        bytes[offset..offset + 8].copy_from_slice(&value.to_le_bytes());
        std::fs::write(&victim.file, bytes).unwrap();
        assert!(open(victim.root.path()).is_err(), "camera size {value}");
    }
}

#[test]
fn hostile_documents_are_refused() {
    let deep = format!("{}{}", "[".repeat(100_000), "]".repeat(100_000));
    let not_finite = r#"{"camera_angle_x": 1e999, "frames": []}"#;
    for text in
        ["", "{", "[]", "null", "{\"frames\": 3}", not_finite, "{\"camera_angle_x\": -1, \"frames\": []}", "{\"camera_angle_x\": 1, \"frames\": []}", &deep]
    {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("transforms_train.json"), text).unwrap();
        assert!(open(dir.path()).is_err(), "{:.40}", text);
        std::fs::rename(dir.path().join("transforms_train.json"), dir.path().join("transforms.json")).unwrap();
        assert!(open(dir.path()).is_err(), "{:.40}", text);
        std::fs::rename(dir.path().join("transforms.json"), dir.path().join("train_meta.json")).unwrap();
        assert!(open(dir.path()).is_err(), "{:.40}", text);
    }
}

/// Contributed scenes with all of their files: without one, a scene would be refused for another reason than its own.
const CORPUS: [(&str, &[&str]); 9] = [
    ("blender_nan_pose", &["a.png", "transforms_train.json"]),
    ("blender_no_pictures", &["transforms_train.json"]),
    ("colmap_binary_huge_count", &["cameras.bin", "images.bin"]),
    ("colmap_text_unknown_model", &["cameras.txt", "images.txt", "images/a.png"]),
    ("llff_huge_shape", &["poses_bounds.npy", "images/0.png"]),
    ("llff_nested_header", &["poses_bounds.npy", "images/0.png"]),
    ("nerfstudio_sheared_pose", &["a.png", "transforms.json"]),
    ("panoptic_ragged", &["train_meta.json"]),
    ("technicolor_short_row", &["Painter_undist_00100_00.png", "cameras_parameters.txt"]),
];

/// Each must be refused by the reader of its folder.
#[test]
fn the_corpus_is_refused() {
    let corpus = Path::new("bad/scenes");
    for (name, files) in CORPUS {
        let path = corpus.join(name);
        let missing: Vec<&str> = files.iter().copied().filter(|file| !path.join(file).is_file()).collect();
        assert!(missing.is_empty(), "tests/{} lacks {missing:?}", path.display());
        let error = open(&path).err().unwrap_or_else(|| panic!("{} was opened", path.display()));
        assert!(matches!(error.exit_code(), 2..=4), "{}: {error}", path.display());
    }
    let listed = std::fs::read_dir(corpus).unwrap().filter(|entry| entry.as_ref().unwrap().path().is_dir()).count();
    assert_eq!(listed, CORPUS.len(), "a scene in tests/bad/scenes is not in the list of this test");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn damaged_npy(damage in damage()) {
        let bytes = npy(&[3, 17], &llff_rows(&ring(3, 16, 12)));
        if let Ok(array) = read_npy("t", &apply(&bytes, &damage), &limits()) {
            prop_assert_eq!(array.shape.iter().product::<usize>(), array.values.len());
        }
    }

    #[test]
    fn any_bytes_as_npy(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let mut framed = b"\x93NUMPY\x01\x00".to_vec();
        framed.extend(((bytes.len() / 2) as u16).to_le_bytes());
        framed.extend(&bytes);
        let _ = read_npy("t", &framed, &limits());
        let _ = read_npy("t", &bytes, &limits());
    }
}

macro_rules! damaged {
    ($($name:ident: $write:expr, $file:expr;)*) => { $(
        #[test]
        fn $name() {
            let victim = Victim::new($write, $file);
            let config = ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() };
            proptest!(config, |(damage in damage())| {
                victim.try_bytes(&apply(&victim.bytes, &damage));
            });
        }
    )* };
}

damaged! {
    damaged_colmap_cameras: write_colmap, "sparse/0/cameras.bin";
    damaged_colmap_images: write_colmap, "sparse/0/images.bin";
    damaged_colmap_points: write_colmap, "sparse/0/points3D.bin";
    damaged_ply_points: nerfstudio_with_points, "points.ply";
    damaged_dense_cloud: llff_with_cloud, "points3D_downsample2.ply";
    damaged_poses_bounds: write_llff, "poses_bounds.npy";
    damaged_transforms: dnerf, "transforms_train.json";
    damaged_meta: panoptic, "train_meta.json";
    damaged_image: dnerf, "train/r_000.png";
}
