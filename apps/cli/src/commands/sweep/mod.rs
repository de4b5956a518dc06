//! `cc4dgs sweep`: experiment grids.

mod pool;

use super::Context;
use crate::args::{SchedulerArg, SweepCollect, SweepEmit, SweepPlan, SweepRun};
use crate::ignored::{Stated, refuse_ignored, written};
use crate::interrupt;
use cc4dgs::plugins;
use cc4dgs_core::{Error, Result, config, plural};
use cc4dgs_train::sweep::{
    Busy, Collection, EmitOptions, Grid, Outcome, Plan, Scheduler, SweepFolder, Tables, TrainingState, Worker, collect as collect_results, emit as emit_file,
    run_training, select, summary, write_tables,
};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Exit code of `sweep run --no-wait` where another process works on the training: try again later.
pub const BUSY: u8 = 75;

#[derive(Serialize)]
struct PlanReport {
    name: String,
    trainings: usize,
    cells: usize,
    finished: usize,
    minutes: Option<f64>,
    cells_per_training: usize,
    folder: Option<String>,
}

pub fn plan(context: &Context, args: &SweepPlan) -> Result<()> {
    let grid = grid(args)?;
    let plan = Plan::expand(&grid, &context.registry, &|config| plugins::check(config, &context.registry))?;
    let finished = match &args.out {
        Some(out) => {
            plan.write(out)?;
            let folder = SweepFolder::new(out);
            plan.cells.iter().filter(|cell| folder.finished(cell).is_some()).count()
        }
        None => 0,
    };
    let report = PlanReport {
        name: plan.name.clone(),
        trainings: plan.trainings.len(),
        cells: plan.cells.len(),
        finished,
        minutes: plan.minutes(),
        cells_per_training: grid.codec.len(),
        folder: args.out.as_ref().map(|out| out.display().to_string()),
    };
    context.output.result(&report, || {
        let time = report.minutes.map_or_else(String::new, |minutes| format!(", about {} of training", pool::duration(60.0 * minutes)));
        let next = match &report.folder {
            Some(folder) => format!("run it: {} sweep run {}", program(), word(folder)),
            None => "nothing was written; --out DIR writes the plan".into(),
        };
        let [trainings, cells] = [plural(report.trainings, "training", "trainings"), plural(report.cells, "cell", "cells")];
        let (name, finished) = (&report.name, report.finished);
        format!("{name}: {} {trainings}, {} {cells} ({finished} of them finished){time}\n{next}", report.trainings, report.cells)
    })
}

/// The running program as it was called, as a word of a shell: one that links other plug-ins has another name than `cc4dgs`.
fn program() -> String {
    std::env::args_os().next().map_or_else(|| "cc4dgs".into(), |name| word(&name.to_string_lossy()))
}

/// `text` as one word of a shell, in quotes where it needs some.
fn word(text: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+=:,@%".contains(c) || (cfg!(windows) && c == '\\');
    if !text.is_empty() && text.chars().all(is_plain) { text.into() } else { format!("'{}'", text.replace('\'', "'\\''")) }
}

/// The grid with the options in place of its values, which are held to the same rules.
fn grid(args: &SweepPlan) -> Result<Grid> {
    let text = std::fs::read_to_string(&args.grid).map_err(|e| Error::io(&args.grid, e))?;
    let object = args.grid.display().to_string();
    let mut table = config::parse_table(&object, &text)?;
    let whole = |number: u64| toml::Value::Integer(i64::try_from(number).unwrap_or(i64::MAX));
    if let Some(minutes) = args.minutes {
        table.remove("iterations");
        table.insert("minutes".into(), toml::Value::Float(minutes));
    }
    if let Some(iterations) = args.iterations {
        table.remove("minutes");
        table.insert("iterations".into(), whole(iterations as u64));
    }
    if let Some(seeds) = args.seeds {
        table.insert("seeds".into(), toml::Value::Array((0..seeds).map(whole).collect()));
    }
    if let Some(device) = &args.device {
        table.insert("device".into(), device.as_str().into());
    }
    Grid::of_table(&object, table)
}

pub fn run(context: &Context, args: &SweepRun, threads: usize) -> Result<()> {
    let plan = Plan::read(&args.dir)?;
    if let Some(id) = &args.plan {
        plan.check_id(id)?;
    }
    let folder = SweepFolder::new(&args.dir);
    let index = match (&args.cell, args.index) {
        (Some(id), _) => Some(index_of(&plan, id)?),
        (None, index) => index,
    };
    match index {
        Some(index) => run_one(context, &plan, &folder, index, args),
        None => pool::run(context, &plan, &folder, args.jobs.map(|jobs| jobs as usize), threads),
    }
}

