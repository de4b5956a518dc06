//! Where the datasets of a grid lie. A path may start with an environment variable, which is looked up when a grid is planned and again when a training runs:
//! so one plan serves machines with other folders.

use cc4dgs_core::{Error, Result};
use std::path::{Path, PathBuf};

/// The environment variable that a grid's text starts with, and the path below it: `CC4DGS_DATA` and `mutant` of `$CC4DGS_DATA/mutant`.
fn split(text: &str) -> Option<(&str, &str)> {
    let rest = text.strip_prefix('$')?;
    Some(rest.split_once('/').unwrap_or((rest, "")))
}

/// The environment variable that a grid's text starts with.
pub(super) fn variable_of(text: &str) -> Option<&str> {
    split(text).map(|(variable, _)| variable)
}

/// The path a grid's text stands for: an environment variable at its start is replaced, as in `$CC4DGS_DATA/mutant`.
///
/// # Errors
/// [`Error::Parameter`] for a variable that is not set.
pub fn locate(text: &str) -> Result<PathBuf> {
    let Some((variable, tail)) = split(text) else { return Ok(PathBuf::from(text)) };
    match std::env::var_os(variable) {
        Some(value) if !value.is_empty() => Ok(if tail.is_empty() { PathBuf::from(value) } else { Path::new(&value).join(tail) }),
        _ => Err(Error::parameter(
            format!("path {text}"),
            format!("the environment variable {variable} is not set"),
            "Set it to the folder that the path starts from",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_may_start_with_a_variable() {
        assert_eq!(["$A/b/c", "$A", "a/$B", "procedural:tiny"].map(variable_of), [Some("A"), Some("A"), None, None]);
        let root = PathBuf::from(std::env::var_os("PATH").unwrap());
        assert_eq!((locate("$PATH/b/c").unwrap(), locate("$PATH").unwrap(), locate("a/$B").unwrap()), (root.join("b/c"), root, PathBuf::from("a/$B")));
        let message = locate("$CC4DGS_NO_SUCH_VARIABLE/x").unwrap_err().to_string();
        assert!(message.contains("CC4DGS_NO_SUCH_VARIABLE is not set"), "{message}");
    }
}
