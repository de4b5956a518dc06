//! The log of a run, `events.jsonl`: one JSON object per line and event.

use cc4dgs_core::{Error, Event, EventSink, Result, Stage};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Mutex;
use std::time::Instant;

/// Name of the log inside a run's folder.
pub const EVENTS: &str = "events.jsonl";

/// Appends events to a file, each with the seconds since the command began. A line is written at once and whole, so that the log can be followed
/// and survives a crash. The log of an earlier run stays as it is until the first stage of training begins, or a command that does not train: what is refused
/// before that leaves it.
pub struct JsonLines {
    log: Mutex<Log>,
    /// Whether lines follow those of the earlier run, or take their place.
    append: bool,
    began: Instant,
}

struct Log {
    file: File,
    /// Lines that wait for the first stage, or for a command that does not train.
    waiting: Option<String>,
}

#[derive(Serialize)]
struct Line<'a> {
    seconds: f64,
    #[serde(flatten)]
    event: &'a Event,
}

impl JsonLines {
    /// Opens the log at `path`; a resumed run goes on where the log ended, any other starts it anew.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn open(path: &Path, append: bool) -> Result<Self> {
        let failed = |e| Error::io(path, e);
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        }
        let mut file = OpenOptions::new().create(true).read(true).append(true).open(path).map_err(failed)?;
        let holds_a_run = file.metadata().map_err(failed)?.len() > 0;
        let mut waiting = String::new();
        if holds_a_run && append {
            let mut last = [0];
            file.seek(SeekFrom::End(-1)).and_then(|_| file.read_exact(&mut last)).map_err(failed)?;
            // A line that was cut must not take the next one with it.
            waiting.extend((last != *b"\n").then_some('\n'));
        }
        Ok(Self { log: Mutex::new(Log { file, waiting: holds_a_run.then_some(waiting) }), append, began: Instant::now() })
    }
}

impl EventSink for JsonLines {
    fn emit(&self, event: &Event) {
        let line = Line { seconds: (self.began.elapsed().as_secs_f64() * 1e3).round() / 1e3, event };
        let (Ok(mut text), Ok(mut log)) = (serde_json::to_string(&line), self.log.lock()) else { return };
        text.push('\n');
        if let Some(mut waiting) = log.waiting.take() {
            waiting.push_str(&text);
            let begins = match event {
                Event::StageStarted { .. } => true,
                Event::RunStarted { command, .. } => command != "train",
                _ => false,
            };
            if !begins {
                log.waiting = Some(waiting);
                return;
            }
            text = waiting;
            if !self.append {
                log.file.set_len(0).ok();
            }
        }
        // A full disk must not end a training run; the checkpoint will report it.
        log.file.write_all(text.as_bytes()).ok();
    }
}

/// What the log of a training says of the training, interruptions included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct History {
    /// Wall seconds of all processes that worked on it, each up to its last event.
    pub seconds: f64,
    /// Of those, seconds per stage.
    pub stage_seconds: BTreeMap<String, f64>,
    /// Times at which it went on after an interruption.
    pub resumed: usize,
    /// What it reached on the way. An iteration that was repeated after an interruption is there once.
    pub points: Vec<HistoryPoint>,
    /// Scores of views that are kept out of training, likewise.
    pub validation: Vec<ValidationPoint>,
}

/// A score of views that are kept out of training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ValidationPoint {
    /// Over all stages, from 1.
    pub iteration: usize,
    /// Seconds since the training began.
    pub seconds: f64,
    /// Mean PSNR in dB; images are not rounded to 8 bits.
    pub psnr_db: f32,
}

/// A training at one iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HistoryPoint {
    /// Over all stages, from 1.
    pub iteration: usize,
    /// Seconds since the training began.
    pub seconds: f64,
    /// PSNR of training views in dB, smoothed.
    pub psnr_db: f32,
    /// Gaussians.
    pub gaussians: usize,
}

/// The seconds and the event of a line; `None` where it was cut. Events of older logs may have a key `seconds` of their own, so the line's is taken off first.
fn read_line(line: &str) -> Option<(f64, Event)> {
    let (seconds, event) = line.strip_prefix("{\"seconds\":")?.split_once(',')?;
    Some((seconds.parse().ok()?, serde_json::from_str(&format!("{{{event}")).ok()?))
}

