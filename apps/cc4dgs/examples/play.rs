//! Plays a model while a camera circles it: PNG frames, and a video where the ffmpeg command is installed.
//!
//! `cargo run --release --example play -- MODEL FOLDER [FRAMES]`. The model is the folder of a run, a checkpoint, an archive, a PLY or an SPZ file.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::{Error, Orbit, Result, Session, video, write_png};
use std::path::PathBuf;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let model = arguments.next().unwrap_or_else(|| "runs/example".into());
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "runs/frames".into()));
    let frames = match arguments.next() {
        Some(n) => n.parse::<usize>().map_err(|_| Error::parameter("FRAMES", format!("'{n}' is no number"), "Give a whole number, such as 24"))?,
        None => 24,
    };

    let session = Session::new()?;
    let model = session.open(model)?;
    let orbit = Orbit { size: (320, 240), frames, ..Orbit::default() };
    let mut player = session.player(&model)?;
    for (index, camera) in orbit.around(&model.gaussians)?.iter().enumerate() {
        // Time runs from 0 to 1 over the circle.
        let image = player.frame(camera, orbit.time(index))?;
        write_png(folder.join(video::frame_name(index)), &image)?;
    }
    println!("{frames} frames in {}; the deformer moved {} of {} Gaussians", folder.display(), player.moving(), model.gaussians.len());

    if video::ffmpeg_version().is_ok() {
        let file = folder.join("orbit.mp4");
        video::encode(&folder, frames, 12.0, &file)?;
        println!("video {}", file.display());
    }
    Ok(())
}
