//! The whole `cc4dgs` command with the plug-ins of `sway` and `half-floats` beside its own.

use half_floats as _;
use sway as _;

fn main() -> std::process::ExitCode {
    cc4dgs_cli::run(std::env::args_os())
}