/// Reads the log of a training. Lines that a crash has cut are skipped; the score stage, which compares masks, has no points.
///
/// # Errors
/// [`Error::Io`].
pub fn read_history(path: &Path) -> Result<History> {
    let text = std::fs::read(path).map_err(|e| Error::io(path, e))?;
    let mut history = History::default();
    let mut points: BTreeMap<usize, HistoryPoint> = BTreeMap::new();
    let mut validation: BTreeMap<usize, ValidationPoint> = BTreeMap::new();
    // Iterations before each stage, and seconds of the processes before this one.
    let mut before: BTreeMap<String, usize> = BTreeMap::new();
    let (mut iterations, mut earlier, mut last, mut has_started) = (0, 0.0, 0.0, false);
    let mut stage: Option<String> = None;
    for line in String::from_utf8_lossy(&text).lines() {
        let Some((seconds, event)) = read_line(line) else { continue };
        // Another process, whose clock begins anew. It may be late with its first line.
        let starts = matches!(&event, Event::RunStarted { command, .. } if command == "train");
        if seconds < last || (starts && has_started) {
            (earlier, last, stage, has_started) = (earlier + last, 0.0, None, false);
        }
        has_started |= starts;
        history.resumed += usize::from(starts);
        if let Some(stage) = &stage {
            *history.stage_seconds.entry(stage.clone()).or_default() += seconds - last;
        }
        last = seconds;
        match event {
            Event::StageStarted { stage: name, iterations: length, .. } => {
                if !before.contains_key(&name) {
                    before.insert(name.clone(), iterations);
                    iterations += length;
                }
                stage = Some(name);
            }
            Event::StageFinished { .. } => stage = None,
            Event::Iteration { stage, iteration, psnr_db, gaussians, .. } if stage != Stage::Score.name() => {
                let iteration = before.get(&stage).copied().unwrap_or(0) + iteration;
                points.insert(iteration, HistoryPoint { iteration, seconds: earlier + seconds, psnr_db, gaussians });
            }
            Event::Validated { stage, iteration, psnr_db, .. } => {
                let iteration = before.get(&stage).copied().unwrap_or(0) + iteration;
                validation.insert(iteration, ValidationPoint { iteration, seconds: earlier + seconds, psnr_db });
            }
            _ => {}
        }
    }
    history.seconds = earlier + last;
    history.resumed = history.resumed.saturating_sub(1);
    history.points = points.into_values().collect();
    history.validation = validation.into_values().collect();
    Ok(history)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_history_outlives_interruptions() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(EVENTS);
        let line = |seconds: f64, event: Event| serde_json::to_string(&Line { seconds, event: &event }).unwrap() + "\n";
        let run = || Event::RunStarted { command: "train".into(), device: "flex".into(), seed: 0 };
        let start = |stage: &str, iterations| Event::StageStarted { stage: stage.into(), iterations, gaussians: 5 };
        let step = |stage: &str, iteration, psnr_db| Event::Iteration { stage: stage.into(), iteration, of: 20, loss: 0.0, psnr_db, gaussians: 5, ms: 1.0 };
        let score = |iteration, psnr_db| Event::Validated { stage: "main".into(), iteration, of: 20, views: 8, psnr_db };
        let end = |stage: &str| Event::StageFinished { stage: stage.into(), seconds: 1.0, gaussians: 5 };
        let mut text: String =
            [(0.5, run()), (1.0, start("coarse", 10)), (2.0, step("coarse", 10, 20.0)), (3.0, end("coarse"))].map(|(s, e)| line(s, e)).concat();
        text += &[
            (4.0, start("score", 10)),
            (5.0, step("score", 10, 1.0)),
            (6.0, end("score")),
            (7.0, start("main", 20)),
            (8.0, step("main", 10, 25.0)),
            (8.5, score(10, 24.0)),
        ]
        .map(|(s, e)| line(s, e))
        .concat();
        // Killed in the middle of a line; the stage is resumed before that iteration.
        text += "{\"seconds\":8.5,\"eve";
        text += &("\n".to_string()
            + &[
                (0.1, run()),
                (0.2, start("main", 20)),
                (1.2, step("main", 10, 26.0)),
                (1.2, score(10, 24.5)),
                (2.2, step("main", 20, 30.0)),
                (2.4, score(20, 27.0)),
                (2.7, end("main")),
            ]
            .map(|(s, e)| line(s, e))
            .concat());
        std::fs::write(&path, text).unwrap();
        let history = read_history(&path).unwrap();
        let points: Vec<(usize, f32)> = history.points.iter().map(|p| (p.iteration, p.psnr_db)).collect();
        assert_eq!(points, [(10, 20.0), (30, 26.0), (40, 30.0)]);
        assert_eq!((history.resumed, history.points[1].seconds), (1, 9.7));
        let scores: Vec<(usize, f32)> = history.validation.iter().map(|p| (p.iteration, p.psnr_db)).collect();
        assert_eq!((scores, history.validation[0].seconds), (vec![(30, 24.5), (40, 27.0)], 9.7));
        assert!((history.seconds - 11.2).abs() < 1e-9 && (history.stage_seconds["main"] - 4.0).abs() < 1e-9, "{history:?}");
        assert_eq!(history.stage_seconds["coarse"], 2.0);

        // The process that goes on is later with its first line than the other was with its last.
        let text = [(0.5, run()), (1.0, start("coarse", 10)), (2.0, step("coarse", 10, 20.0)), (6.0, run()), (7.0, start("coarse", 10)), (8.0, end("coarse"))];
        std::fs::write(&path, text.map(|(s, e)| line(s, e)).concat()).unwrap();
        let history = read_history(&path).unwrap();
        assert_eq!((history.seconds, history.resumed, history.stage_seconds["coarse"]), (10.0, 1, 2.0));

        // A key of a line is there once; older logs have both times under one key.
        let last = line(3.0, end("coarse"));
        assert_eq!(last, "{\"seconds\":3.0,\"event\":\"stage-finished\",\"stage\":\"coarse\",\"stage_seconds\":1.0,\"gaussians\":5}\n");
        assert_eq!(read_line(last.trim_end()), Some((3.0, end("coarse"))));
        assert_eq!(read_line(&last.trim_end().replace("stage_seconds", "seconds")), Some((3.0, end("coarse"))));
    }

    #[test]
    fn a_line_that_was_cut_does_not_take_the_next_one_with_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(EVENTS);
        std::fs::write(&path, "{\"seconds\":8.5,\"eve").unwrap();
        let begins = Event::RunStarted { command: "eval".into(), device: "flex".into(), seed: 0 };
        JsonLines::open(&path, true).unwrap().emit(&begins);
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().filter_map(read_line).map(|(_, event)| event).collect::<Vec<_>>(), [begins]);
    }

    #[test]
    fn lines_are_events_with_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run/events.jsonl");
        let event = Event::Saved { path: "x".into(), bytes: 7 };
        let lines = || -> Vec<serde_json::Value> {
            let text = std::fs::read_to_string(&path).unwrap();
            text.lines().map(|l| serde_json::from_str(l).unwrap()).collect()
        };
        let log = |append: bool, events: &[&Event]| {
            let log = JsonLines::open(&path, append).unwrap();
            events.iter().for_each(|event| log.emit(event));
            lines()
        };
        assert_eq!(log(false, &[&event, &event]).len(), 2);
        assert!(lines().iter().all(|l| l["event"] == "saved" && l["bytes"] == 7 && l["seconds"].is_f64()), "{:?}", lines());
        // What is refused before its first stage leaves the log of the run.
        let begins = Event::StageStarted { stage: "coarse".into(), iterations: 1, gaussians: 1 };
        assert_eq!(log(true, &[&event]).len(), 2);
        assert_eq!(log(false, &[&event]).len(), 2);
        assert_eq!(log(true, &[&event, &begins, &event]).len(), 5);
        assert_eq!(log(false, &[&event, &begins]).len(), 2);
        assert_eq!(lines()[1]["event"], "stage-started");
        // `demo` scores into the log of its training.
        let scores = Event::RunStarted { command: "eval".into(), device: "flex".into(), seed: 0 };
        assert_eq!(log(true, &[&event, &scores]).len(), 4);
    }
}
