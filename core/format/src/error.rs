//! Errors, sorted by cause. Every message names the object, the value or limit, and the remedy.

use std::path::{Path, PathBuf};

/// The result of every fallible call of this workspace.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error, by cause. Applications map the variants to exit codes (see [`Error::exit_code`]). `Debug` prints the same text as `Display`, so that
/// an error returned from `main` is readable.
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A wrong request of the user: a configuration key, a command-line value, a name.
    #[error("{object}: {problem}. {remedy}")]
    Parameter {
        /// What was being configured.
        object: String,
        /// The value and why it is wrong.
        problem: String,
        /// What to do instead.
        remedy: String,
    },
    /// Invalid input data: a truncated archive, a wrong header, a NaN in a file.
    #[error("{object}: {problem}. {remedy}")]
    Data {
        /// The file, stream or record.
        object: String,
        /// The value and why it is wrong.
        problem: String,
        /// What to do about it.
        remedy: String,
    },
    /// An input is larger than the caller's [`crate::Limits`] allow.
    #[error("{object}: {value} is over the limit of {limit}. {remedy}")]
    Limit {
        /// What was too large.
        object: String,
        /// The size.
        value: u64,
        /// The limit.
        limit: u64,
        /// How to raise the limit or shrink the input.
        remedy: String,
    },
    /// A valid request that this build cannot fulfil.
    #[error("{object}: {problem}. {remedy}")]
    Unsupported {
        /// The feature, version or device.
        object: String,
        /// What is missing.
        problem: String,
        /// What works instead.
        remedy: String,
    },
    /// Memory ran out where there is no error of the system to pass on, such as in another process.
    #[error("{object}: {problem}. {remedy}")]
    OutOfMemory {
        /// The work.
        object: String,
        /// What happened.
        problem: String,
        /// How to need less, or to have more.
        remedy: String,
    },
    /// An error of the operating system.
    #[error("{path}: {source}. Check that the path exists and may be read or written")]
    Io {
        /// The path.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A device or backend failed, or a computation gave invalid values (a NaN in training).
    #[error("{object}: {problem}. {remedy}")]
    Backend {
        /// The device, kernel or quantity.
        object: String,
        /// What happened.
        problem: String,
        /// What to try.
        remedy: String,
    },
    /// A training ended with a model that is not worth having. A checkpoint was written before.
    #[error("{object}: {problem}. {remedy}")]
    Failed {
        /// What failed.
        object: String,
        /// What was measured, and what is likely wrong.
        problem: String,
        /// What to try.
        remedy: String,
    },
    /// The user interrupted. The message says what was written before.
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
    /// A [`Error::OutOfMemory`].
    pub fn out_of_memory(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::OutOfMemory { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Backend`].
    pub fn backend(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Backend { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// A [`Error::Failed`].
    pub fn failed(object: impl Into<String>, problem: impl Into<String>, remedy: impl Into<String>) -> Self {
        Self::Failed { object: object.into(), problem: problem.into(), remedy: remedy.into() }
    }
    /// The error of settings that a file states, which are not the user's mistake; `object` names the file.
    pub fn of_file(self, object: &str) -> Self {
        match self {
            Self::Parameter { object: setting, problem, .. } => {
                Self::data(object, format!("{setting}: {problem}"), "The file is damaged or of another version; fetch or write it again")
            }
            other => other,
        }
    }
    /// The error where it was met in the file `object`, which errors of its streams do not name.
    pub fn within(self, file: &str) -> Self {
        let named = |object: String| if object.contains(file) { object } else { format!("{file}: {object}") };
        match self {
            Self::Data { object, problem, remedy } => Self::Data { object: named(object), problem, remedy },
            Self::Limit { object, value, limit, remedy } => Self::Limit { object: named(object), value, limit, remedy },
            Self::Unsupported { object, problem, remedy } => Self::Unsupported { object: named(object), problem, remedy },
            other => other,
        }
    }
    /// A [`Error::Io`] about `path`.
    pub fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_path_buf(), source }
    }
    /// The process exit code: 2 user error, 3 data error, 4 out of memory or over a limit, 5 backend, 6 a training that failed, 130
    /// interruption.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Parameter { .. } | Self::Unsupported { .. } => 2,
            Self::Data { .. } => 3,
            Self::Io { source, .. } if source.kind() == std::io::ErrorKind::OutOfMemory => 4,
            Self::Io { .. } => 3,
            Self::Limit { .. } | Self::OutOfMemory { .. } => 4,
            Self::Backend { .. } => 5,
            Self::Failed { .. } => 6,
            Self::Interrupted(_) => 130,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Error;

    #[test]
    fn settings_of_a_file_are_no_mistake_of_the_user() {
        let error = Error::parameter("codec raw, bits", "unknown field", "See the known keys").of_file("a.cc4d");
        assert_eq!(error.exit_code(), 3);
        assert!(error.to_string().starts_with("a.cc4d: codec raw, bits: unknown field. "), "{error}");
        assert_eq!(Error::limit("a stream", 2, 1, "Raise it").of_file("a.cc4d").exit_code(), 4);
    }
}
