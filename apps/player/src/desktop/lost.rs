//! A graphics device that is lost: the window closes, and the error names the command that goes on at the same time and pose.

use cc4dgs_format::{Error, Result};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Whether the device is lost, and the command that shows what the window showed last.
#[derive(Clone, Default)]
pub(crate) struct Lost {
    flag: Arc<AtomicBool>,
    command: Arc<Mutex<Option<String>>>,
}

impl Lost {
    /// Notes that the device is lost.
    pub(crate) fn lose(&self) {
        self.flag.store(true, Ordering::Relaxed);
    }
    pub(crate) fn is_lost(&self) -> bool {
        self.flag.load(Ordering::Relaxed)
    }
    /// Notes what is shown now.
    pub(crate) fn note(&self, command: Option<String>) {
        *self.command.lock().unwrap_or_else(PoisonError::into_inner) = command;
    }
    /// Runs the window. egui panics where the device is lost while it draws; that is an error like any other loss.
    pub(crate) fn guard(&self, run: impl FnOnce() -> Result<()>) -> Result<()> {
        let ended = catch_unwind(AssertUnwindSafe(run));
        if self.is_lost() && !matches!(ended, Ok(Err(_))) {
            let command = self.command.lock().unwrap_or_else(PoisonError::into_inner).take();
            let remedy = command.map_or_else(|| "A training goes on without its window".to_string(), |command| format!("Go on with: {command}"));
            return Err(Error::backend("graphics device", "it was lost", remedy));
        }
        ended.unwrap_or_else(|panic| resume_unwind(panic))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_an_error_that_says_how_to_go_on() {
        let lost = Lost::default();
        lost.note(Some("cc4dgs view a.cc4d --time 0.5".into()));
        assert!(lost.guard(|| Ok(())).is_ok());
        assert!(catch_unwind(AssertUnwindSafe(|| lost.guard(|| panic!("a fault of its own")))).is_err(), "other panics go on");
        lost.lose();
        let message = lost.guard(|| panic!("no buffer")).unwrap_err().to_string();
        assert!(message.contains("lost") && message.contains("cc4dgs view a.cc4d --time 0.5"), "{message}");
    }
}
