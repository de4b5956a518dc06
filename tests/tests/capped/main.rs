//! Suites that lower device limits for the whole process. They are a separate program, because the other suites run in parallel.
#![allow(deprecated)] // burn deprecates NdArray in favour of Flex; it stays a tested choice here.
#![allow(clippy::unwrap_used, reason = "tests: a failed helper is a failed test")]

mod networks;
mod stress;

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Held by every test of this program: a limit that one of them lowers is that of all.
fn alone() -> MutexGuard<'static, ()> {
    static LIMITS: Mutex<()> = Mutex::new(());
    LIMITS.lock().unwrap_or_else(PoisonError::into_inner)
}
