//! Suites that lower the limits of the device for the whole process: apart from the others, which run beside each other.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.
#![allow(clippy::unwrap_used, reason = "tests: a failed helper is a failed test")]

mod networks;
mod stress;

/// Held by a test while it lowers a limit.
static LIMITS: std::sync::Mutex<()> = std::sync::Mutex::new(());
