//! Ctrl-C and SIGTERM: the first asks the running work to stop at a safe point, one that comes more than a second later ends the process at once.

use cc4dgs_core::{Error, Result};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Signals that come so soon after the first are the same request: `timeout` and job managers send one to a process and one to the group that it is in.
const SAME_REQUEST: Duration = Duration::from_secs(1);
static STOP: AtomicBool = AtomicBool::new(false);
static INSTALLED: OnceLock<Result<(), String>> = OnceLock::new();

/// Installs the handler (once per process) and returns the flag it sets. Without it Ctrl-C ends the process, and ffmpeg where it decodes a video.
pub fn stop_flag() -> Result<&'static AtomicBool> {
    let installed = INSTALLED.get_or_init(|| {
        let mut first = None;
        let set = ctrlc::set_handler(move || {
            STOP.store(true, Ordering::SeqCst);
            if first.get_or_insert_with(Instant::now).elapsed() > SAME_REQUEST {
                cc4dgs_train::data::end_commands();
                std::process::exit(130);
            }
        })
        .map_err(|e| e.to_string());
        if set.is_ok() {
            cc4dgs_train::data::answers_interrupts();
        }
        set
    });
    match installed {
        Ok(()) => Ok(&STOP),
        Err(e) => Err(Error::backend("Ctrl-C handler", e.clone(), "Run the command from a program that installs no handler of its own")),
    }
}

/// An [`Error::Interrupted`] about `what` once Ctrl-C was pressed.
pub fn check(stop: &AtomicBool, what: &str) -> Result<()> {
    if stop.load(Ordering::Relaxed) { Err(Error::Interrupted(what.to_string())) } else { Ok(()) }
}
