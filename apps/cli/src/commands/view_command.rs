//! The command that opens a window, as the window prints it.

use crate::args::{VIEW_DEVICE, VIEW_MAX_ERROR};
use crate::ignored::{Stated, refuse_ignored};
use cc4dgs_core::{Error, Limits, Result};
use std::path::Path;

/// `cc4dgs view` with the options that say how models are opened, where they are not the usual ones. What they may be needs no quotes.
pub fn view_command(device: &str, max_error: &str, limits: &Limits) -> Result<String> {
    let mut out = "cc4dgs view".to_string();
    for (name, value, usual) in [("device", device, VIEW_DEVICE), ("max-error", max_error, VIEW_MAX_ERROR)] {
        if value != usual {
            out += &format!(" --{name} {value}");
        }
    }
    let table = |limits: &Limits| toml::Table::try_from(limits).map_err(|e| Error::backend("limits", e.to_string(), "Report this as a defect"));
    let (limits, usual) = (table(limits)?, table(&Limits::default())?);
    let changed = limits.iter().filter(|(name, value)| usual.get(*name) != Some(value));
    Ok(changed.fold(out, |out, (name, value)| format!("{out} --limit {name}={value}")))
}

/// Refuses `--json`, whose file is `json`: a window leaves no result.
///
/// # Errors
/// [`Error::Parameter`].
pub fn refuse_json(json: Option<&Path>) -> Result<()> {
    let (value, remedy) = (json.map(|file| file.display().to_string()), "Leave it out; `cc4dgs info` describes a model".into());
    refuse_ignored("a window, which leaves no result", [Stated { option: "--json", value, used: false, remedy }])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_has_no_result() {
        refuse_json(None).unwrap();
        let message = refuse_json(Some(Path::new("a.json"))).unwrap_err().to_string();
        assert!(message.starts_with("--json a.json: it has no effect on a window"), "{message}");
    }

    #[test]
    fn the_command_has_the_options_that_are_not_usual() {
        assert_eq!(view_command(VIEW_DEVICE, VIEW_MAX_ERROR, &Limits::default()).unwrap(), "cc4dgs view");
        let limits = Limits { max_gaussians: 7, ..Limits::default() };
        let command = view_command("wgpu:1", "0.5px", &limits).unwrap();
        assert_eq!(command, "cc4dgs view --device wgpu:1 --max-error 0.5px --limit max_gaussians=7");
    }
}
