//! A pool of processes of this program on one machine: each works on one training with its cells.

use super::BUSY;
use crate::commands::Context;
use crate::interrupt;
use cc4dgs_core::{Error, Event, EventSink, Result, plural};
use cc4dgs_train::sweep::{Failure, INTERRUPTED, Plan, SweepFolder};
use serde::Serialize;
use std::collections::{BTreeSet, VecDeque};
use std::ffi::OsString;
use std::fs::OpenOptions;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Interval at which the processes are checked.
const TICK: Duration = Duration::from_millis(100);
/// Wait before a training on which another process works is tried again.
const BUSY_PAUSE: Duration = Duration::from_secs(1);
/// Time after which a process that was asked to stop is killed.
const GRACE: Duration = Duration::from_secs(120);
/// Upper bound on the failed trainings that the error names.
const NAMED: usize = 8;

/// A process at work.
struct Job {
    index: usize,
    child: Child,
    began: Instant,
    /// Length of its log when it started; the bytes before are of earlier processes.
    log_start: u64,
}

#[derive(Serialize)]
struct PoolReport {
    finished: usize,
    planned: usize,
    seconds: f64,
}

/// The state of the pool.
struct Pool<'a> {
    context: &'a Context<'a>,
    plan: &'a Plan,
    folder: &'a SweepFolder,
    threads: usize,
    /// Processes at a time, which share the memory of the machine.
    processes: usize,
    events: &'a dyn EventSink,
    queue: VecDeque<usize>,
    running: Vec<Job>,
    /// Seconds of the trainings that finished here.
    seconds: Vec<f64>,
    failed: Vec<(usize, Failure)>,
    /// Cells that are finished.
    done: BTreeSet<usize>,
    not_before: Instant,
}

/// Runs all trainings that lack a result, at most `jobs` at a time.
pub fn run(context: &Context, plan: &Plan, folder: &SweepFolder, jobs: Option<usize>, threads: usize) -> Result<()> {
    plan.check_program()?;
    folder.create()?;
    let stop = interrupt::stop_flag()?;
    let events = context.listeners(None)?;
    let began = Instant::now();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let jobs = jobs.unwrap_or_else(|| cores.checked_div(threads).map_or(1, |jobs| jobs.max(1)));
    let queue: VecDeque<usize> = folder.open_trainings(plan).into();
    let processes = jobs.min(queue.len());
    let (running, seconds, failed, done, not_before) = (Vec::new(), Vec::new(), Vec::new(), BTreeSet::new(), began);
    let mut pool = Pool { context, plan, folder, threads, processes, events: &events, queue, running, seconds, failed, done, not_before };
    pool.progress();
    if let Err(error) = pool.work(jobs, stop) {
        // They are in process groups of their own: only the pool ends them.
        pool.stop();
        return Err(error);
    }
    if !pool.failed.is_empty() {
        return Err(pool.error());
    }
    let report = PoolReport { finished: pool.finished(), planned: plan.cells.len(), seconds: began.elapsed().as_secs_f64() };
    context.output.result(&report, || {
        let root = super::word(&folder.root().to_string_lossy());
        let (finished, are) = (report.finished, plural(report.finished, "is", "are"));
        format!("{finished} of {} cells {are} finished; tables: {} sweep collect {root}", report.planned, super::program())
    })
}

