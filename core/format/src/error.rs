//! Errors, sorted by who is at fault. Every message names the object, the value or limit seen, and the remedy.

use std::path::{Path, PathBuf};

/// The result of every fallible call of this workspace.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// What went wrong, by fault. Applications map the variants to exit codes (see [`Error::exit_code`]). `Debug` prints the same sentence as `Display`, so that
/// an error returned from `main` reads well.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The user asked for something impossible: a configuration key, a command-line value, a name.
    #[error("{object}: {problem}. {remedy}")]
    Parameter {
        /// What was being configured.
        object: String,
        /// The value seen and why it is wrong.
        problem: String,
        /// What to do instead.
        remedy: String,
    },
    /// Bytes from outside are broken: a truncated archive, a lying header, a NaN in a file.
    #[error("{object}: {problem}. {remedy}")]
    Data {
        /// The file, stream or record.
        object: String,
        /// The value seen and why it is wrong.
        problem: String,
        /// What to do about it.
        remedy: String,
    },
    /// An input is larger than the caller's [`crate::Limits`] allow.
    #[error("{object}: {value} is over the limit of {limit}. {remedy}")]
    Limit {
        /// What was too large.
        object: String,
        /// The size claimed or seen.
        value: u64,
        /// The limit it was held to.
        limit: u64,
        /// How to raise the limit or shrink the input.
        remedy: String,
    },
    /// The request is sensible, and this build cannot do it.
    #[error("{object}: {problem}. {remedy}")]
    Unsupported {
        /// The feature, version or device.
        object: String,
        /// What is missing.
        problem: String,
        /// What works instead.
        remedy: String,
    },
    /// The operating system refused.
    #[error("{path}: {source}. Check that the path exists and may be read or written")]
    Io {
        /// The path involved.
        path: PathBuf,
        /// The system's own word.
        source: std::io::Error,
    },
    /// A device or numeric back end failed, or a computation lost its meaning (a NaN in training).
    #[error("{object}: {problem}. {remedy}")]
    Backend {
        /// The device, kernel or quantity.
        object: String,
        /// What happened.
        problem: String,
        /// What to try.
        remedy: String,
    },
    /// The user interrupted; everything needed to resume was written.
    #[error("interrupted: {0}")]
    Interrupted(String),
}

impl std::fmt::Debug for Error {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        std::fmt::Display::fmt(self, f)
    }
}

impl Error {
    /// A [`Error::Parameter`].
    pub fn parameter(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Parameter { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Data`].
    pub fn data(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Data { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Limit`].
    pub fn limit(object: impl Into<String>, value: u64, limit: u64, remedy: impl Into<String>) -> Self {
        Self::Limit { object: object.into(), value, limit, remedy: remedy.into() }
    }
    /// A [`Error::Unsupported`].
    pub fn unsupported(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Unsupported { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Backend`].
    pub fn backend(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Backend { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Io`] about `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }
    /// The process exit code: 2 user error, 3 data error, 4 out of memory or over a limit, 5 back end, 130 interruption.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Parameter { .. } | Self::Unsupported { .. } => 2,
            Self::Data { .. } => 3,
            Self::Io { source, .. } if source.kind() == std::io::ErrorKind::OutOfMemory => 4,
            Self::Io { .. } => 3,
            Self::Limit { .. } => 4,
            Self::Backend { .. } => 5,
            Self::Interrupted(_) => 130,
        }
    }
}
