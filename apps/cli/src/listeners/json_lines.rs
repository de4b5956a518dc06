//! The log of a run: one JSON object per line and event.

use cc4dgs_core::{Error, Event, EventSink, Result};
use serde::Serialize;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::Path;
use std::sync::Mutex;
use std::time::Instant;

/// Appends events to a file, each with the seconds since the command began. A line is written at once and whole, so that the log can be followed
/// and survives a crash.
pub struct JsonLines {
    file: Mutex<File>,
    began: Instant,
}

#[derive(Serialize)]
struct Line<'a> {
    seconds: f64,
    #[serde(flatten)]
    event: &'a Event,
}

impl JsonLines {
    /// Opens the log at `path`; a resumed run goes on where the log ended, any other starts it anew.
    pub fn open(path: &Path, append: bool) -> Result<Self> {
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, e))?;
        }
        let file = OpenOptions::new().create(true).write(true).append(append).truncate(!append).open(path).map_err(|e| Error::io(path, e))?;
        Ok(Self { file: Mutex::new(file), began: Instant::now() })
    }
}

impl EventSink for JsonLines {
    fn emit(&self, event: &Event) {
        let line = Line { seconds: (self.began.elapsed().as_secs_f64() * 1e3).round() / 1e3, event };
        if let (Ok(mut text), Ok(mut file)) = (serde_json::to_string(&line), self.file.lock()) {
            text.push('\n');
            // A full disk must not end a training run; the checkpoint will report it.
            file.write_all(text.as_bytes()).ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_events_with_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("run/events.jsonl");
        let event = Event::Saved { path: "x".into(), bytes: 7 };
        JsonLines::open(&path, false).unwrap().emit(&event);
        JsonLines::open(&path, true).unwrap().emit(&event);
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<serde_json::Value> = text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        assert_eq!(lines.len(), 2, "{text}");
        assert!(lines.iter().all(|l| l["event"] == "saved" && l["bytes"] == 7 && l["seconds"].is_f64()), "{text}");
        JsonLines::open(&path, false).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "");
    }
}
