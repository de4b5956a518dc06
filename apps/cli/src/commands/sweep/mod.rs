//! `cc4dgs sweep`: experiment grids.

mod pool;

use super::Context;
use crate::args::{SchedulerArg, SweepCollect, SweepEmit, SweepPlan, SweepRun};
use crate::interrupt;
use cc4dgs::plugins;
use cc4dgs_core::{Error, Result};
use cc4dgs_train::sweep::{
    Busy, Collection, EmitOptions, Grid, Outcome, Plan, Scheduler, SweepFolder, Tables, TrainingState, Worker, collect as collect_results, emit as emit_file,
    run_training, select, summary, write_tables,
};
use serde::Serialize;
use std::path::Path;

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
    let text = std::fs::read_to_string(&args.grid).map_err(|e| Error::io(&args.grid, e))?;
    let mut grid = Grid::parse(&args.grid.display().to_string(), &text)?;
    if let Some(minutes) = args.minutes {
        (grid.minutes, grid.iterations) = (Some(minutes), None);
    }
    if let Some(iterations) = args.iterations {
        (grid.minutes, grid.iterations) = (None, Some(iterations));
    }
    if let Some(seeds) = args.seeds {
        grid.seeds = (0..seeds).collect();
    }
    if let Some(device) = &args.device {
        grid.device.clone_from(device);
    }
    // What replaced the grid's values is held to the same rules.
    let changed = toml::to_string(&grid).map_err(|e| Error::parameter("grid", e.to_string(), "Report this: every grid should be printable"))?;
    let grid = Grid::parse(&args.grid.display().to_string(), &changed)?;
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
        minutes: plan.minutes.map(|minutes| minutes * plan.trainings.len() as f64),
        cells_per_training: grid.codec.len(),
        folder: args.out.as_ref().map(|out| out.display().to_string()),
    };
    context.output.result(&report, || {
        let time = report.minutes.map_or_else(String::new, |minutes| format!(", about {:.1} hours of training", minutes / 60.0));
        let next = match &report.folder {
            Some(folder) => format!("run it: cc4dgs sweep run {folder}"),
            None => "nothing was written; --out DIR writes the plan".into(),
        };
        format!("{}: {} trainings, {} cells ({} of them finished){time}\n{next}", report.name, report.trainings, report.cells, report.finished)
    })
}

pub fn run(context: &Context, args: &SweepRun, threads: usize) -> Result<()> {
    let plan = Plan::read(&args.dir)?;
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
    let worker = Worker { registry: &context.registry, events: &events, stop: interrupt::stop_flag()?, limits: context.limit_options };
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
    let mut collection = collect_results(&folder, &plan)?;
    if !args.partial {
        collection.check_complete(&folder)?;
    }
    if collection.results.is_empty() {
        return Err(Error::data(format!("sweep {}", args.dir.display()), "there is no result", "Run it first: cc4dgs sweep run DIR"));
    }
    let results = select(std::mem::take(&mut collection.results), &args.conditions)?;
    let tables = write_tables(&folder, &results)?;
    let report = CollectReport { collection: &collection, in_table: results.len(), tables: &tables };
    context.output.result(&report, || {
        let mut text = std::fs::read_to_string(&tables.markdown).unwrap_or_default();
        text += &format!("\n{} of {} cells", collection.finished, collection.planned);
        text += &collection.missing.iter().map(|m| format!("\nmissing: {} ({}): {}", m.cell, m.place, m.reason)).collect::<String>();
        text += &collection.foreign.iter().map(|name| format!("\nof no cell of the plan: results/{name}")).collect::<String>();
        text + &format!("\nwrote {}, {}, {}", tables.results.display(), tables.markdown.display(), tables.csv.display())
    })
}

#[derive(Serialize)]
struct EmitReport {
    file: String,
}

pub fn emit(context: &Context, args: &SweepEmit, threads: usize) -> Result<()> {
    let plan = Plan::read(&args.dir)?;
    // Schedulers want the folder of their logs to exist.
    SweepFolder::new(&args.dir).create()?;
    let absolute = |path: &Path| std::path::absolute(path).map(|path| path.display().to_string()).map_err(|e| Error::io(path, e));
    let program = match (&args.program, args.scheduler) {
        (Some(program), _) => program.clone(),
        (None, SchedulerArg::Slurm) => std::env::current_exe().map_err(|e| Error::io("the program", e))?.display().to_string(),
        (None, _) => "cc4dgs".into(),
    };
    let options = EmitOptions {
        folder: args.job_dir.clone().map_or_else(|| absolute(&args.dir), Ok)?,
        working_folder: args.cd.clone().map_or_else(|| absolute(Path::new(".")), Ok)?,
        program,
        threads: if threads == 0 { 1 } else { threads },
        memory_gb: args.memory_gb,
        minutes: args.time_limit,
        parallel: args.parallel,
        image: args.image.clone(),
        claim: args.claim.clone(),
        bucket: args.bucket.clone(),
    };
    let scheduler = match args.scheduler {
        SchedulerArg::Slurm => Scheduler::Slurm,
        SchedulerArg::K8s => Scheduler::Kubernetes,
        SchedulerArg::Skypilot => Scheduler::SkyPilot,
    };
    let report = EmitReport { file: emit_file(scheduler, &plan, &options)? };
    context.output.result(&report, || report.file.clone())
}
