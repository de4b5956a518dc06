//! The command line.

mod bench;
mod files;
mod numbers;
mod play;
mod prune;
mod sweep;

pub use bench::{Bench, BenchAgree, BenchField, BenchFrame, BenchLookup, BenchLoss, BenchPlay, BenchSkip, BenchSort, BenchStep, BenchWhat};
pub use files::{Decompress, Export, Render, Shots};
pub use play::{Bake, View};
#[cfg(any(feature = "view", test))]
pub use play::{VIEW_DEVICE, VIEW_MAX_ERROR};
pub use prune::Prune;
pub use sweep::{SchedulerArg, Sweep, SweepCollect, SweepEmit, SweepPlan, SweepRun, SweepWhat};

use cc4dgs::video::RATES;
use cc4dgs_play::OrbitViews;
use clap::{Args, Parser, Subcommand, ValueEnum};
use numbers::{parse_minutes, parse_threads};
use std::path::PathBuf;

const EXIT_CODES: &str = "Exit codes: 0 done, 2 user error, 3 data error, 4 out of memory or over a limit, 5 backend, 6 a training that failed, 130 interrupted. Sizes are in MB = 10^6 bytes.";

/// Dynamic Gaussian splatting: train, compress, play back.
#[derive(Debug, Parser)]
#[command(name = "cc4dgs", version, about, after_help = EXIT_CODES, subcommand_precedence_over_arg = true, arg_required_else_help = true)]
pub struct Cli {
    /// Write the result as JSON, to FILE or (without one) to standard output. Put it last or write --json=FILE. An earlier result in FILE is removed before the
    /// command begins; any other FILE is refused.
    #[arg(long, global = true, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    pub json: Option<PathBuf>,
    /// Print results and errors only.
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// Threads to compute with, at most 1024; 0 uses all cores. Plans of the preset auto depend on it, other results do not.
    #[arg(long, global = true, value_name = "N", default_value_t = 0, value_parser = parse_threads)]
    pub threads: usize,
    /// Raise or lower what readers accept of a file: max_bytes, max_gaussians, max_pixels or max_depth, such as max_gaussians=50000000; may be given several
    /// times.
    #[arg(long = "limit", global = true, value_name = "NAME=VALUE")]
    pub limits: Vec<String>,
    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Train the built-in scene, compress it, evaluate both and draw a contact sheet: the whole chain in minutes.
    Demo(Demo),
    /// Train a scene. Leaves DIR/checkpoint, DIR/config.toml and DIR/events.jsonl.
    Train(Train),
    /// Store a trained model as a .cc4d archive.
    Compress(Compress),
    /// Write a model as a page that plays it, or in the file format of other programs: PLY, SPZ, SOG, glTF, splatV, MP4.
    Export(Export),
    /// Remove the Gaussians that contribute least, under a budget of PSNR.
    Prune(Prune),
    /// Add a playback layer to a model's archive, so that players without the deformer can play it.
    Bake(Bake),
    /// Play a model in a window.
    #[cfg_attr(not(feature = "view"), command(hide = true))]
    View(View),
    /// The same as `export ply` or `export spz`, by the ending of the file.
    Decompress(Decompress),
    /// Render a model to PNG frames, and to a video if asked; `export mp4` makes the video alone.
    Render(Render),
    /// Measure a model against the images of a scene.
    Eval(Eval),
    /// Make an HTML page, and CSV, Markdown and LaTeX tables, from the results of a sweep.
    Report(Report),
    /// Show what a model (checkpoint, archive, PLY, SPZ) or a scene contains.
    Info(Info),
    /// List the plug-ins, or show one with its settings.
    Plugins(Plugins),
    /// Check this machine: processor, threads, devices, adapters, ffmpeg, the page of the player, the weights of LPIPS, and an image drawn on each device.
    Doctor(Doctor),
    /// Compare float32 with float64 under conditions that break floating point. Exit code 5 where a result is neither finite nor an error, and where an
    /// ordinary condition ends with an error.
    Stress(Stress),
    /// Run a grid of scenes, methods, settings, codecs and seeds, and make its tables.
    Sweep(Sweep),
    /// Measure speed.
    Bench(Bench),
}

