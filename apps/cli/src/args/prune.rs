//! Arguments of `prune`.

use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Prune {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The dataset that the model was trained on.
    #[arg(long, value_name = "PATH")]
    pub scene: PathBuf,
    /// Largest loss of PSNR in dB, on validation views where there are some (those of the dataset, or of train.validation), else on training views.
    #[arg(long, value_name = "DB", default_value = "0.1dB", value_parser = parse_decibels)]
    pub max_drop: f64,
    /// Iterations of training after each round of removal; 0 removes without training.
    #[arg(long, value_name = "N", default_value_t = 200)]
    pub refit: usize,
    /// The archive to write, lossless; compress it as you would the model.
    #[arg(long, value_name = "F.cc4d")]
    pub out: PathBuf,
    /// Replace F.cc4d where it exists.
    #[arg(long)]
    pub overwrite: bool,
    /// Scene options over those the model was trained with, such as scene.ffmpeg=/opt/ffmpeg/bin/ffmpeg; may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Device to render and to train on.
    #[arg(long, value_name = "NAME", default_value = "flex")]
    pub device: String,
}

/// A number of decibels, with or without the unit.
fn parse_decibels(text: &str) -> Result<f64, String> {
    let number = text.strip_suffix("dB").unwrap_or(text).trim().parse::<f64>().ok().filter(|v| *v > 0.0 && v.is_finite());
    number.ok_or_else(|| format!("'{text}' is no positive number of dB, such as 0.1dB"))
}
