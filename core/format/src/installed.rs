//! Where files that belong to this program are found on a user's machine.

use std::path::PathBuf;

/// The value of an environment variable as a path; `None` where it is absent or empty.
pub fn variable_path(name: &str) -> Option<PathBuf> {
    std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from)
}

/// The folder of this program in the user's data folder: `$XDG_DATA_HOME/cc4dgs` or `~/.local/share/cc4dgs`; `~/Library/Application Support/cc4dgs` on macOS,
/// `%APPDATA%\cc4dgs` on Windows. It need not exist.
pub fn user_data_folder() -> Option<PathBuf> {
    let data = if cfg!(windows) {
        variable_path("APPDATA")
    } else if cfg!(target_os = "macos") {
        variable_path("HOME").map(|home| home.join("Library/Application Support"))
    } else {
        variable_path("XDG_DATA_HOME").or_else(|| variable_path("HOME").map(|home| home.join(".local/share")))
    };
    data.map(|folder| folder.join("cc4dgs"))
}

/// The folder of the running program.
pub fn program_folder() -> Option<PathBuf> {
    std::env::current_exe().ok().and_then(|program| Some(program.parent()?.to_path_buf()))
}