#[derive(Debug, Args)]
pub struct Demo {
    /// Folder for everything the demo makes.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Start anew where DIR holds a run already.
    #[arg(long)]
    pub overwrite: bool,
    /// Override a setting, such as train.iterations=500; may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Device to compute on [default: flex].
    #[arg(long, value_name = "NAME")]
    pub device: Option<String>,
}

#[derive(Debug, Args)]
pub struct Train {
    /// The folder of a dataset, whose format is recognised; `procedural` is the built-in scene, `procedural:captures/NAME` a built-in capture.
    #[arg(long, value_name = "PATH")]
    pub scene: PathBuf,
    /// Settings to start from: a family, such as dnerf, or a family with another deformer, such as auto+hexplane; `cc4dgs plugins` lists both. Without one and
    /// without --config, `auto` chooses them by looking at the scene.
    #[arg(long, value_name = "NAME")]
    pub preset: Option<String>,
    /// Wall time in minutes that the preset `auto` plans for; by default ten on processors and five on a graphics card.
    #[arg(long, value_name = "M", value_parser = parse_minutes, allow_negative_numbers = true)]
    pub minutes: Option<f64>,
    /// A TOML file laid over the preset.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Override a setting, such as train.iterations=5000; may be given several times. Plug-ins (deformer.kind=…) are chosen first, whatever the order.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Device to compute on: auto, flex, ndarray, wgpu, wgpu:N, cuda. By default a graphics card with the preset auto, if there is one, else flex.
    #[arg(long, value_name = "NAME")]
    pub device: Option<String>,
    /// The run's folder.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Go on from DIR/checkpoint; the result is the same as without the interruption. Settings default to DIR/config.toml.
    #[arg(long)]
    pub resume: bool,
    /// Start anew where DIR holds a run already.
    #[arg(long, conflicts_with = "resume")]
    pub overwrite: bool,
    /// Show the model in a window while it trains. The result is the same.
    #[arg(long)]
    #[cfg_attr(not(feature = "view"), arg(hide = true))]
    pub view: bool,
}

/// What `compress` takes without `--codec` and `--field-weights`: what the paper does, and weights as they are.
pub const COMPRESS_CODEC: &str = "cca:default";
pub const COMPRESS_WEIGHTS: &str = "fp32";

#[derive(Debug, Args)]
pub struct Compress {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// Codec, with its profile after a colon. With --scene, compact:max-drop=0.05dB or compact:max-size=5MB makes the smallest files.
    #[arg(long, value_name = "NAME[:PROFILE]", default_value = COMPRESS_CODEC)]
    pub codec: String,
    /// Override a setting of the codec (finetune=0), or with --scene a scene option (scene.width=800); may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
    /// Weight codec of the deformer, such as fp32, fp16, int8, compact, compact:bits=6 or compact:max-drop=0.01dB; see `cc4dgs plugins`.
    #[arg(long, value_name = "NAME[:SETTING]", default_value = COMPRESS_WEIGHTS)]
    pub field_weights: String,
    /// The dataset that the model was trained on, for codecs that make use of its views; validation views, else training views, judge what is lost.
    #[arg(long, value_name = "PATH")]
    pub scene: Option<PathBuf>,
    /// For codecs that make use of views, N to choose from all round the model, 12 to 512: for an object whose dataset is not there. They see it from outside,
    /// so not for rooms that are seen from within, nor where surroundings hide what matters.
    #[arg(long, value_name = "N", conflicts_with = "scene", value_parser = parse_orbit)]
    pub orbit: Option<usize>,
    /// The archive to write.
    #[arg(long, value_name = "F.cc4d")]
    pub out: PathBuf,
    /// Replace F.cc4d where it exists.
    #[arg(long)]
    pub overwrite: bool,
    /// Device the deformer is loaded on; with --scene or --orbit, the model is also drawn on it, and with --scene trained further.
    #[arg(long, value_name = "NAME", default_value = "flex")]
    pub device: String,
}