impl Pool<'_> {
    /// Keeps `jobs` processes running until nothing is left to do.
    fn work(&mut self, jobs: usize, stop: &AtomicBool) -> Result<()> {
        loop {
            if stop.load(Ordering::Relaxed) {
                let (finished, planned) = (self.finished(), self.plan.cells.len());
                let text = format!("{finished} of {planned} cells {} finished; the next run does the others", plural(finished, "is", "are"));
                return Err(Error::Interrupted(text));
            }
            while self.running.len() < jobs && Instant::now() >= self.not_before {
                let Some(index) = self.queue.pop_front() else { break };
                // Another pool may have done it meanwhile.
                if self.complete(index) {
                    self.progress();
                } else {
                    self.start(index)?;
                }
            }
            if self.running.is_empty() && self.queue.is_empty() {
                return Ok(());
            }
            self.look(jobs)?;
            std::thread::sleep(TICK);
        }
    }
    /// Whether all cells of the training at `index` have results.
    fn complete(&self, index: usize) -> bool {
        self.plan.cells_of(&self.plan.trainings[index].id).all(|cell| self.folder.finished(cell).is_some())
    }
    /// How many cells are finished. A result is read once.
    fn finished(&mut self) -> usize {
        let finished = self.plan.cells.iter().enumerate().filter(|(index, cell)| !self.done.contains(index) && self.folder.finished(cell).is_some());
        let new: Vec<usize> = finished.map(|(index, _)| index).collect();
        self.done.extend(new);
        self.done.len()
    }
    fn progress(&mut self) {
        let (done, total) = (self.finished() as u64, self.plan.cells.len() as u64);
        self.events.emit(&Event::Progress { task: "sweep".into(), done, total });
    }
    fn note(&self, index: usize, message: String) {
        self.events.emit(&Event::Note { object: self.plan.trainings[index].label(), message });
    }
    /// Starts a process for the training at `index`. Its messages go to the training's log.
    fn start(&mut self, index: usize) -> Result<()> {
        let log_path = self.folder.log(&self.plan.trainings[index].id);
        let io = |e| Error::io(&log_path, e);
        let log = OpenOptions::new().create(true).append(true).open(&log_path).map_err(io)?;
        let log_start = log.metadata().map_err(io)?.len();
        // On Linux the running program itself, also where a build has replaced its file.
        let program = match Path::new("/proc/self/exe") {
            own if own.exists() => own.to_path_buf(),
            _ => std::env::current_exe().map_err(|e| Error::io("the program", e))?,
        };
        let mut command = Command::new(&program);
        command.args(arguments(self.folder.root(), &self.plan.id(), index, self.threads, self.processes, self.context.limit_options));
        command.stdin(Stdio::null()).stdout(log.try_clone().map_err(io)?).stderr(log);
        // A group of its own: Ctrl-C reaches this process alone, which then asks each child once.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let child = command.spawn().map_err(|e| Error::io(&program, e))?;
        self.running.push(Job { index, child, began: Instant::now(), log_start });
        Ok(())
    }
    /// Takes note of the processes that have ended.
    fn look(&mut self, jobs: usize) -> Result<()> {
        let mut at = 0;
        while at < self.running.len() {
            let Some(status) = self.running[at].child.try_wait().map_err(|e| Error::io("a process of the sweep", e))? else {
                at += 1;
                continue;
            };
            let job = self.running.swap_remove(at);
            self.ended(&job, status, jobs)?;
        }
        Ok(())
    }
    fn ended(&mut self, job: &Job, status: ExitStatus, jobs: usize) -> Result<()> {
        let (training, complete) = (&self.plan.trainings[job.index], self.complete(job.index));
        match status.code() {
            // Another process did the training, so the time of this one is no time of a training.
            Some(code) if complete && code == i32::from(BUSY) => {}
            // A hopeless training has results too.
            _ if complete => {
                let seconds = job.began.elapsed().as_secs_f64();
                self.seconds.push(seconds);
                let hopeless = if status.success() { "" } else { ", hopeless" };
                let left = self.left(jobs);
                self.note(job.index, format!("done in {}{hopeless}; {left}", duration(seconds)));
            }
            Some(code) if code == i32::from(BUSY) => {
                self.queue.push_back(job.index);
                self.not_before = Instant::now() + BUSY_PAUSE;
            }
            _ => {
                let failure = self.failure(job, status);
                self.folder.set_failure(&training.id, Some(&failure))?;
                self.note(job.index, format!("failed with exit code {}: {}", failure.exit_code, failure.message));
                self.failed.push((job.index, failure));
            }
        }
        self.progress();
        Ok(())
    }
    /// What a process said before it failed; a process that was ended from outside said nothing.
    fn failure(&self, job: &Job, status: ExitStatus) -> Failure {
        let id = &self.plan.trainings[job.index].id;
        let log = std::fs::read(self.folder.log(id)).unwrap_or_default();
        why(status.code(), signal(status), self.folder.failure(id), log.get(job.log_start as usize..).unwrap_or_default())
    }
    /// Trainings done and the time that the others will take.
    fn left(&mut self, jobs: usize) -> String {
        let waiting = self.queue.len() + self.running.len();
        let trainings = plural(waiting, "training", "trainings");
        let text = format!("{} of {} cells, {waiting} {trainings} left", self.finished(), self.plan.cells.len());
        if waiting == 0 || self.seconds.is_empty() {
            return text;
        }
        let mean = self.seconds.iter().sum::<f64>() / self.seconds.len() as f64;
        let under_way: f64 = self.running.iter().map(|job| job.began.elapsed().as_secs_f64().min(mean)).sum();
        format!("{text}, about {} to go", duration((mean * waiting as f64 - under_way) / jobs.min(waiting) as f64))
    }
    /// Asks all processes to stop, waits for their checkpoints, and ends those that do not.
    fn stop(&mut self) {
        for job in &mut self.running {
            ask_to_stop(&mut job.child);
        }
        let until = Instant::now() + GRACE;
        for job in &mut self.running {
            while Instant::now() < until && matches!(job.child.try_wait(), Ok(None)) {
                std::thread::sleep(TICK);
            }
            job.child.kill().ok();
            job.child.wait().ok();
        }
    }
    /// The failures as one error with the exit code of the first.
    fn error(&self) -> Error {
        let named: Vec<String> = self.failed.iter().take(NAMED).map(|(index, f)| format!("{}: {}", self.plan.trainings[*index].label(), f.message)).collect();
        let more = self.failed.len().saturating_sub(NAMED);
        let rest = if more > 0 { format!("; and {more} more") } else { String::new() };
        let object = format!("sweep {}", self.folder.root().display());
        let problem = format!("{} of {} trainings failed: {}{rest}", self.failed.len(), self.plan.trainings.len(), named.join("; "));
        of_exit_code(self.failed.first().map_or(1, |(_, failure)| failure.exit_code), object, problem)
    }
}

