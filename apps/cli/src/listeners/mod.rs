//! Listeners to the events of a run.

mod json_lines;
mod progress;

pub use json_lines::JsonLines;
pub use progress::Progress;
