//! The commands.

mod bake;
mod bench;
mod compress;
mod decompress;
mod demo;
mod doctor;
// Needs no window, so it is tested without one.
#[cfg(any(feature = "view", test))]
mod ending;
mod eval;
// Needs no window, so it is tested without one.
#[cfg(any(feature = "view", test))]
mod exact;
mod export;
mod image_folder;
mod info;
mod plugins;
mod prune;
mod render;
mod report;
mod storage;
mod stress;
mod sweep;
mod train;
#[cfg(feature = "view")]
mod view;
#[cfg(any(feature = "view", test))]
mod view_command;
#[cfg(feature = "view")]
mod watch;

use crate::args::{BenchWhat, Cli, Command, SweepWhat};
use crate::listeners::Progress;
use crate::output::Output;
use cc4dgs::runs::check_writable as check_folder_writable;
use cc4dgs_core::archive::behind_links;
use cc4dgs_core::exporter::refuse_existing;
use cc4dgs_core::{Error, EventSink, Fanout, Limits, Registry, Result, config};
use cc4dgs_train::event_log::JsonLines;
use std::path::Path;

/// What every command is handed.
pub struct Context<'a> {
    pub registry: Registry,
    pub output: &'a Output,
    pub limits: Limits,
    /// The `--limit` options as they came.
    pub limit_options: &'a [String],
}

impl Context<'_> {
    /// The listeners of a command: progress unless `--quiet`, and a log if `log` names a file.
    pub fn listeners(&self, log: Option<(&Path, bool)>) -> Result<Fanout> {
        let mut sinks: Vec<Box<dyn EventSink>> = Vec::new();
        if !self.output.quiet() {
            sinks.push(Box::new(Progress::new()));
        }
        if let Some((path, append)) = log {
            sinks.push(Box::new(JsonLines::open(path, append)?));
        }
        Ok(Fanout(sinks))
    }
}

/// Stack of a thread in bytes: commands run on the pool's threads, so it is that of a main thread.
const STACK: usize = 8 << 20;

/// Runs the command that was asked for, on a thread of the pool: an operation in parallel then starts at once. From outside, each of the thousands of a
/// training step would wake the pool's threads and wait for them.
pub fn dispatch(cli: &Cli, output: &Output) -> Result<()> {
    // Where the pool already runs (a program calling `run` twice), it stays as it is: results do not depend on it.
    rayon::ThreadPoolBuilder::new().num_threads(cli.threads).stack_size(STACK).build_global().ok();
    #[cfg(feature = "view")]
    if let Command::View(args) = &cli.command {
        view_command::refuse_json(cli.json.as_deref())?;
        // The window belongs on the main thread.
        let opened = rayon::scope(|_| view::prepare(&context(cli, output)?, args))?;
        return view::show(args, limits(&cli.limits)?, opened);
    }
    #[cfg(feature = "view")]
    if let Command::Train(args) = &cli.command
        && args.view
    {
        return watch::run(args, |work| rayon::scope(|_| work(&context(cli, output)?)));
    }
    rayon::scope(|_| run(cli, output))
}

fn context<'a>(cli: &'a Cli, output: &'a Output) -> Result<Context<'a>> {
    Ok(Context { registry: Registry::collect()?, output, limits: limits(&cli.limits)?, limit_options: &cli.limits })
}

fn run(cli: &Cli, output: &Output) -> Result<()> {
    let context = context(cli, output)?;
    match &cli.command {
        Command::Demo(args) => demo::run(&context, args),
        #[cfg(not(feature = "view"))]
        Command::Train(args) if args.view => Err(no_window("train --view".into())),
        Command::Train(args) => train::run(&context, args, None),
        Command::Compress(args) => compress::run(&context, args),
        Command::Export(args) => export::run(&context, args),
        Command::Prune(args) => prune::run(&context, args),
        Command::Bake(args) => bake::run(&context, args),
        #[cfg(feature = "view")]
        Command::View(args) => view::show(args, context.limits, view::prepare(&context, args)?),
        #[cfg(not(feature = "view"))]
        Command::View(args) => {
            let command = args.given.iter().fold("view".to_string(), |command, word| format!("{command} {}", word.to_string_lossy()));
            Err(no_window(command))
        }
        Command::Decompress(args) => decompress::run(&context, args),
        Command::Render(args) => render::run(&context, args),
        Command::Eval(args) => eval::run(&context, args),
        Command::Report(args) => report::run(&context, args),
        Command::Info(args) => info::run(&context, args),
        Command::Plugins(args) => plugins::run(&context, args),
        Command::Doctor(_) => doctor::run(&context),
        Command::Stress(args) => stress::run(&context, args),
        Command::Sweep(args) => match &args.what {
            SweepWhat::Plan(args) => sweep::plan(&context, args),
            SweepWhat::Run(args) => sweep::run(&context, args, cli.threads),
            SweepWhat::Collect(args) => sweep::collect(&context, args),
            SweepWhat::Emit(args) => sweep::emit(&context, args, cli.threads),
        },
        Command::Bench(args) => match &args.what {
            BenchWhat::Step(args) => bench::step(&context, args),
            BenchWhat::Frame(args) => bench::frame(&context, args),
            BenchWhat::Play(args) => bench::play(&context, args),
            BenchWhat::Skip(args) => bench::skip(&context, args),
            BenchWhat::Agree(args) => bench::agree(&context, args),
            BenchWhat::Field(args) => bench::field(&context, args),
            BenchWhat::Lookup(args) => bench::lookup(&context, args),
            BenchWhat::Sort(args) => bench::sort(&context, args),
            BenchWhat::Loss(args) => bench::loss(&context, args),
        },
    }
}

