//! The whole `cc4dgs` command with the plug-ins of `sway` beside its own.

use sway as _;

fn main() -> std::process::ExitCode {
    cc4dgs_cli::run(std::env::args_os())
}
