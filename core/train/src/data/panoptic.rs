//! PanopticSports (Dynamic 3D Gaussians): `train_meta.json` and `test_meta.json`, one folder of frames per camera, foreground masks.

use cc4dgs_core::reader::files::{file_name, read_json};
use cc4dgs_core::reader::pose::{Matrix4, matrix4};
use cc4dgs_core::{Distortion, Error, ImageSource, Limits, Plugin, RawCamera, RawScene, RawView, ReaderPlugin, Result, SceneOptions, Split, inventory};
use serde::Deserialize;
use std::collections::HashMap;
use std::path::Path;

/// Everything is indexed by time, then by camera.
#[derive(Deserialize)]
struct Meta {
    w: u32,
    h: u32,
    k: Vec<Vec<[[f64; 3]; 3]>>,
    w2c: Vec<Vec<Vec<Vec<f64>>>>,
    #[serde(rename = "fn")]
    files: Vec<Vec<String>>,
    cam_id: Vec<Vec<i64>>,
}

inventory::submit! {
    ReaderPlugin {
        info: Plugin {
            name: "panoptic",
            version: "1",
            summary: "PanopticSports as Dynamic 3D Gaussians prepares it",
            paper: "Dynamic 3D Gaussians (Luiten et al. 2024)",
            schema: "",
            capabilities: &[],
        },
        looks_for: "train_meta.json and ims/ (PanopticSports)",
        order: 100,
        probe,
        open,
    }
}

fn probe(path: &Path) -> bool {
    path.join("train_meta.json").is_file()
}

fn open(path: &Path, _: &SceneOptions, limits: &Limits) -> Result<RawScene> {
    let mut scene = RawScene { name: file_name(path), ..Default::default() };
    let mut known = HashMap::new();
    read_meta(path, "train_meta.json", Split::Train, limits, &mut scene, &mut known)?;
    if path.join("test_meta.json").is_file() {
        read_meta(path, "test_meta.json", Split::Test, limits, &mut scene, &mut known)?;
    } else {
        scene.warnings.push("there is no test_meta.json; nothing is held out".into());
    }
    Ok(scene)
}

/// A camera that does not move is one camera: the key is its id and the bits of its numbers.
type Key = (i64, Vec<u64>);

fn read_meta(folder: &Path, name: &str, split: Split, limits: &Limits, scene: &mut RawScene, known: &mut HashMap<Key, usize>) -> Result<()> {
    let file = folder.join(name);
    let object = file.display().to_string();
    let meta: Meta = read_json(&file, limits)?;
    let bad = |problem: String| Error::data(object.clone(), problem, "Fetch the file again");
    let times = meta.files.len();
    if meta.k.len() != times || meta.w2c.len() != times || meta.cam_id.len() != times {
        return Err(bad(format!("fn, k, w2c and cam_id have {times}, {}, {} and {} times", meta.k.len(), meta.w2c.len(), meta.cam_id.len())));
    }
    for t in 0..times {
        let cameras = meta.files[t].len();
        if meta.k[t].len() != cameras || meta.w2c[t].len() != cameras || meta.cam_id[t].len() != cameras {
            return Err(bad(format!("time {t}: fn, k, w2c and cam_id name different numbers of cameras")));
        }
        for c in 0..cameras {
            let (id, k) = (meta.cam_id[t][c], &meta.k[t][c]);
            let w2c: Matrix4 = matrix4(&meta.w2c[t][c]).map_err(|e| bad(format!("w2c of time {t}, camera {id}: {e}")))?;
            let numbers = k.iter().flatten().chain(w2c.iter().flatten()).map(|v| v.to_bits()).collect();
            let camera = *known.entry((id, numbers)).or_insert_with(|| {
                scene.cameras.push(RawCamera {
                    name: id.to_string(),
                    size: [meta.w, meta.h],
                    focal: [k[0][0], k[1][1]],
                    principal: [k[0][2], k[1][2]],
                    distortion: Distortion::None,
                    world_to_camera: w2c,
                });
                scene.cameras.len() - 1
            });
            let path = folder.join("ims").join(&meta.files[t][c]);
            let mask = Some(folder.join("seg").join(&meta.files[t][c]).with_extension("png"));
            scene.views.push(RawView { camera, frame: t, time: None, split, image: ImageSource::File { path, mask, depth: None } });
        }
    }
    Ok(())
}