fn limits(options: &[String]) -> Result<Limits> {
    if let Some(option) = options.iter().find(|option| !option.contains('=')) {
        return Err(Error::parameter(format!("--limit {option}"), "no '=' found", "Write --limit NAME=VALUE, such as --limit max_gaussians=50000000"));
    }
    let mut table = toml::Table::new();
    config::set_all(&mut table, options)?;
    config::parse_section("--limit", &table)
}

/// The error of `command`, which needs a window, in a build without one.
#[cfg(not(feature = "view"))]
fn no_window(command: String) -> Error {
    let remedy = "Build with the feature `view`: cargo run --release -p cc4dgs-cli --features view -- view MODEL (or train --view ...)";
    Error::unsupported(command, "the window is left out of this build", remedy)
}

/// Refuses a file `path` that exists, unless it may be replaced, that of a folder, and one that cannot be written, before any long work that would be lost.
/// Nothing is created.
///
/// # Errors
/// Those of [`refuse_existing`] and of [`check_writable`].
pub fn check_file(path: &Path, overwrite: bool) -> Result<()> {
    refuse_existing(path, overwrite)?;
    check_writable(path)
}

/// Refuses a file `path` whose folder, or the nearest one of those around it that exists, cannot be written. Devices and pipes need no folder.
///
/// # Errors
/// [`Error::Io`] that names the folder.
pub fn check_writable(path: &Path) -> Result<()> {
    if path.metadata().is_ok_and(|found| !found.is_file() && !found.is_dir()) {
        return Ok(());
    }
    check_folder_writable(behind_links(path)?.parent().unwrap_or(Path::new("")))
}

/// Creates the folder of the file `path`, and refuses a `path` that is a folder, before any long work that would be lost.
pub fn create_parent(path: &Path) -> Result<()> {
    refuse_existing(path, true)?;
    match path.parent().filter(|p| !p.as_os_str().is_empty()) {
        Some(folder) => std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e)),
        None => Ok(()),
    }
}

/// Whether `path` exists in the folder of the scene at `scene`, or is this folder. Built-in scenes have none.
fn lies_in(path: &Path, scene: &Path) -> bool {
    let Ok(scene) = scene.canonicalize() else { return false };
    let folder = if scene.is_file() { scene.parent() } else { Some(scene.as_path()) };
    folder.is_some_and(|folder| path.canonicalize().is_ok_and(|path| path.starts_with(folder)))
}

/// `bytes` as MB = 10^6 bytes.
pub fn megabytes(bytes: u64) -> f64 {
    bytes as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_are_read_strictly() {
        assert_eq!(limits(&["max_gaussians=7".into()]).unwrap(), Limits { max_gaussians: 7, ..Limits::default() });
        for bad in ["max_gausians=7", "max_bytes=-1", "max_bytes"] {
            assert!(limits(&[bad.into()]).is_err(), "{bad}");
        }
        let message = limits(&["max_bytes".into()]).unwrap_err().to_string();
        assert!(message.starts_with("--limit max_bytes: ") && !message.contains("--set"), "{message}");
    }

    #[test]
    fn a_file_is_not_written_in_place_of_a_folder() {
        let folder = tempfile::tempdir().unwrap();
        assert!(create_parent(folder.path()).unwrap_err().to_string().contains("it is a folder"));
        create_parent(&folder.path().join("new/model.cc4d")).unwrap();
        assert!(folder.path().join("new").is_dir());
    }

    #[test]
    fn what_cannot_be_written_is_refused_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("mine"), "").unwrap();
        check_file(&at("deep/er/model.cc4d"), false).unwrap();
        assert!(!at("deep").exists(), "nothing is created");
        assert!(check_file(&at("mine"), false).unwrap_err().to_string().contains("--overwrite"));
        check_file(&at("mine"), true).unwrap();
        assert!(check_file(&at("new/"), true).unwrap_err().to_string().contains("ends with a separator"));
        // Unlike missing permissions, a file in place of a folder stops administrators, too.
        let message = check_file(&at("mine/deep/model.cc4d"), true).unwrap_err().to_string();
        assert!(message.contains("mine: "), "{message}");
        #[cfg(unix)]
        {
            check_writable(Path::new("/dev/null")).unwrap();
            std::os::unix::fs::symlink("mine/model.cc4d", at("link")).unwrap();
            assert!(check_file(&at("link"), true).is_err(), "the folder behind the link counts");
        }
    }
}
