//! Arguments of `decompress`, `render` and `export`: models in the formats of other programs.

use super::{SplitArg, UpArg, parse_rate, parse_size};
use clap::Args;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Decompress {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The file to write: PLY in the layout of 3DGS, or Niantic's SPZ where it ends in .spz. Endings of other formats of `export` are refused.
    #[arg(long, value_name = "F.ply|F.spz")]
    pub out: PathBuf,
    /// Replace the file where it exists.
    #[arg(long)]
    pub overwrite: bool,
    /// Leave the dynamic scores out, for viewers that insist on the 62 floats of static 3DGS.
    #[arg(long)]
    pub no_dynamic: bool,
    /// The Gaussians as deformed at this time (0 to 1) instead of the canonical ones.
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    pub time: Option<f32>,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "flex")]
    pub device: String,
}

#[derive(Debug, Args)]
pub struct Render {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// Folder for the frames, frame_00000.png and on.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace the frames of an earlier command in DIR, if it marked DIR (.cc4dgs-images), and the video.
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    pub shots: Shots,
    /// Scene options over those the model was trained with, such as scene.width=800 (larger than the dataset's images: --size); with --scene only; may be given
    /// several times.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "scene")]
    pub sets: Vec<String>,
    /// Also make a video of the frames with the ffmpeg command.
    #[arg(long, value_name = "F.mp4")]
    pub mp4: Option<PathBuf>,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
}

/// What to draw: an orbit, or the views of a dataset.
#[derive(Debug, Args)]
pub struct Shots {
    /// Take the cameras and times of this dataset instead of an orbit around the model.
    #[arg(long, value_name = "PATH")]
    pub scene: Option<PathBuf>,
    /// Which side of the dataset's split; with --scene only [default: test].
    #[arg(long, value_enum, requires = "scene")]
    pub split: Option<SplitArg>,
    /// Number of frames: of the orbit (60 by default); at most so many of the dataset, spread over cameras and frames (all by default); of ply-sequence (those
    /// of training by default).
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub frames: Option<u32>,
    /// Image size in pixels; by default 800x600 for an orbit, for datasets their own.
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<(u32, u32)>,
    /// Full turns of the orbit while time runs from 0 to 1; negative ones go the other way [default: 1].
    #[arg(long, value_name = "TURNS", conflicts_with = "scene", allow_negative_numbers = true)]
    pub turns: Option<f64>,
    /// The axis of the world that points up, for an orbit, for gltf, and for a page in place of what the model states [default: z].
    #[arg(long, value_enum, allow_hyphen_values = true)]
    pub up: Option<UpArg>,
    /// Frames per second of a video, such as 29.97, and of a page in place of what the model states [default: 30].
    #[arg(long, value_name = "N", value_parser = parse_rate)]
    pub fps: Option<f64>,
}

impl Shots {
    /// Frames per second.
    pub fn rate(&self) -> f64 {
        self.fps.unwrap_or(30.0)
    }
    /// Side of the dataset's split.
    pub fn split(&self) -> SplitArg {
        self.split.unwrap_or(SplitArg::Test)
    }
    /// Full turns of the orbit.
    pub fn turns(&self) -> f64 {
        self.turns.unwrap_or(1.0)
    }
    /// The axis that points up.
    pub fn up(&self) -> UpArg {
        self.up.unwrap_or(UpArg::Z)
    }
}

#[derive(Debug, Args)]
pub struct Export {
    /// The format: web (a page that plays), ply, ply-sequence, spz, sog, gltf, splatv, mp4; `cc4dgs plugins` lists all, with their settings.
    #[arg(value_name = "FORMAT")]
    pub format: String,
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The file to write; a folder for ply-sequence, and for web where the name does not end in .html.
    #[arg(long, value_name = "PATH")]
    pub out: PathBuf,
    /// Replace PATH where it exists.
    #[arg(long)]
    pub overwrite: bool,
    /// The instant (0 to 1) that formats without motion hold; without it, the canonical Gaussians. Formats with motion refuse it.
    #[arg(long, value_name = "T", allow_negative_numbers = true)]
    pub time: Option<f32>,
    /// Override a setting of the exporter (palette=8192), or with --scene a scene option (scene.width=800); may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    #[command(flatten)]
    pub shots: Shots,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
}
