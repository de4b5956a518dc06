//! Listeners to the events of a run.

mod progress;

pub use progress::Progress;