/// The training that a cell belongs to.
fn index_of(plan: &Plan, id: &str) -> Result<usize> {
    let cell = plan.cells.iter().find(|cell| cell.id == id);
    let index = cell.and_then(|cell| plan.trainings.iter().position(|training| training.id == cell.training));
    index.ok_or_else(|| Error::parameter(format!("--cell {id}"), "the plan has no such cell", "plan.json lists the cells; plan again if the grid has changed"))
}

/// One training with its cells, in this process.
fn run_one(context: &Context, plan: &Plan, folder: &SweepFolder, index: usize, args: &SweepRun) -> Result<()> {
    let events = context.listeners(None)?;
    let (stop, limits) = (interrupt::stop_flag()?, context.limit_options);
    let worker = Worker { registry: &context.registry, events: &events, stop, limits, processes: args.processes };
    let busy = if args.no_wait { Busy::Leave } else { Busy::Wait };
    let results = match run_training(&worker, folder, plan, index, args.cell.as_deref(), busy)? {
        TrainingState::Finished(results) => results,
        TrainingState::Busy => {
            // Not an error: the pool comes back to it.
            std::process::exit(i32::from(BUSY));
        }
    };
    context.output.result(&results, || results.iter().map(|result| format!("cell {}: {}", result.id, summary(result))).collect::<Vec<_>>().join("\n"))?;
    match results.iter().find(|result| result.outcome == Outcome::Hopeless) {
        Some(result) => {
            let problem = result.message.clone().unwrap_or_default();
            Err(Error::failed(format!("training {}", result.training), problem, "Its cells are scored all the same; running it again gives the same"))
        }
        None => Ok(()),
    }
}

#[derive(Serialize)]
struct CollectReport<'a> {
    #[serde(flatten)]
    collection: &'a Collection,
    in_table: usize,
    tables: &'a Tables,
}

pub fn collect(context: &Context, args: &SweepCollect) -> Result<()> {
    let plan = Plan::read(&args.dir)?;
    let folder = SweepFolder::new(&args.dir);
    let collection = collect_results(&folder, &plan)?;
    if !args.partial {
        collection.check_complete(&folder)?;
    }
    if collection.results.is_empty() {
        return Err(Error::data(format!("sweep {}", args.dir.display()), "there is no result", format!("Run it first: {} sweep run DIR", program())));
    }
    let shown = select(collection.results.clone(), &args.conditions)?;
    let tables = write_tables(&folder, &collection.results, &shown, collection.gap().as_deref())?;
    let report = CollectReport { collection: &collection, in_table: shown.len(), tables: &tables };
    context.output.result(&report, || {
        let mut text = std::fs::read_to_string(&tables.markdown).unwrap_or_default();
        text += &format!("\n{} of {} cells", collection.finished, collection.planned);
        text += &collection.missing.iter().map(|m| format!("\nmissing: {} ({}): {}", m.cell, m.axes, m.reason)).collect::<String>();
        text += &collection.foreign.iter().map(|name| format!("\nof no cell of the plan: results/{name}")).collect::<String>();
        text + &format!("\nwrote {}, {}, {}", tables.results.display(), tables.markdown.display(), tables.csv.display())
    })
}

#[derive(Serialize)]
struct EmitReport {
    file: String,
}

/// Refuses options of other schedulers, which would have no effect.
fn check_scheduler(args: &SweepEmit) -> Result<()> {
    let options =
        [("--image", &args.image, SchedulerArg::K8s), ("--claim", &args.claim, SchedulerArg::K8s), ("--bucket", &args.bucket, SchedulerArg::Skypilot)];
    let stated = options.map(|(option, value, of)| {
        let (value, remedy) = (value.clone(), format!("Leave it out: it is an option of {}", written(&of)));
        Stated { option, value, used: of == args.scheduler, remedy }
    });
    refuse_ignored(&format!("jobs of {}", written(&args.scheduler)), stated)
}

/// `path` as a job file has it, where `option` states another one. Other text in its place would name another file.
fn unicode(path: PathBuf, option: &str) -> Result<String> {
    path.into_os_string().into_string().map_err(|name| {
        let remedy = format!("Give it another name, or state what the jobs call it ({option})");
        Error::parameter(name.to_string_lossy(), "its name is not UTF-8, and a job file is text", remedy)
    })
}

