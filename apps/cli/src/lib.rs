//! The `cc4dgs` command as a library function, for programs that link further plug-in crates. Such a program is three lines long:
//!
//! ```no_run
//! use cc4dgs_cli as _; // and: use my_deformer as _;
//! fn main() -> std::process::ExitCode {
//!     cc4dgs_cli::run(std::env::args_os())
//! }
//! ```

mod args;
mod commands;
mod ignored;
mod interrupt;
mod listeners;
mod models;
mod output;
mod shots;

use clap::Parser;
use std::ffi::OsString;
use std::process::ExitCode;

/// Runs the `cc4dgs` command on `args` (the program's name first) and returns its exit code: 0 done, 2 user error, 3 data error, 4 out of memory or
/// over a limit, 5 backend, 6 a training that failed, 130 interruption. Every plug-in linked into the program takes part.
pub fn run<I, T>(args: I) -> ExitCode
where
    I: IntoIterator<Item = T>,
    T: Into<OsString> + Clone,
{
    quiet_drivers();
    cc4dgs_train::code::built_from(env!("CC4DGS_COMMIT"));
    let cli = match args::Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are asked for, not errors; clap knows which stream each belongs on.
            error.print().ok();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let output = output::Output::new(cli.json.clone(), cli.quiet);
    match output.begin().and_then(|()| commands::dispatch(&cli, &output)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output.failure(&error);
            ExitCode::from(error.exit_code())
        }
    }
}

/// Graphics drivers print errors of their own where there is no desktop session and this variable is missing. They only look for a socket in the folder.
fn quiet_drivers() {
    const FOLDER: &str = "XDG_RUNTIME_DIR";
    if cfg!(target_os = "linux") && std::env::var_os(FOLDER).is_none() {
        // SAFETY: called before this program starts threads; nothing else reads or writes the environment meanwhile.
        unsafe { std::env::set_var(FOLDER, std::env::temp_dir()) };
    }
}
