//! Progress on standard error: a bar on a terminal, an occasional line elsewhere.

use cc4dgs_core::{Event, EventSink, plural};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::{IsTerminal, Write};
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// Between two lines of progress where there is no terminal.
const LINE_INTERVAL: Duration = Duration::from_secs(15);

/// Shows stage, position, ETA, PSNR and the number of Gaussians.
pub struct Progress {
    terminal: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// The visible bar and its task.
    bar: Option<(String, ProgressBar)>,
    /// Whether the bar has had a position.
    placed: bool,
    last_line: Option<Instant>,
}

impl Progress {
    pub fn new() -> Self {
        Self { terminal: std::io::stderr().is_terminal(), state: Mutex::default() }
    }
}

impl State {
    fn say(&self, line: &str) {
        match &self.bar {
            Some((_, bar)) if !bar.is_hidden() => bar.println(line),
            // A closed standard error is not a failure.
            _ => _ = writeln!(std::io::stderr(), "{line}"),
        }
    }
    /// The bar of `task`; a new one when the task changes. A `total` of 0 is not known.
    fn bar(&mut self, task: &str, total: u64, terminal: bool) -> &ProgressBar {
        if self.bar.as_ref().is_none_or(|(name, _)| name != task) {
            self.clear();
            let target = if terminal { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
            let bar = ProgressBar::with_draw_target(Some(total), target);
            if let Ok(style) = ProgressStyle::with_template("{prefix:>9} [{bar:30}] {pos}/{len} {elapsed_precise} eta {eta_precise} {msg}") {
                bar.set_style(style.progress_chars("=> "));
            }
            bar.set_prefix(task.to_string());
            // Without a terminal, short tasks get no line of their own.
            self.last_line = Some(Instant::now());
            (self.bar, self.placed) = (Some((task.to_string(), bar)), false);
        }
        let (_, bar) = self.bar.get_or_insert_with(|| (task.to_string(), ProgressBar::hidden()));
        match total {
            0 => bar.unset_length(),
            _ => bar.set_length(total),
        }
        bar
    }
    fn clear(&mut self) {
        if let Some((_, bar)) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
    fn advance(&mut self, task: &str, done: u64, total: u64, message: String, terminal: bool) {
        let bar = self.bar(task, total, terminal).clone();
        bar.set_position(done);
        let first = !std::mem::replace(&mut self.placed, true);
        if first && done > 1 {
            // What was done before an interruption took no time here.
            bar.reset_eta();
        }
        let eta = bar.eta();
        bar.set_message(message.clone());
        let due = self.last_line.is_none_or(|at| at.elapsed() >= LINE_INTERVAL);
        if !terminal && due {
            self.last_line = Some(Instant::now());
            let rest = match total {
                0 => String::new(),
                // No pace is known yet.
                _ if eta.is_zero() => format!("/{total}"),
                _ => format!("/{total} eta {}s", eta.as_secs()),
            };
            self.say(&format!("{task} {done}{rest} {message}"));
        }
        if total > 0 && done >= total {
            self.clear();
        }
    }
}

/// The counts of an [`Event::Work`] in words; the counters are those of trainings and evaluations.
fn work(counter: &str, done: u64, skipped: u64) -> String {
    match counter {
        "vertices decoded" => format!("{done} vertices decoded, {skipped} reused"),
        "Gaussians deformed" => format!("{done} Gaussians deformed, {skipped} static ones left alone"),
        "Gaussians updated" => format!("{done} Gaussians updated, {skipped} out of view left alone (in the iterations that are logged)"),
        "Gaussians that move" => format!("{done} {}, {skipped} {}", plural(done, "Gaussian moves", "Gaussians move"), plural(skipped, "stays", "stay")),
        "spatial passes of the deformer" => format!("{done} spatial passes of the deformer, {skipped} taken from the cache"),
        _ => format!("{counter}: {done}, skipped {skipped}"),
    }
}

impl EventSink for Progress {
    fn emit(&self, event: &Event) {
        let Ok(mut state) = self.state.lock() else { return };
        match event {
            Event::RunStarted { command, device, seed } => state.say(&format!("{command} on {device}, seed {seed}")),
            Event::Note { object, message } => state.say(&format!("{object}: {message}")),
            Event::Warning { object, message } => state.say(&format!("warning: {object}: {message}")),
            Event::StageStarted { stage, iterations, gaussians } => {
                state.say(&format!("stage {stage}: {iterations} iterations from {gaussians} Gaussians"));
                state.bar(stage, *iterations as u64, self.terminal);
            }
            Event::Iteration { stage, iteration, of, loss, psnr_db, gaussians, ms } => {
                let message = format!("PSNR {psnr_db:.2} dB loss {loss:.4} N {gaussians} {ms:.0} ms");
                state.advance(stage, *iteration as u64, *of as u64, message, self.terminal);
            }
            Event::Progress { task, done, total } => state.advance(task, *done, *total, String::new(), self.terminal),
            Event::StageFinished { stage, seconds, gaussians } => {
                state.clear();
                state.say(&format!("stage {stage} done in {seconds:.1} s, {gaussians} Gaussians"));
            }
            Event::Work { stage, counter, done, skipped } => state.say(&format!("{stage}: {}", work(counter, *done, *skipped))),
            Event::Saved { path, bytes } => state.say(&format!("wrote {path} ({:.3} MB)", *bytes as f64 / 1e6)),
            // Densification shows in the number of Gaussians; the log has the rest.
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{State, work};
    use std::time::Duration;

    #[test]
    fn a_task_of_unknown_length_goes_on_and_others_end() {
        let mut state = State::default();
        state.advance("stress", 1, 0, String::new(), false);
        assert!(state.bar.is_some());
        state.advance("read", 3, 3, String::new(), false);
        assert!(state.bar.is_none());
    }

    #[test]
    fn the_pace_is_that_of_this_process() {
        // A training that goes on at iteration 3000 of 4000.
        let mut state = State::default();
        for done in [3000, 3001] {
            state.advance("main", done, 4000, String::new(), false);
            std::thread::sleep(Duration::from_millis(20));
        }
        let eta = state.bar.as_ref().map(|(_, bar)| bar.eta()).unwrap();
        assert!(eta > Duration::from_secs(5), "999 iterations of at least 20 ms, not {eta:?}");
    }

    #[test]
    fn counts_are_worded_by_what_they_count() {
        assert_eq!(work("Gaussians that move", 0, 600), "0 Gaussians move, 600 stay");
        assert_eq!(work("vertices decoded", 8, 2), "8 vertices decoded, 2 reused");
        assert_eq!(work("things of a plug-in", 3, 1), "things of a plug-in: 3, skipped 1");
    }
}
