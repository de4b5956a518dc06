//! The tests of the build script, which has no test program of its own.
#![allow(dead_code, clippy::print_stdout, clippy::unwrap_used, reason = "its `main` runs in builds only, and prints what cargo reads")]

#[path = "../build.rs"]
mod build;