/// Why a process with this exit code, or ended by this signal, left cells without results. What is `recorded` of the training is that of an earlier process
/// where the `log` of this one does not contain it.
fn why(code: Option<i32>, signal: Option<i32>, recorded: Option<Failure>, log: &[u8]) -> Failure {
    let last = last_words(log);
    match (code, signal) {
        (Some(0), _) => {
            let message = "its process ended well, but a result is missing: another plan or another process changed the folder meanwhile; run the sweep again";
            Failure { exit_code: 1, message: message.into() }
        }
        (Some(code), _) => match recorded {
            Some(said) if i32::from(said.exit_code) == code && String::from_utf8_lossy(log).contains(&said.message) => said,
            _ => Failure { exit_code: u8::try_from(code).unwrap_or(1), message: last },
        },
        (None, Some(9)) => Failure { exit_code: 4, message: "the process was killed, most likely because memory ran out; use fewer --jobs".into() },
        (None, Some(6)) if last.contains("memory allocation") => Failure { exit_code: 4, message: last },
        (None, Some(2 | 15)) => Failure { exit_code: INTERRUPTED, message: "the process was asked to stop".into() },
        (None, other) => Failure { exit_code: 1, message: format!("the process was ended by signal {}: {last}", other.unwrap_or(0)) },
    }
}

/// The last message of a process: location and message of a panic, else its last line.
fn last_words(log: &[u8]) -> String {
    let text = String::from_utf8_lossy(log);
    let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    let panic = lines.iter().rposition(|line| line.starts_with("thread '") && line.contains("panicked at "));
    match panic {
        Some(at) => lines[at..].iter().take(2).copied().collect::<Vec<_>>().join(" "),
        None => lines.last().map_or_else(|| "it said nothing".into(), ToString::to_string),
    }
}

/// The error with the exit code of a process that failed.
fn of_exit_code(code: u8, object: String, problem: String) -> Error {
    let remedy = "The folder logs has what each said; running the sweep again tries these and nothing else";
    match code {
        2 => Error::parameter(object, problem, remedy),
        3 => Error::data(object, problem, remedy),
        4 => Error::out_of_memory(object, problem, format!("{remedy}. Fewer --jobs leave more memory to each, --limit raises limits")),
        INTERRUPTED => Error::Interrupted(problem),
        _ => Error::backend(object, problem, remedy),
    }
}

/// The arguments of the process that runs the training at `index` of the plan `plan` of the sweep in `root`, beside others of the pool.
fn arguments(root: &Path, plan: &str, index: usize, threads: usize, processes: usize, limits: &[String]) -> Vec<OsString> {
    let mut all = Vec::from(["--quiet", "--threads", &threads.to_string()].map(OsString::from));
    all.extend(limits.iter().flat_map(|limit| ["--limit", limit]).map(OsString::from));
    all.extend(["sweep", "run"].map(OsString::from));
    all.push(root.into());
    all.extend(["--plan", plan, "--index", &index.to_string(), "--no-wait", "--processes", &processes.to_string()].map(OsString::from));
    all
}

#[cfg(unix)]
fn signal(status: ExitStatus) -> Option<i32> {
    std::os::unix::process::ExitStatusExt::signal(&status)
}

#[cfg(not(unix))]
fn signal(_: ExitStatus) -> Option<i32> {
    None
}

#[cfg(unix)]
fn ask_to_stop(child: &mut Child) {
    // A process that has just ended cannot be asked.
    Command::new("kill").args(["-TERM", &child.id().to_string()]).stdin(Stdio::null()).stderr(Stdio::null()).status().ok();
}

#[cfg(not(unix))]
fn ask_to_stop(child: &mut Child) {
    child.kill().ok();
}

