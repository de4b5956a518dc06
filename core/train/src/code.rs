//! Which code runs, for the provenance of checkpoints, archives and results.

use std::sync::OnceLock;

static COMMIT: OnceLock<&'static str> = OnceLock::new();

/// Says which commit this program was built from; the first call counts. A program says it once, at its start: a library that looked for its own
/// commit would be compiled again after each.
pub fn built_from(commit: &'static str) {
    COMMIT.get_or_init(|| commit);
}

/// Version of this library, and the commit that the program was built from: empty where the program did not say.
#[must_use]
pub fn version() -> (&'static str, &'static str) {
    (env!("CARGO_PKG_VERSION"), COMMIT.get().copied().unwrap_or_default())
}
