//! The golden images and the scores of published packages, for tests.

use super::Planes;
use crate::Image8;
use serde_json::Value;
use std::path::PathBuf;

/// Calls `check` with the name, the two images and the scores of every pair of `perceptual.json`.
pub fn pairs(mut check: impl FnMut(&str, &Planes, &Planes, &Value)) {
    let committed = PathBuf::from("../../tests/fixtures/golden");
    let folder = std::env::var_os("CC4DGS_GOLDEN").map(PathBuf::from).filter(|f| f.join("perceptual.json").is_file()).unwrap_or(committed);
    let text = std::fs::read_to_string(folder.join("perceptual.json")).expect("perceptual.json in the golden folder");
    let file: Value = serde_json::from_str(&text).expect("JSON");
    let image = |name: &Value| {
        let path = folder.join(name.as_str().expect("a path"));
        let rgb = image::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).to_rgb8();
        let (width, height) = rgb.dimensions();
        Planes::from_image8(&Image8 { width, height, channels: 3, data: rgb.into_raw() }).expect("an image")
    };
    for pair in file["pairs"].as_array().expect("pairs") {
        check(pair["b"].as_str().unwrap_or_default(), &image(&pair["a"]), &image(&pair["b"]), pair);
    }
}
