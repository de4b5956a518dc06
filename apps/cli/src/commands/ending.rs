//! The end of a training that a window shows.

use cc4dgs_core::{Error, Result};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Runs `training` and calls `say` with a line on how it ended, for the window. A panic is an error, so that the window says of it, too.
///
/// # Errors
/// That of `training`, and [`panicked`].
pub fn ended(training: impl FnOnce() -> Result<()>, say: impl FnOnce(String)) -> Result<()> {
    // Nothing of the training is used after it.
    let result = catch_unwind(AssertUnwindSafe(training)).unwrap_or_else(|_| Err(panicked()));
    say(match &result {
        Ok(()) => "The training is done.".into(),
        Err(e) => format!("The training has failed: {e}"),
    });
    result
}

/// The error of a training that panicked. What it panicked with is on standard error.
pub fn panicked() -> Error {
    Error::backend("training", "it panicked", "Report this with what it printed")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is said of a training, and its exit code where it failed.
    fn end(training: impl FnOnce() -> Result<()>) -> (String, Option<u8>) {
        let mut said = String::new();
        let result = ended(training, |line| said = line);
        (said, result.err().map(|error| error.exit_code()))
    }

    #[test]
    fn every_end_is_said_and_has_its_exit_code() {
        assert_eq!(end(|| Ok(())), ("The training is done.".to_string(), None));
        let (said, code) = end(|| Err(Error::failed("training", "it is hopeless", "Try another scene")));
        assert_eq!((said.as_str(), code), ("The training has failed: training: it is hopeless. Try another scene", Some(6)));
        let (said, code) = end(|| panic!("planted"));
        assert_eq!((said.as_str(), code), ("The training has failed: training: it panicked. Report this with what it printed", Some(5)));
    }
}