/// Seconds for people.
pub(super) fn duration(seconds: f64) -> String {
    match seconds.max(0.0) {
        s if s < 100.0 => format!("{s:.0} s"),
        s if s < 6000.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args::{Cli, SweepWhat};
    use crate::output::Output;
    use cc4dgs_core::{Limits, Registry, Silent};
    use cc4dgs_train::sweep::{CellResult, Grid};
    use clap::Parser;

    #[test]
    fn what_another_pool_has_done_is_not_begun_and_has_no_time() {
        let (registry, output, root) = (Registry::collect().unwrap(), Output::new(None, true), tempfile::tempdir().unwrap());
        let grid = Grid::parse("tiny.toml", include_str!("../../../../../benches/grids/tiny.toml")).unwrap();
        let plan = Plan::expand(&grid, &registry, &|_| Ok(())).unwrap();
        let folder = SweepFolder::new(root.path());
        folder.create().unwrap();
        let documented = include_str!("../../../../../docs/results.md").split("```json\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let mut result = CellResult::from_json("docs/results.md", documented).unwrap();
        for cell in plan.cells_of(&plan.trainings[0].id) {
            (result.id, result.training) = (cell.id.clone(), cell.training.clone());
            result.write(&folder.result(&cell.id)).unwrap();
        }
        let context = &Context { registry, output: &output, limits: Limits::default(), limit_options: &[] };
        let (plan, folder, events, not_before) = (&plan, &folder, &Silent, Instant::now());
        let (running, seconds, failed, done) = (Vec::new(), Vec::new(), Vec::new(), BTreeSet::new());
        let mut pool = Pool { context, plan, folder, threads: 1, processes: 1, events, queue: [0].into(), running, seconds, failed, done, not_before };
        pool.work(1, &AtomicBool::new(false)).unwrap();
        assert!(pool.seconds.is_empty() && pool.failed.is_empty() && !folder.log(&plan.trainings[0].id).exists());
        assert_eq!(pool.finished(), 2);
    }

    #[test]
    fn processes_are_told_their_share() {
        let given = arguments(Path::new("my sweep"), "0f", 7, 2, 3, &["max_gaussians=5".into()]);
        let cli = Cli::try_parse_from([OsString::from("cc4dgs")].into_iter().chain(given)).unwrap();
        assert_eq!((cli.threads, cli.quiet, cli.limits.as_slice()), (2, true, &["max_gaussians=5".to_string()][..]));
        let crate::args::Command::Sweep(sweep) = &cli.command else { panic!("{:?}", cli.command) };
        let SweepWhat::Run(run) = &sweep.what else { panic!("{:?}", sweep.what) };
        assert_eq!((run.dir.as_path(), run.plan.as_deref(), run.index, run.no_wait, run.processes), (Path::new("my sweep"), Some("0f"), Some(7), true, 3));
    }

    #[test]
    fn failures_keep_their_exit_code_and_name_the_logs() {
        for code in [2, 3, 4, 5, INTERRUPTED] {
            let error = of_exit_code(code, "sweep a".into(), "1 of 2 trainings failed: b: c".into());
            let said = error.to_string();
            assert!(error.exit_code() == code && said.contains("1 of 2 trainings failed") && !said.contains("Check that the path"), "{said}");
            assert_eq!(said.starts_with("sweep a: ") && said.contains("The folder logs"), code != INTERRUPTED, "{said}");
        }
        assert!(of_exit_code(4, String::new(), String::new()).to_string().contains("--jobs"));
    }

    #[test]
    fn a_crash_says_what_went_wrong() {
        let panic = "first\n\nthread 'main' (7) panicked at src/a.rs:1:2:\nindex out of bounds\nnote: run with `RUST_BACKTRACE=1` environment variable\n";
        assert_eq!(last_words(panic.as_bytes()), "thread 'main' (7) panicked at src/a.rs:1:2: index out of bounds");
        assert_eq!([&b"a\n b\n\n"[..], b"\xff"].map(last_words), ["b", "\u{fffd}"]);
        assert_eq!(last_words(b""), "it said nothing");
    }

    #[test]
    fn failures_of_earlier_processes_are_not_repeated() {
        let recorded = || Some(Failure { exit_code: 3, message: "scene a: it changed. Plan again".into() });
        let of = |code, log: &str| why(Some(code), None, recorded(), log.as_bytes());
        assert_eq!(Some(of(3, "thread 'a' panicked at b:\nc\nerror: scene a: it changed. Plan again\n")), recorded());
        assert_eq!(of(3, "error: a.lock: no locks available").message, "error: a.lock: no locks available");
        assert_eq!(of(2, "error: --plan b: c"), Failure { exit_code: 2, message: "error: --plan b: c".into() });
        // A success without a result is none, and is not called a failure with exit code 0.
        let success = of(0, "");
        assert!(success.exit_code != 0 && success.message.contains("a result is missing"), "{success:?}");
        assert_eq!(why(None, Some(15), None, b"").exit_code, INTERRUPTED);
    }

    #[test]
    fn durations_are_short() {
        assert_eq!([-1.0, 59.4, 600.0, 7200.0].map(duration), ["0 s", "59 s", "10 min", "2.0 h"]);
    }
}
