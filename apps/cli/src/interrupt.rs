//! Ctrl-C: the first asks the running work to stop at a safe point, the second ends the process at once.

use cc4dgs_core::{Error, Result};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};

static STOP: AtomicBool = AtomicBool::new(false);
static INSTALLED: OnceLock<Result<(), String>> = OnceLock::new();

/// Installs the handler (once per process) and returns the flag it sets.
pub fn stop_flag() -> Result<&'static AtomicBool> {
    let installed = INSTALLED.get_or_init(|| {
        ctrlc::set_handler(|| {
            if STOP.swap(true, Ordering::SeqCst) {
                std::process::exit(130);
            }
        })
        .map_err(|e| e.to_string())
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
