//! Dataset readers: each on a tiny scene written by the test, on hostile bytes, and on the real scenes where they are present.
#![allow(clippy::unwrap_used, clippy::print_stderr, reason = "tests: a failed helper is a failed test, and skipped ones say so")]

mod common;
mod formats;
mod golden;
mod hostile;
mod procedural;
mod real;
mod selection;
