//! The options of `cc4dgs bench`.

use super::ModelViews;
use clap::{Args, Subcommand};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Bench {
    #[command(subcommand)]
    pub what: BenchWhat,
}

#[derive(Debug, Subcommand)]
pub enum BenchWhat {
    /// A whole static training step: project, rasterize, L1 and SSIM, backward, Adam.
    Step(BenchStep),
    /// Playback of a synthetic scene as large as published ones: deformer and rasterizer, frame by frame.
    Frame(BenchFrame),
    /// Playback of a trained model through the cameras of a dataset: deformer and rasterizer, frame by frame.
    Play(BenchPlay),
    /// A trained model with each kind of skipped work switched off: time saved, and whether the bits stay the same.
    Skip(BenchSkip),
    /// The same model on several devices: how far their images differ.
    Agree(BenchAgree),
    /// The computational field forwards and backwards, against the same field in burn's primitives.
    Field(BenchField),
    /// Lookups in the hash grids and planes of the baselines, against the same in burn's primitives.
    Lookup(BenchLookup),
    /// Sorting of growing numbers of pairs.
    Sort(BenchSort),
    /// L1 and SSIM with their gradient on growing images.
    Loss(BenchLoss),
}

#[derive(Debug, Args)]
pub struct BenchField {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Moving Gaussians.
    #[arg(long, value_name = "N", default_value_t = 5_000, value_parser = clap::value_parser!(u64).range(1..=10_000_000))]
    pub gaussians: u64,
    /// Runs measured, after warming up.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeats: u32,
    /// Settings of the field, such as capacity=small; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Root of the seed tree.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub struct BenchSort {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Numbers of pairs.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "10000,100000,1000000", value_parser = clap::value_parser!(u32).range(1..))]
    pub pairs: Vec<u32>,
    /// Runs measured per size, after warming up.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeats: u32,
    /// Root of the seed tree.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub struct BenchLoss {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Sizes of the images, 4:3.
    #[arg(long, value_name = "MP", value_delimiter = ',', default_value = "0.1,0.5,1.4,2.2", value_parser = positive)]
    pub megapixels: Vec<f64>,
    /// Runs measured per size, after warming up.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeats: u32,
    /// Root of the seed tree.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

#[derive(Debug, Args)]
pub struct BenchPlay {
    #[command(flatten)]
    pub views: ModelViews,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Frames measured, after warming up.
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub frames: u32,
}

#[derive(Debug, Args)]
pub struct BenchSkip {
    #[command(flatten)]
    pub views: ModelViews,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Frames measured per case. Each round draws two more before its share: a first one, which is measured by itself, and one to warm up. The first
    /// round draws another one before them, in which kernels compile.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub frames: u32,
    /// Times that all cases take turns, so that a machine that slows down slows all of them down; every round trains every case.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    pub rounds: u32,
    /// Also train for so many iterations per case, with the model's configuration; 0 measures frames alone.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    pub iterations: u32,
}

#[derive(Debug, Args)]
pub struct BenchAgree {
    #[command(flatten)]
    pub views: ModelViews,
    /// Devices, or DEVICE/RASTERIZER where it is not to be the model's rasterizer; all are compared with the first.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "flex,ndarray,wgpu")]
    pub devices: Vec<String>,
    /// Draw at most this many views, spread over cameras and frames; 0 is all.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub max_views: usize,
}

#[derive(Debug, Args)]
pub struct BenchFrame {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Time only this case; may be given again.
    #[arg(long, value_name = "NAME")]
    pub case: Vec<String>,
    /// In place of the cases: one synthetic scene with 10 thousand to 5 million Gaussians, then with images of 0.1 to 8 megapixels.
    #[arg(long, conflicts_with = "case")]
    pub growth: bool,
    /// Frames measured per case, after warming up.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub frames: u32,
    /// Share of the pixels and Gaussians to keep, for machines that are slow.
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, value_parser = positive)]
    pub scale: f64,
    /// Let the deformer move things, by about so many units at most; fresh deformers are the identity.
    #[arg(long, value_name = "UNITS", default_value_t = 0.0, value_parser = not_negative)]
    pub motion: f32,
    /// Also store the model of the case with a playback layer and its camera, for players; there must be one case. An archive F.cc4d is replaced, no other
    /// file.
    #[arg(long, value_name = "F.cc4d")]
    pub archive: Option<PathBuf>,
    /// Settings of the deformer or rasterizer, such as deformer.kind=none; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Root of the seed tree the synthetic scenes are made from.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 && v <= 100.0 => Ok(v),
        _ => Err(format!("'{text}' is not a number above 0 and up to 100")),
    }
}

fn not_negative(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(v) if (0.0..=100.0).contains(&v) => Ok(v),
        _ => Err(format!("'{text}' is not a number from 0 to 100")),
    }
}

#[derive(Debug, Args)]
pub struct BenchStep {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// In place of the standard cases, a synthetic scene as large as published ones (n3dv, technicolor); may be given again.
    #[arg(long, value_name = "NAME")]
    pub case: Vec<String>,
    /// Share of the pixels and Gaussians of synthetic scenes to keep; with --case only.
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, value_parser = positive, requires = "case")]
    pub scale: f64,
    /// Steps measured per case, after warming up.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeats: u32,
    /// Root of the seed tree the scenes are drawn from.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Also time the Gaussians of this golden scene (raster_*.inputs.f64.safetensors); may be given again.
    #[arg(long, value_name = "FILE")]
    pub scene: Vec<PathBuf>,
}

#[derive(Debug, Args)]
pub struct BenchLookup {
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Moving Gaussians.
    #[arg(long, value_name = "N", default_value_t = 40_000, value_parser = clap::value_parser!(u32).range(1..=10_000_000))]
    pub gaussians: u32,
    /// Runs measured, after warming up.
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub repeats: u32,
    /// Root of the seed tree.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

#[cfg(test)]
mod tests {
    use crate::args::Cli;
    use clap::Parser;

    #[test]
    fn options_without_effect_are_refused() {
        let accepted = |line: &str| Cli::try_parse_from(line.split(' ')).map(drop).map_err(|e| e.to_string());
        for line in ["cc4dgs bench frame --case n3dv --scale 0.5", "cc4dgs bench frame --growth --scale 0.5", "cc4dgs bench step --case n3dv --scale 0.5"] {
            assert_eq!(accepted(line), Ok(()));
        }
        for line in ["cc4dgs bench frame --case n3dv --growth", "cc4dgs bench step --scale 0.5"] {
            assert!(accepted(line).unwrap_err().contains("--case"), "{line}");
        }
    }
}
