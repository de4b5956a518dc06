//! PSNR between two models, rendered from the first one's orbit: what a codec loses where there are no images to compare with.
//!
//! `cargo run --release --example compare -- MODEL OTHER [FRAMES [WIDTH]]`
#![allow(clippy::print_stdout, reason = "its output is what it is for")]

use cc4dgs::{Error, Orbit, Result, Session};

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut path = || arguments.next().unwrap_or_else(|| "runs/example".into());
    let (first, second) = (path(), path());
    let mut number = |name: &str, other: u32| match arguments.next() {
        Some(n) => n.parse::<u32>().map_err(|_| Error::parameter(name, format!("'{n}' is no number"), format!("Give a whole number, such as {other}"))),
        None => Ok(other),
    };
    let (frames, width) = (number("FRAMES", 12)?, number("WIDTH", 800)?);

    let session = Session::new()?;
    let (a, b) = (session.open(first)?, session.open(second)?);
    let orbit = Orbit { size: (width, width * 3 / 4), frames: frames as usize, ..Orbit::default() };
    let (mut player, mut other) = (session.player(&a)?, session.player(&b)?);
    let mut sum = 0.0;
    for (index, camera) in orbit.around(&a.gaussians)?.iter().enumerate() {
        let (one, two) = (player.frame(camera, orbit.time(index))?, other.frame(camera, orbit.time(index))?);
        let squared: u64 = one.data.iter().zip(&two.data).map(|(&a, &b)| u64::from(a.abs_diff(b)).pow(2)).sum();
        sum += if squared == 0 { 100.0 } else { -10.0 * (squared as f64 / one.data.len() as f64 / 255.0f64.powi(2)).log10() };
    }
    println!("{{\"psnr_db\":{:.4},\"frames\":{frames}}}", sum / f64::from(frames));
    Ok(())
}
