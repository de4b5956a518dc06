//! The options of `cc4dgs sweep`.

use super::numbers::parse_minutes;
use clap::{Args, Subcommand, ValueEnum};
use std::path::PathBuf;

#[derive(Debug, Args)]
pub struct Sweep {
    #[command(subcommand)]
    pub what: SweepWhat,
}

#[derive(Debug, Subcommand)]
pub enum SweepWhat {
    /// Expand a grid into trainings and cells.
    Plan(SweepPlan),
    /// Run what is missing: everything, one training, or one cell.
    Run(SweepRun),
    /// Check that every cell is there, and write the tables.
    Collect(SweepCollect),
    /// Print a job file for a scheduler: each index runs one training with its cells, on --threads threads (one by default) and with the --limit options given
    /// here.
    Emit(SweepEmit),
}

#[derive(Debug, Args)]
pub struct SweepPlan {
    /// The grid; see docs/sweeps.md.
    #[arg(value_name = "GRID.toml")]
    pub grid: PathBuf,
    /// The sweep's folder. Without it, the plan is checked and shown, and nothing is written.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Size: wall minutes of a training, in place of the grid's.
    #[arg(long, value_name = "M", conflicts_with = "iterations", value_parser = parse_minutes, allow_negative_numbers = true)]
    pub minutes: Option<f64>,
    /// Size: iterations of a training, in place of the grid's.
    #[arg(long, value_name = "N")]
    pub iterations: Option<usize>,
    /// Number of seeds, from 0, in place of the grid's.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub seeds: Option<u64>,
    /// Device, in place of the grid's.
    #[arg(long, value_name = "NAME")]
    pub device: Option<String>,
}

#[derive(Debug, Args)]
pub struct SweepRun {
    /// The sweep's folder.
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Processes at a time, each with --threads threads; by default as many as there are cores for, and without --threads one, which uses all cores.
    #[arg(long, value_name = "P", conflicts_with_all = ["cell", "index"], value_parser = clap::value_parser!(u64).range(1..=1024))]
    pub jobs: Option<u64>,
    /// Run one cell, and its training if that is missing.
    #[arg(long, value_name = "ID", conflicts_with = "index", group = "one")]
    pub cell: Option<String>,
    /// Run the I-th training, from 0, with all of its cells.
    #[arg(long, value_name = "I", group = "one")]
    pub index: Option<usize>,
    /// Refuse to run if the folder has another plan by now, so that an index cannot mean another training; `sweep emit` writes it into job files.
    #[arg(long, value_name = "ID", requires = "index")]
    pub plan: Option<String>,
    /// Leave a training that another process works on (exit code 75) instead of waiting.
    #[arg(long, hide = true, requires = "one")]
    pub no_wait: bool,
    /// Processes that share the memory of this machine, this one included.
    #[arg(long, hide = true, value_name = "N", default_value_t = 1, requires = "one")]
    pub processes: usize,
}

#[derive(Debug, Args)]
pub struct SweepCollect {
    /// The sweep's folder.
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// Make tables of what is there, also where cells are missing.
    #[arg(long)]
    pub partial: bool,
    /// Tables of these results only: scene, method, setting, codec, seed, device, adapter, processor, threads or split; may be given several times.
    #[arg(long = "where", value_name = "KEY=VALUE")]
    pub conditions: Vec<String>,
}

/// Schedulers that job files are made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SchedulerArg {
    /// A Slurm array script.
    Slurm,
    /// A Kubernetes Indexed Job.
    K8s,
    /// A SkyPilot task, launched once per index.
    Skypilot,
}

#[derive(Debug, Args)]
pub struct SweepEmit {
    /// The scheduler.
    #[arg(value_name = "SCHEDULER", value_enum)]
    pub scheduler: SchedulerArg,
    /// The sweep's folder, as this command sees it.
    #[arg(value_name = "DIR")]
    pub dir: PathBuf,
    /// The sweep's folder as the jobs see it; by default DIR as an absolute path.
    #[arg(long, value_name = "DIR")]
    pub job_dir: Option<String>,
    /// The folder that jobs run in: relative paths of the grid start there. By default this one; volumes and buckets are mounted there.
    #[arg(long, value_name = "DIR")]
    pub cd: Option<String>,
    /// The program as the jobs see it; by default this one (Slurm) or `cc4dgs`.
    #[arg(long, value_name = "FILE")]
    pub program: Option<String>,
    /// Memory of a job in GB.
    #[arg(long, value_name = "GB", default_value_t = 8)]
    pub memory_gb: u32,
    /// Time limit of a job in minutes; for slurm at least 4. A job that reaches it leaves a checkpoint and goes on later.
    #[arg(long, value_name = "M", default_value_t = 240)]
    pub time_limit: u32,
    /// Jobs at a time (slurm, k8s); 0 leaves it to the scheduler.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub parallel: usize,
    /// Container image; k8s only [default: cc4dgs:latest].
    #[arg(long, value_name = "NAME")]
    pub image: Option<String>,
    /// Persistent volume claim; k8s only [default: cc4dgs].
    #[arg(long, value_name = "NAME")]
    pub claim: Option<String>,
    /// Bucket; skypilot only [default: s3://cc4dgs].
    #[arg(long, value_name = "URL")]
    pub bucket: Option<String>,
    /// Environment variable of the jobs; may be given several times. k8s and skypilot need those that paths of scenes start from, such as CC4DGS_DATA; slurm
    /// takes their values here where they are not given.
    #[arg(long = "env", value_name = "NAME=VALUE")]
    pub variables: Vec<String>,
}