/// A model and the views of a dataset to draw with it.
#[derive(Debug, Args)]
pub struct ModelViews {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file.
    #[arg(value_name = "MODEL")]
    pub model: PathBuf,
    /// The dataset, or `procedural`.
    #[arg(long, value_name = "PATH")]
    pub scene: PathBuf,
    /// Which of its images.
    #[arg(long, value_enum, default_value_t = SplitArg::Test)]
    pub split: SplitArg,
    /// Scene options over those the model was trained with, such as scene.width=800 (0 is the images' own size, the largest); may be given several times.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub sets: Vec<String>,
}

#[derive(Debug, Args)]
pub struct Eval {
    #[command(flatten)]
    pub views: ModelViews,
    /// Measure at most so many images, spread over cameras and frames; 0 measures all.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub max_views: usize,
    /// Also measure LPIPS and FLIP, which take longer than drawing the images.
    #[arg(long)]
    pub perceptual: bool,
    /// The contact sheet: ground truth, render and error. Without it, it lies beside the JSON file, in the folder of a run, or beside the model.
    #[arg(long, value_name = "F.png")]
    pub sheet: Option<PathBuf>,
    /// Rows of the contact sheet, spread over cameras and frames; 0 draws none.
    #[arg(long, value_name = "N", default_value_t = 6)]
    pub sheet_rows: usize,
    /// Also write every render as a PNG file into this folder, 00000.png and on. It must be new or empty.
    #[arg(long, value_name = "DIR")]
    pub renders: Option<PathBuf>,
    /// Replace the renders of an earlier command in DIR, if it marked DIR (.cc4dgs-images), and a contact sheet that lies in the folder of the scene.
    #[arg(long)]
    pub overwrite: bool,
    /// Device to compute on.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
}

#[derive(Debug, Args)]
pub struct Report {
    /// The folder of a sweep, a folder of results, or one file of them.
    #[arg(value_name = "DIR")]
    pub results: PathBuf,
    /// The page; tables are written beside it as .csv, .md and .tex. DIR/report.html by default, of a file the .html beside it. Only files of earlier reports
    /// are replaced.
    #[arg(long, value_name = "FILE.html")]
    pub out: Option<PathBuf>,
    /// Heading of the page.
    #[arg(long, value_name = "TEXT")]
    pub title: Option<String>,
    /// Whose images the page contains, where the folder has them.
    #[arg(long, value_enum, default_value_t = ImagesArg::BuiltIn)]
    pub images: ImagesArg,
    /// Views per scene to show images of [default: 3].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=100))]
    pub views: Option<u16>,
    /// Only results with this scene, method, setting, codec, seed, device, adapter, processor, threads or split; may be given several times.
    #[arg(long = "where", value_name = "KEY=VALUE")]
    pub only: Vec<String>,
    /// Columns of the summary tables by their names in the CSV file, such as psnr_db,size_mb,frame_ms; all by default.
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    pub columns: Vec<String>,
    /// Also write every plot with two axes as an SVG file into this folder.
    #[arg(long, value_name = "DIR")]
    pub figures: Option<PathBuf>,
}

/// Whose images a report contains.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ImagesArg {
    /// No images.
    None,
    /// Those of built-in scenes, which may be published.
    BuiltIn,
    /// All, third-party scenes among them: keep such a page on your machine.
    All,
}

#[derive(Debug, Args)]
pub struct Info {
    /// A run's folder, a checkpoint, an archive, a PLY or an SPZ file, or a dataset.
    #[arg(value_name = "PATH")]
    pub path: PathBuf,
}

#[derive(Debug, Args)]
pub struct Plugins {
    /// Show this plug-in with its settings.
    #[arg(value_name = "NAME")]
    pub name: Option<String>,
}

#[derive(Debug, Args)]
pub struct Doctor {}

#[derive(Debug, Args)]
pub struct Stress {
    /// Device to test: auto, flex, ndarray, wgpu, cuda.
    #[arg(long, value_name = "NAME", default_value = "auto")]
    pub device: String,
    /// Take a million optimizer steps (otherwise twenty thousand or fewer), and test each deformer at all times.
    #[arg(long)]
    pub full: bool,
}

