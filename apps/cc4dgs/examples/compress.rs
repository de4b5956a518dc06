//! Compresses a model with several codecs, and shows what lies in the smallest archive and what it costs.
//!
//! `cargo run --release --example compress -- MODEL FOLDER`.
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::core::archive::Archive;
use cc4dgs::core::metrics::{Metric, Rounding};
use cc4dgs::{Orbit, Result, Session};
use std::path::PathBuf;

const CODECS: [&str; 4] = ["raw", "cca:default", "quantize", "sorted-image"];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let model = arguments.next().unwrap_or_else(|| "runs/example".into());
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "runs/archives".into()));
    std::fs::create_dir_all(&folder).map_err(|e| cc4dgs::Error::io(&folder, e))?;

    let session = Session::new()?;
    let model = session.open(model)?;
    let camera = Orbit { size: (320, 240), ..Orbit::default() }.around(&model.gaussians)?.remove(0);
    let before = session.player(&model)?.frame(&camera, 0.5)?;
    let float32 = model.float32_size().total;

    let mut smallest = (u64::MAX, PathBuf::new());
    for codec in CODECS {
        let file = folder.join(format!("{}.cc4d", codec.replace(':', "-")));
        let bytes = model.save(&file, codec)?;
        // The archive is all that is needed to play it: the same frame, drawn from it.
        let after = session.player(&session.open(&file)?)?.frame(&camera, 0.5)?;
        let psnr = Metric::psnr(Rounding::EightBit).score_images(&before, &after)?;
        println!("{codec:<14} {bytes:>9} bytes, {:.1} times smaller than float32, {psnr:.2} dB against the uncompressed frame", float32 as f64 / bytes as f64);
        smallest = smallest.min((bytes, file));
    }

    let archive = Archive::open(&smallest.1, session.limits())?;
    println!("\n{}: {} Gaussians", smallest.1.display(), archive.manifest().gaussian_count);
    for stream in archive.stream_sizes() {
        println!("  {:<20} {:?}: {} bytes, {} decoded", stream.name, stream.kind, stream.stored_bytes, stream.decoded_bytes);
    }
    Ok(())
}
