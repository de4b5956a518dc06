//! Images by the tile renderer, for comparison with the player in a browser: PNG files and `reference.json`, which names their cameras and times.
//!
//! `cargo run --release -p cc4dgs-player --example reference -- MODEL FOLDER [WIDTHxHEIGHT]`.

use cc4dgs::core::Error;
use cc4dgs::{Orbit, Result, Session, write_png};
use std::path::PathBuf;

const TIMES: [f32; 3] = [0.0, 0.37, 1.0];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let model = arguments.next().unwrap_or_else(|| "model.cc4d".into());
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "reference".into()));
    let size = arguments.next().unwrap_or_else(|| "400x300".into());
    let size = size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let size = size.ok_or_else(|| Error::parameter("size", "it is not WIDTHxHEIGHT", "Write 400x300"))?;

    let session = Session::builder().device("flex").build()?;
    let model = session.open(&model)?;
    let mut player = session.player(&model)?;
    let cameras = Orbit { size, frames: 5, ..Orbit::default() }.around(&model.gaussians)?;
    let mut list = Vec::new();
    for (c, camera) in [&cameras[0], &cameras[2]].into_iter().enumerate() {
        for (t, time) in TIMES.into_iter().enumerate() {
            let name = format!("camera{c}_time{t}.png");
            write_png(folder.join(&name), &player.frame(camera, time)?)?;
            list.push(serde_json::json!({ "image": name, "camera": camera, "time": time }));
        }
    }
    let file = folder.join("reference.json");
    std::fs::write(&file, serde_json::Value::from(list).to_string()).map_err(|e| Error::io(&file, e))
}