pub fn emit(context: &Context, args: &SweepEmit, threads: usize) -> Result<()> {
    check_scheduler(args)?;
    let plan = Plan::read(&args.dir)?;
    // Schedulers want the folder of their logs to exist.
    SweepFolder::new(&args.dir).create()?;
    let absolute = |path: &Path, option: &str| std::path::absolute(path).map_err(|e| Error::io(path, e)).and_then(|path| unicode(path, option));
    let program = match (&args.program, args.scheduler) {
        (Some(program), _) => program.clone(),
        (None, SchedulerArg::Slurm) => unicode(std::env::current_exe().map_err(|e| Error::io("the program", e))?, "--program")?,
        (None, _) => "cc4dgs".into(),
    };
    let options = EmitOptions {
        folder: args.job_dir.clone().map_or_else(|| absolute(&args.dir, "--job-dir"), Ok)?,
        working_folder: args.cd.clone().map_or_else(|| absolute(Path::new("."), "--cd"), Ok)?,
        program,
        threads: if threads == 0 { 1 } else { threads },
        limits: context.limit_options.to_vec(),
        variables: args.variables.clone(),
        memory_gb: args.memory_gb,
        minutes: args.time_limit,
        parallel: args.parallel,
        image: args.image.clone().unwrap_or_else(|| "cc4dgs:latest".into()),
        claim: args.claim.clone().unwrap_or_else(|| "cc4dgs".into()),
        bucket: args.bucket.clone().unwrap_or_else(|| "s3://cc4dgs".into()),
    };
    let scheduler = match args.scheduler {
        SchedulerArg::Slurm => Scheduler::Slurm,
        SchedulerArg::K8s => Scheduler::Kubernetes,
        SchedulerArg::Skypilot => Scheduler::SkyPilot,
    };
    let report = EmitReport { file: emit_file(scheduler, &plan, &options)? };
    context.output.result(&report, || report.file.clone())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_with_spaces_are_one_word_of_the_next_command() {
        assert_eq!(["runs/tiny-1", "my runs", "it's", ""].map(word), ["runs/tiny-1", "'my runs'", "'it'\\''s'", "''"]);
    }

    #[cfg(unix)]
    #[test]
    fn job_files_have_no_name_in_place_of_another() {
        assert_eq!(unicode("/runs/tiny é".into(), "--job-dir").unwrap(), "/runs/tiny é");
        let name: &std::ffi::OsStr = std::os::unix::ffi::OsStrExt::from_bytes(b"/runs/\xff");
        let message = unicode(name.into(), "--job-dir").unwrap_err().to_string();
        assert!(["/runs/", "not UTF-8", "--job-dir"].iter().all(|part| message.contains(part)), "{message}");
    }

    #[test]
    fn options_of_other_schedulers_are_refused() {
        use crate::args::{Cli, Command, SweepWhat};
        let checked = |line: &str| {
            let cli = <Cli as clap::Parser>::try_parse_from(format!("cc4dgs sweep emit {line}").split(' ')).unwrap();
            let Cli { command: Command::Sweep(sweep), .. } = cli else { panic!("{line}") };
            let SweepWhat::Emit(args) = sweep.what else { panic!("{line}") };
            check_scheduler(&args).map_err(|error| error.to_string())
        };
        for line in ["slurm d", "k8s d --image a --claim b", "skypilot d --bucket s3://c"] {
            assert_eq!(checked(line), Ok(()));
        }
        for (line, parts) in [("slurm d --image a", ["--image a", "k8s", "slurm"]), ("k8s d --bucket s3://c", ["--bucket s3://c", "skypilot", "k8s"])] {
            let message = checked(line).unwrap_err();
            assert!(parts.iter().all(|part| message.contains(part)), "{message}");
        }
    }

    #[test]
    fn options_take_the_place_of_the_grids_values() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("g.toml");
        let axes = "[[scene]]\nname = 's'\npath = 'procedural:tiny'\n[[method]]\nname = 'm'\npreset = '+'\nsize = 2.0\n[[codec]]\nname = 'c'\ncodec = 'raw'\n";
        let of = |top: &str, change: &dyn Fn(&mut SweepPlan)| {
            std::fs::write(&file, format!("name = 'g'\n{top}{axes}")).unwrap();
            let mut args = SweepPlan { grid: file.clone(), out: None, minutes: None, iterations: None, seeds: None, device: None };
            change(&mut args);
            grid(&args)
        };
        let timed = of("iterations = 90\ndevice = 'flex'\n", &|args| (args.minutes, args.device) = (Some(3.0), Some("wgpu".into()))).unwrap();
        assert_eq!((timed.minutes, timed.iterations, timed.device.as_str()), (Some(3.0), None, "wgpu"));
        let counted = of("minutes = 1.0\nseeds = [7]\n", &|args| (args.iterations, args.seeds) = (Some(50), Some(2))).unwrap();
        assert_eq!((counted.minutes, counted.iterations, counted.seeds), (None, Some(50), vec![0, 1]));
        // Sizes of a grid without minutes and iterations multiply those of the options.
        assert!(of("", &|_| ()).unwrap_err().to_string().contains("size"));
        assert_eq!(of("", &|args| args.iterations = Some(50)).unwrap().method[0].size, 2.0);
        assert!(of("", &|args| args.minutes = Some(-1.0)).unwrap_err().to_string().contains("positive"));
    }
}
