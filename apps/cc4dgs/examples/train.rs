//! Trains the smallest built-in scene and scores the images of its held-out camera.
//!
//! `cargo run --release --example train -- FOLDER [ITERATIONS]`. The folder must not hold a run yet.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::{Event, Result, Session, Split};
use std::path::PathBuf;
use std::sync::Arc;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "runs/example".into()));
    let iterations = arguments.next().unwrap_or_else(|| "600".into());

    // Library code never prints: progress comes as events.
    let session = Session::builder()
        .on_event(|event| {
            if let Event::StageFinished { stage, seconds, gaussians } = event {
                println!("stage {stage}: {seconds:.1} s, {gaussians} Gaussians");
            }
        })
        .build()?;

    // A preset, with any of its keys overridden (`cc4dgs plugins demo` shows them).
    let config = session.config("demo", &[&format!("train.iterations={iterations}")])?;
    let scene = Arc::new(session.read_scene("procedural:tiny", &config.scene)?);
    let model = session.train(&config, scene.clone(), Some(&folder))?;

    let report = session.evaluate(&model, &scene, Split::Test)?;
    let (lower, upper) = model.bounds();
    println!("{}: {:.2} dB, SSIM {:.4} over {} images", report.scene, report.psnr_db, report.ssim, report.images.len());
    println!("{} Gaussians between {lower:?} and {upper:?}, {:.3} MB as float32", report.gaussians, report.size_mb.total);
    Ok(())
}