/// The parts of a split.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SplitArg {
    /// Images seen in training.
    Train,
    /// Images to choose settings by: those of the dataset, or those that train.validation kept out of training.
    Validation,
    /// Images held out.
    Test,
}

impl From<SplitArg> for cc4dgs_core::Split {
    fn from(split: SplitArg) -> Self {
        match split {
            SplitArg::Train => Self::Train,
            SplitArg::Validation => Self::Validation,
            SplitArg::Test => Self::Test,
        }
    }
}

/// A signed axis of the world.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum UpArg {
    X,
    Y,
    Z,
    #[value(name = "-x")]
    MinusX,
    #[value(name = "-y")]
    MinusY,
    #[value(name = "-z")]
    MinusZ,
}

impl From<UpArg> for [f64; 3] {
    fn from(up: UpArg) -> Self {
        match up {
            UpArg::X => [1.0, 0.0, 0.0],
            UpArg::Y => [0.0, 1.0, 0.0],
            UpArg::Z => [0.0, 0.0, 1.0],
            UpArg::MinusX => [-1.0, 0.0, 0.0],
            UpArg::MinusY => [0.0, -1.0, 0.0],
            UpArg::MinusZ => [0.0, 0.0, -1.0],
        }
    }
}

/// A number of views that an orbit may have.
fn parse_orbit(text: &str) -> Result<usize, String> {
    let (least, most) = (*OrbitViews::COUNTS.start(), *OrbitViews::COUNTS.end());
    text.parse::<usize>().ok().filter(|count| OrbitViews::COUNTS.contains(count)).ok_or_else(|| format!("choose {least} to {most} views"))
}

/// Reads `800x600`.
fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parts = text.split_once(['x', 'X']).and_then(|(w, h)| Some((w.trim().parse().ok()?, h.trim().parse().ok()?)));
    match parts {
        Some((w, h)) if (1..=16384).contains(&w) && (1..=16384).contains(&h) => Ok((w, h)),
        _ => Err("write WIDTHxHEIGHT in pixels, each from 1 to 16384, such as 800x600".into()),
    }
}

/// Reads a number of images per second.
fn parse_rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate| RATES.contains(rate));
    rate.ok_or_else(|| format!("write a number from {} to {}, such as 29.97", RATES.start(), RATES.end()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn json_takes_a_file_or_none_in_every_place() {
        let json = |args: &[&str]| Cli::try_parse_from(args).unwrap().json.map(|p| p.display().to_string());
        assert_eq!(json(&["cc4dgs", "plugins", "--json"]).as_deref(), Some("-"));
        assert_eq!(json(&["cc4dgs", "--json", "plugins"]).as_deref(), Some("-"));
        assert_eq!(json(&["cc4dgs", "demo", "--out", "d", "--json"]).as_deref(), Some("-"));
        assert_eq!(json(&["cc4dgs", "demo", "--json", "--out", "d"]).as_deref(), Some("-"));
        assert_eq!(json(&["cc4dgs", "eval", "D", "--scene", "P", "--split", "test", "--json", "F.json"]).as_deref(), Some("F.json"));
        assert_eq!(json(&["cc4dgs", "bench", "step", "--device", "flex", "--json", "F.json"]).as_deref(), Some("F.json"));
        assert_eq!(json(&["cc4dgs", "doctor"]), None);
    }

    #[test]
    fn sizes_are_read_strictly() {
        assert_eq!(parse_size("800x600"), Ok((800, 600)));
        for bad in ["800", "0x5", "5x", "-1x4", "99999x4", "4x4x4"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn rates_of_videos_need_not_be_whole() {
        for (text, rate) in [("30", 30.0), ("29.97", 29.97), ("0.5", 0.5)] {
            assert_eq!(parse_rate(text), Ok(rate));
        }
        for bad in ["0", "-3", "1001", "NaN", "fast"] {
            assert!(parse_rate(bad).unwrap_err().contains("0.01 to 1000"), "{bad}");
        }
    }
}
