//! Arguments of `bake` and `view`.

use super::UpArg;
use clap::Args;
#[cfg(not(feature = "view"))]
use std::ffi::OsString;
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Bake {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The archive to write.
    #[arg(long, value_name = "F.cc4d")]
    pub out: PathBuf,
    /// Replace F.cc4d where it exists.
    #[arg(long)]
    pub overwrite: bool,
    /// How far a point of a Gaussian may be off: pixels in the nearest camera that sees it (0.1px), or a length in units of the model (0.002).
    #[arg(long, value_name = "E", default_value = "0.1px")]
    pub max_error: String,
    /// The dataset that the model was trained on: its cameras are those of --max-error, and players offer them. Without it, an orbit round the model.
    #[arg(long, value_name = "PATH")]
    pub scene: Option<PathBuf>,
    /// Scene options over those the model was trained with, such as scene.ffmpeg=/opt/ffmpeg/bin/ffmpeg; with --scene only; may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE", requires = "scene")]
    pub sets: Vec<String>,
    /// Codec of the Gaussians, where MODEL is no archive yet [default: quantize:high].
    #[arg(long, value_name = "NAME[:PROFILE]")]
    pub codec: Option<String>,
    /// Weight codec of the deformer, where MODEL is no archive yet [default: fp16].
    #[arg(long, value_name = "NAME")]
    pub field_weights: Option<String>,
    /// Leave the deformer's weights out. The archive is smaller and moves by its layer; it can be neither compressed again nor pruned.
    #[arg(long)]
    pub without_field: bool,
    /// Frames per second of the recording; by default that of the archive, or 30.
    #[arg(long, value_name = "N")]
    pub fps: Option<f32>,
    /// The signed axis that points up: x, -x, y, -y, z or -z. By default that of the scene's cameras, or z.
    #[arg(long, value_enum, allow_hyphen_values = true)]
    pub up: Option<UpArg>,
    /// Leave out the small image that players show first.
    #[arg(long)]
    pub no_poster: bool,
    /// Device the deformer is evaluated on.
    #[arg(long, value_name = "NAME", default_value = "flex")]
    pub device: String,
}

/// What `view` takes without `--device` and `--max-error`.
#[cfg(any(feature = "view", test))]
pub const VIEW_DEVICE: &str = "flex";
#[cfg(any(feature = "view", test))]
pub const VIEW_MAX_ERROR: &str = "0.1px";

#[cfg(feature = "view")]
#[derive(Debug, Args)]
pub struct View {
    /// An archive, a run's folder, a checkpoint, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// How far a point of a Gaussian may be off where motion has to be baked first; as for `bake`.
    #[arg(long, value_name = "E", default_value = VIEW_MAX_ERROR)]
    pub max_error: String,
    /// Stand still at this normalised time, 0 to 1, instead of playing from the first frame.
    #[arg(long, value_name = "T")]
    pub time: Option<String>,
    /// Begin at this pose: numbers with commas between, as "Print command" in the window and the links of the page have them.
    #[arg(long, value_name = "P", allow_hyphen_values = true)]
    pub pose: Option<String>,
    /// Device that motion is baked on, and that exact images are drawn on.
    #[arg(long, value_name = "NAME", default_value = VIEW_DEVICE)]
    pub device: String,
}

// Whatever is given: the command answers that it is left out of this build.
#[cfg(not(feature = "view"))]
#[derive(Debug, Args)]
pub struct View {
    #[arg(value_name = "MODEL", trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    pub given: Vec<OsString>,
}
