//! Suites that lower device limits for the whole process. They are a separate program, because the other suites run in parallel.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.
#![allow(clippy::unwrap_used, reason = "tests: a failed helper is a failed test")]

mod networks;
mod stress;

/// Held by a test while it lowers a limit.
static LIMITS: std::sync::Mutex<()> = std::sync::Mutex::new(());
